"""The contract of a learned world, and the sparse memory that every engine shares.

A simulator is a function of explicit state: `reset` makes the state of a batch of sessions, `step` turns it
and a
chunk of commands into frames, features and the next state. The state is a TensorDict with one row per
session, so
resetting some sessions is a masked write, and all randomness comes from (session seed, chunk index).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.episodes.clips import memory_indices
from envs.layouts import CommandLayout
from envs.simulators.places import Places


@dataclass(frozen=True)
class WorldShape:
    """What a simulator shows.

    Args:
        views: number of cameras, V.
        size: (height, width) of every view in pixels.
        chunk: frames per step, K.
        memory: sparse memory frames, M; the first frame is always one of them.
        fps: frames per second.
        sides: of things whose places are followed (places.py), S of them, the turns of a circle that leave
            each looking the same; () follows none.
        layout: what its commands are, A numbers a frame.
    """

    views: int = 3
    size: tuple[int, int] = (64, 64)
    chunk: int = 8
    memory: int = 4
    fps: float = 10.0
    sides: tuple[int, ...] = (4, 0)
    layout: CommandLayout = CommandLayout.EEF

    def __post_init__(self) -> None:
        if self.sides and self.layout is not CommandLayout.EEF:
            raise ValueError(
                "simulator.sides follows things under end-effector commands only; set it to [] for joint commands"
            )

    @property
    def objects(self) -> int:
        """Number of things followed, S."""
        return len(self.sides)


class Simulator(nn.Module):
    """Base of all learned worlds; a subclass implements `predict`.

    Args:
        shape: what it shows.
    """

    feature_shape: tuple[int, ...]

    def __init__(self, shape: WorldShape):
        super().__init__()
        self.shape = shape
        self.places = Places(shape.sides)

    # -- what a subclass gives
    # -----------------------------------------------------------------------------------
    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """Generate the frames of one chunk.

        Args:
            inputs: TensorDict [B] with memory (frames, pose_map uint8 [M, V, 3, H, W], c2w [M, V, 4, 4],
                places [M, S, 4]),
                future (pose_map uint8 [K, V, 3, H, W], c2w [K, V, 4, 4], commands [K, A], places [K, S, 4]),
                now (command [A], state [16], places [S, 4]; NaN where unknown),
                begin (what `prepare` made of the first pictures), intrinsic [V, 3, 3], seed int64 [],
                chunk_index int64 [].

        Returns:
            frames uint8 [B, K, V, 3, H, W] and features float32 [B, *feature_shape] for the state expert.
        """
        raise NotImplementedError

    def prepare(self, frames: Tensor, places: Tensor, intrinsic: Tensor, c2w: Tensor) -> TensorDict:
        """What an engine makes of first pictures once, for all chunks of their episodes; a TensorDict [B],
        here an empty one.

        Args:
            frames: uint8 [B, V, 3, H, W]; places: [B, S, 4]; intrinsic: [B, V, 3, 3] pixels; c2w: [B, V, 4,
                4].
        """
        return TensorDict({}, frames.shape[:1])

    def glance(self, frames: Tensor, c2w: Tensor) -> None:
        """Look at first pictures uint8 [N, V, 3, H, W] of different episodes, c2w [N, V, 4, 4], before
        training; an engine may learn what is the same in all.
        """

    def features(self, inputs: TensorDict) -> Tensor:
        """Only the features of `predict`, for training the state expert."""
        return self.predict(inputs)[1]

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Training loss of a clip (see ClipStore.clips) and figures to log."""
        raise NotImplementedError

    def build_inputs(
        self,
        clip: TensorDict,
        number: int,
        drawn: Tensor | None = None,
        generator: torch.Generator | None = None,
        begin: TensorDict | None = None,
    ) -> TensorDict:
        """The inputs of `predict` for chunk `number` of a training clip [B].

        Args:
            drawn: uint8 [B, number * K, V, 3, H, W], the model's own frames of the chunks before; memory then
                shows
                these instead of true ones.
            generator: draws the noise seeds; without one they are zero.
            begin: of the clip's episodes, from an earlier call; without it they are prepared anew.
        """
        chunk, size = self.shape.chunk, clip.shape
        part = slice(number * chunk, (number + 1) * chunk)
        memory = TensorDict(
            {key: clip["memory", key][:, number] for key in ("frames", "pose_map", "c2w")}, size
        )
        memory["places"] = self.places.of(clip["memory", "objects"][:, number])
        if begin is None:
            begin = self.prepare(
                memory["frames"][:, 0], memory["places"][:, 0], clip["intrinsic"], memory["c2w"][:, 0]
            )
        if drawn is not None:
            rows = torch.arange(len(clip), device=clip.device)[:, None]
            ahead = clip["memory", "index"][:, number] - clip["begin"][:, None] - 1
            memory["frames"] = torch.where(
                (ahead >= 0)[..., None, None, None, None], drawn[rows, ahead.clamp(min=0)], memory["frames"]
            )
        future = TensorDict(
            {key: clip["future", key][:, part] for key in ("pose_map", "c2w", "commands")}, size
        )
        future["places"] = self.places.of(clip["future", "objects"][:, part])
        if number == 0:
            now = {
                "command": clip["now", "command"],
                "state": clip["now", "state"],
                "places": self.places.of(clip["now", "objects"]),
            }
        else:
            before = clip["future"][:, part.start - 1]
            now = {
                "command": before["commands"],
                "state": before["states"],
                "places": self.places.of(before["objects"]),
            }
        seed = (
            torch.zeros(size, dtype=torch.int64)
            if generator is None
            else torch.randint(2**40, size, generator=generator)
        )
        return TensorDict(
            {
                "memory": memory,
                "future": future,
                "now": TensorDict(now, size),
                "begin": begin,
                "intrinsic": clip["intrinsic"],
                "seed": seed.to(clip.device),
                "chunk_index": torch.zeros(size, dtype=torch.int64, device=clip.device),
            },
            size,
        )

    # -- the contract
    # --------------------------------------------------------------------------------------------
    def reset(
        self,
        frames: Tensor,
        intrinsic: Tensor,
        c2w: Tensor,
        command: Tensor,
        state: Tensor,
        pose_map: Tensor,
        seed: Tensor,
        *,
        likeliest: bool = False,
        capacity: int = 1,
    ) -> TensorDict:
        """Begin sessions from first frames.

        Args:
            frames: uint8 [B, V, 3, H, W].
            intrinsic: [B, V, 3, 3] pixels; c2w: [B, V, 4, 4].
            command: [B, A] command in force; state: [B, 16] joint state.
            pose_map: uint8 [B, V, 3, H, W] of that command.
            seed: int64 [B].
            likeliest: let objects go their likeliest way, for comparing with what happened; else the seed
                decides.
            capacity: frames to keep room for, where it is known how long sessions last; longer ones make more
                as they go.

        Returns:
            The sessions' state, a TensorDict [B].
        """
        size = frames.shape[:1]
        with torch.no_grad():
            places = self.places.find(frames[:, 0], intrinsic[:, 0].float(), c2w[:, 0].float())
            begin = self.prepare(frames, places, intrinsic.float(), c2w.float())
        first = {
            "frames": frames,
            "pose_map": pose_map,
            "c2w": c2w.float(),
            "commands": command.float(),
            "states": state.float(),
            "places": places,
        }
        return TensorDict(
            {
                "history": _with_capacity(
                    TensorDict({name: value[:, None] for name, value in first.items()}, [*size, 1]), capacity
                ),
                "begin": begin,
                "length": torch.ones(size, dtype=torch.int64, device=frames.device),
                "intrinsic": intrinsic.float(),
                "likeliest": torch.full(size, likeliest, device=frames.device),
                "seed": seed.reshape(size),
                "chunk_index": torch.zeros(size, dtype=torch.int64, device=frames.device),
            },
            size,
        )

    @torch.no_grad()
    def step(
        self, state: TensorDict, commands: Tensor, pose_map: Tensor, c2w: Tensor
    ) -> tuple[Tensor, Tensor, TensorDict]:
        """Advance every session by one chunk; `state` is used up, its buffers go into the one returned.

        Args:
            commands: [B, K, A] absolute; pose_map: uint8 [B, K, V, 3, H, W]; c2w: [B, K, V, 4, 4].

        Returns:
            frames uint8 [B, K, V, 3, H, W], features [B, *feature_shape], next state. The joint states of the
            new
            frames are unknown here and repeat the last; the state expert fills them in (`remember_states`).
        """
        batch, count = commands.shape[:2]
        rows = torch.arange(batch, device=commands.device)
        length = state["length"]
        history = state["history"]
        now = history.select("commands", "states", "places")[rows, length - 1]
        if self.shape.objects:
            luck = (
                self._luck(state["seed"], state["chunk_index"])
                .to(commands.device)
                .masked_fill(state["likeliest"][:, None, None], 0.0)
            )
            ahead = self.places.push(now["places"], self.recent(state, 1 + count)["commands"], commands, luck)
        else:
            ahead = now["places"][:, None].expand(-1, count, -1, -1)
        inputs = TensorDict(
            {
                "memory": self.recall(state, pose_map, c2w),
                "future": TensorDict(
                    {"pose_map": pose_map, "c2w": c2w, "commands": commands, "places": ahead}, [batch]
                ),
                "now": TensorDict(
                    {"command": now["commands"], "state": now["states"], "places": now["places"]}, [batch]
                ),
                "begin": state["begin"],
                "intrinsic": state["intrinsic"],
                "seed": state["seed"],
                "chunk_index": state["chunk_index"],
            },
            [batch],
        )
        pictures, features = self.predict(inputs)
        need = int(length.max()) + count
        if need > history.shape[1]:
            # for twice as many frames, so that long rollouts copy seldom
            history = _with_capacity(history, max(need, 2 * history.shape[1]))
        at = length[:, None] + torch.arange(count, device=length.device)
        new = {
            "frames": pictures,
            "pose_map": pose_map,
            "c2w": c2w,
            "commands": commands,
            "states": now["states"][:, None].expand(-1, count, -1),
            "places": ahead,
        }
        for name, value in new.items():
            history[name][rows[:, None], at] = value
        state = state.copy()  # of the names only
        state["history"], state["length"], state["chunk_index"] = (
            history,
            length + count,
            state["chunk_index"] + 1,
        )
        return pictures, features.float(), state

    def recall(self, state: TensorDict, pose_map: Tensor, c2w: Tensor) -> TensorDict:
        """What is remembered for the next chunk: frames, pose_map, c2w, places [B, M, ...], evenly spread
        over the past and with the first frame.

        Args:
            pose_map, c2w: of the chunk to come, [B, K, ...].
        """
        rows = torch.arange(len(state), device=state["length"].device)[:, None]
        return state["history"].select("frames", "pose_map", "c2w", "places")[
            rows, memory_indices(state["length"], self.shape.memory)
        ]

    def _luck(self, seed: Tensor, chunk_index: Tensor) -> Tensor:
        """Standard normal numbers [B, S, 3] that belong to each session's seed and chunk."""
        rows = [
            torch.randn(self.shape.objects, 3, generator=noise_generator(s, c))
            for s, c in zip(seed.tolist(), chunk_index.tolist(), strict=True)
        ]
        return torch.stack(rows)

    @staticmethod
    def remember_states(state: TensorDict, decoded: Tensor) -> None:
        """Write the decoded joint states [B, K, 16] of the last chunk into the sessions' history."""
        batch, count = decoded.shape[:2]
        rows = torch.arange(batch, device=decoded.device)[:, None]
        at = state["length"][:, None] - count + torch.arange(count, device=decoded.device)
        state["history", "states"][rows, at] = decoded

    @staticmethod
    def stack(states: Sequence[TensorDict]) -> TensorDict:
        """Sessions [B1], [B2], ... of equal or different length as one state; rows past a session's own
        length hold anything.
        """
        most = max(state["history"].shape[1] for state in states)
        parts = []
        for state in states:
            part = state.copy()
            part["history"] = _with_capacity(state["history"], most)
            parts.append(part)
        return torch.cat(parts)

    @staticmethod
    def recent(state: TensorDict, count: int) -> TensorDict:
        """The last `count` commands and states [B, count, ...] of each session, the first repeated where
        there are fewer.
        """
        length = state["length"]
        rows = torch.arange(len(length), device=length.device)[:, None]
        at = (length[:, None] - count + torch.arange(count, device=length.device)).clamp(min=0)
        return state["history"].select("commands", "states")[rows, at]

    def release(self, state: TensorDict, mask: Tensor) -> None:
        """The sessions of `mask` [B] end; what is held for them elsewhere can go. Here nothing is."""

    @staticmethod
    def replace(state: TensorDict, mask: Tensor, fresh: TensorDict) -> TensorDict:
        """The state with the sessions of `mask` [B] replaced by those of `fresh` (one row per True, in
        order).
        """
        for name in state.keys():
            if name not in ("history", "begin"):
                state[name][mask] = fresh[name].to(state[name].dtype)
        state["begin"][mask] = fresh["begin"]
        for name in state["history"].keys():
            state["history", name][mask.nonzero().flatten(), 0] = fresh["history", name][:, 0]
        return state


