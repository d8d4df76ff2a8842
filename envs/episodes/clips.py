"""Clips for training: stateless sampling from episodes whose pictures lie behind a memory map.

A batch is a function of (seed, step) alone, so a resumed run sees the batches it would have seen.
"""

from __future__ import annotations

from functools import cached_property

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clip_spec import ClipSpec
from envs.episodes.episode import EpisodeError
from envs.episodes.store import EpisodeStore
from envs.specs import memory_indices


class ClipStore(EpisodeStore):
    """Recorded episodes as what simulators learn from."""

    def clips(self, episode: Tensor, begin: Tensor, spec: ClipSpec) -> TensorDict:
        """Clips that begin at frame `begin` [B] of `episode` [B].

        Returns:
            TensorDict [B] with memory (index [L, M], frames uint8 [L, M, V, 3, H, W], commands [L, M, A],
            present bool [L, M], whether there is a picture), future (frames uint8 [L*K, V, 3, H, W],
            commands [L*K, A], states [L*K, S], valid bool [L*K], success float32 [L*K], NaN where nobody
            labelled the episode), now (command [A], state [S]), history (commands, states
            [spec.history, ...]), begin [], stride int64 []; memory and future have c2w [..., V, 4, 4] too,
            and the clip intrinsic [V, 3, 3], if the robot is calibrated, and pose_map
            uint8 [..., V, 3, H, W] if the spec asks for it. Frames past the episode's end repeat its last;
            they and frames without a picture are not valid.
        """
        total = spec.chunks * spec.chunk
        last, base, size = self.length[episode] - 1, self.start[episode], episode.shape
        ahead = begin[:, None] + spec.stride * torch.arange(1, total + 1)
        rows = base[:, None] + torch.minimum(ahead, last[:, None])
        # frames before each chunk, in strides
        past = begin[:, None] // spec.stride + spec.chunk * torch.arange(spec.chunks)
        # [B, L, M], in strides from `begin % stride`
        index = memory_indices(past + 1, spec.memory, spec.newest)
        at = (begin % spec.stride)[:, None, None] + index * spec.stride
        memory = base[:, None, None] + torch.minimum(at, last[:, None, None])
        recent = begin[:, None] - spec.stride * torch.arange((spec.history or spec.memory) - 1, -1, -1)
        before, now = base[:, None] + recent.clamp(min=0), base + begin
        states = self.arrays["states"]
        remembered = {
            "index": index,
            "frames": self.frames(memory),
            "commands": self.commands(memory, base, spec.stride),
            "present": self.arrays["present"][memory],
            **self._conditioning(memory),
        }
        future = {
            "frames": self.frames(rows),
            "commands": self.commands(rows, base, spec.stride),
            "states": states[rows],
            "valid": (ahead <= last[:, None]) & self.arrays["present"][rows],
            "success": self.success(episode, rows),
            **self._conditioning(rows),
        }
        out = {
            "memory": TensorDict(remembered, size),
            "future": TensorDict(future, size),
            "now": TensorDict({"command": self.commands(now, base, spec.stride), "state": states[now]}, size),
            "history": TensorDict(
                {"commands": self.commands(before, base, spec.stride), "states": states[before]}, size
            ),
            "begin": begin // spec.stride,
            "stride": torch.full(size, spec.stride),
        }
        if self.spec.embodiment.calibrated:
            out["intrinsic"] = self.intrinsic[episode]
        return TensorDict(out, size)

    def commands(self, rows: Tensor, first: Tensor, stride: int) -> Tensor:
        """Commands [*rows.shape, A] of rows [B, ...] of which one in `stride` is shown: those in force there,
        of changes the sum and of velocities the mean since the row shown before. Grippers are as they are at
        the row.

        Args:
            first: rows [B] of the episodes' first frames, before which nothing was commanded.
        """
        commands, robot = self.arrays["commands"], self.spec.embodiment
        out = commands[rows]
        if stride == 1 or not robot.changes:
            return out
        changes = torch.zeros(robot.action_dim, dtype=torch.bool)
        changes[list(robot.changes)] = True
        begin, frames = first.reshape(-1, *[1] * (rows.ndim - 1)), torch.ones_like(rows)
        for back in range(1, stride):
            there = rows - back >= begin
            out = out + there[..., None] * changes * commands[(rows - back).clamp(min=0)]
            frames = frames + there
        # a velocity that was held all the time is that one at any stride, also where an episode begins
        return out if robot.delta else torch.where(changes, out / frames[..., None], out)

    def sample(self, episodes: Tensor, count: int, spec: ClipSpec, generator: torch.Generator) -> TensorDict:
        """`count` random clips of the given episodes, every frame that has a successor being equally likely
        to begin one; where it has no picture, the last one before it that has.
        """
        if not len(episodes):
            raise EpisodeError("no episode is left to draw clips from; collect more, or widen the selection")
        choices = (self.length[episodes] - spec.stride).clamp(min=1)
        edges = choices.cumsum(0)
        draw = torch.randint(int(edges[-1]), (count,), generator=generator)
        chosen = torch.searchsorted(edges, draw, right=True)
        begin = draw - (edges[chosen] - choices[chosen])
        start = self.start[episodes[chosen]]
        return self.clips(episodes[chosen], self._seen[start + begin].maximum(start) - start, spec)

    @cached_property
    def _seen(self) -> Tensor:
        """Of every row the last one up to it that has a picture, int64 [N]; -1 where none has."""
        present = self.arrays["present"]
        return torch.where(present, torch.arange(len(present)), -1).cummax(0).values