def _with_capacity(history: TensorDict, capacity: int) -> TensorDict:
    """A history [B, N] as one of at least `room` frames; rows past a session's length hold anything and are
    never read.
    """
    rows = history.shape[1]
    if room <= rows:
        return history
    out = history.new_empty(len(history), capacity)
    for name, value in history.items():
        out[name][:, :rows] = value
    return out


def noise_generator(seed: int, chunk_index: int) -> torch.Generator:
    """The generator of all randomness of one chunk of one session, whatever batch it is in."""
    return torch.Generator().manual_seed((int(seed) * 1_000_003 + int(chunk_index)) & 0x7FFF_FFFF_FFFF)


def to_bytes(frames: Tensor) -> Tensor:
    """Float frames in 0..1, or somewhat beyond, as uint8."""
    return (
        frames.clamp(0, 1).mul_(255).round_().to(torch.uint8)
    )  # in place: these are a rollout's largest tensors


def foreground_weight(frames: Tensor, gain: float) -> Tensor:
    """Loss weights [..., 1, H, W] that lift whatever differs from the picture's median colour, most of all in
    hue.

    Block and target cover one per cent of the pixels, arms ten; unweighted losses are won by the table alone,
    and
    losses that ask for any difference by the arms.

    Args:
        frames: float [..., 3, H, W] in 0..1.
        gain: weight of a pixel of a fully different hue, above the 1 of the median colour; a grey difference
            gets a twelfth.
    """
    gap = frames - frames.flatten(-2).median(-1).values[..., None, None]
    grey = gap.mean(-3, keepdim=True)
    hue = ((gap - grey).abs().amax(-3, keepdim=True) * 4).clamp(max=1.0)
    return 1.0 + gain * (hue + (grey.abs() * 2.5).clamp(max=1.0) / 12)
