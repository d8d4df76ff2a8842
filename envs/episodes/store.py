"""Recorded episodes side by side: which there are, their rows, and their pictures behind a memory map."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from envs.conditioning import PoseMapStyle
from envs.episodes.cache import CachedSet, open_cached
from envs.episodes.columns import Columns
from envs.episodes.episode import EpisodeError
from envs.episodes.formats.lerobot.columns import SEED
from envs.episodes.formats.lerobot.files import read_info
from envs.episodes.splits import range_of
from envs.specs import WorldSpec, text_to_bytes, warn_of_cut


class EpisodeStore:
    """Episodes of several data sets as flat arrays; frames and pose maps stay on disk behind a memory map.

    Row i of every array is one video frame; `start[e] .. start[e] + length[e]` are the rows of episode e.

    Args:
        folders: LeRobot data sets of the robot of `spec`.
        spec: robot, size to which pictures (and intrinsics) are brought, and conditioning.
        cache: folder for caches; None takes $WORLDLOOP_CACHE, else a place beside each data set.
        style: how pose maps are drawn, if the spec asks for them.

    Attributes:
        length, start: int64 [E], of each episode.
        arrays: commands float32 [N, A], states float32 [N, S], present bool [N], labelled bool [E]; success
            bool [N] if any episode is labelled; c2w float32 [N, V, 4, 4] if the robot is calibrated, zeros of
            cameras that are not.
        intrinsic: float32 [E, V, 3, 3] in pixels, zeros alike; only of calibrated robots.
        instructions, text: one per episode, and as uint8 [E, TEXT_BYTES].
        episodes: per episode its length, instruction, source, seed, success (None if nobody labelled it) and
            the number of its data set.

    Raises:
        EpisodeError: if a data set is damaged, or of another robot.
    """

    def __init__(
        self,
        folders: Sequence[Path],
        spec: WorldSpec,
        cache: Path | None = None,
        style: PoseMapStyle | None = None,
    ):
        if not folders:
            raise EpisodeError("no data set is given; name at least one folder")
        self.spec = spec
        self.parts: list[CachedSet] = [
            open_cached(Path(folder), spec, style or PoseMapStyle(), cache) for folder in folders
        ]
        self.episodes: list[dict[str, Any]] = [
            {**row, "dataset": number}
            for number, part in enumerate(self.parts)
            for row in part.info["episodes"]
        ]
        self.instructions = [str(row["instruction"]) for row in self.episodes]
        self.text = text_to_bytes(self.instructions)
        warn_of_cut(self.instructions)
        self.length = torch.tensor([row["length"] for row in self.episodes])
        self.start = self.length.cumsum(0) - self.length
        self.arrays = Columns(
            {
                name: torch.from_numpy(np.concatenate([part.arrays[name] for part in self.parts]))
                for name in self.parts[0].arrays
            }
        )
        self.arrays["labelled"] = torch.tensor([row["success"] is not None for row in self.episodes])
        if not self.arrays["labelled"].any():
            del self.arrays["success"]
        if spec.embodiment.calibrated:
            self.intrinsic = torch.tensor([row for part in self.parts for row in part.info["intrinsic"]])
        self._bounds = np.cumsum([0] + [len(part.frames) for part in self.parts])

    def __len__(self) -> int:
        return len(self.episodes)

    @property
    def fps(self) -> float:
        """Frames per second."""
        return self.spec.fps

    # -- pictures
    def _pictures(self, name: str, rows: Tensor) -> Tensor:
        """Pictures uint8 [*rows.shape, V, 3, H, W] of `frames` or `pose_maps`."""
        flat = rows.reshape(-1).numpy()
        shape = (*rows.shape, self.spec.views, 3, *self.spec.size)
        if len(self.parts) == 1:
            return torch.from_numpy(getattr(self.parts[0], name)[flat]).reshape(shape)
        out = np.empty((len(flat), *shape[-4:]), np.uint8)
        owner = np.searchsorted(self._bounds, flat, side="right") - 1
        for k, part in enumerate(self.parts):
            at = owner == k
            out[at] = getattr(part, name)[flat[at] - self._bounds[k]]
        return torch.from_numpy(out).reshape(shape)

    def _spans(self, name: str, start: Tensor, count: Tensor, rows: int) -> Tensor:
        """Pictures uint8 [B, rows, V, 3, H, W] whose first `count` [B] are those from row `start` [B] on; the
        rest hold anything. Whole spans are read several times faster than row by row.
        """
        out = np.empty((len(start), rows, self.spec.views, 3, *self.spec.size), np.uint8)
        owner = np.searchsorted(self._bounds, start.numpy(), side="right") - 1
        for slot, (part, first, size) in enumerate(zip(owner, start.tolist(), count.tolist(), strict=True)):
            begin = first - self._bounds[part]
            out[slot, :size] = getattr(self.parts[part], name)[begin : begin + size]
        return torch.from_numpy(out)

    def frames(self, rows: Tensor) -> Tensor:
        """Video frames uint8 [*rows.shape, V, 3, H, W] of flat row numbers."""
        return self._pictures("frames", rows)

    def pose_maps(self, rows: Tensor) -> Tensor:
        """Pose maps uint8 [*rows.shape, V, 3, H, W] of flat row numbers; only if the spec asks for them."""
        return self._pictures("pose_maps", rows)

    def _conditioning(self, rows: Tensor) -> dict[str, Tensor]:
        """pose_map and c2w of flat row numbers, as far as the spec and the robot have them."""
        out = {}
        if self.spec.pose_map:
            out["pose_map"] = self.pose_maps(rows)
        if "c2w" in self.arrays:
            out["c2w"] = self.arrays["c2w"][rows]
        return out

    # -- which episodes
    def select(self, sources: Iterable[str] | None = None, succeeded: bool | None = None) -> Tensor:
        """Numbers int64 of the episodes from one of these sources (a trailing * matches any ending) and with
        this outcome.
        """
        wanted = None if sources is None else list(sources)
        keep = []
        for number, row in enumerate(self.episodes):
            name = row["source"]
            if wanted is not None and not any(
                name == w or (w.endswith("*") and name.startswith(w[:-1])) for w in wanted
            ):
                continue
            if succeeded is not None and row["success"] is not succeeded:
                continue
            keep.append(number)
        return torch.tensor(keep, dtype=torch.int64)

    def split(self, name: str) -> Tensor:
        """Numbers int64 of the episodes of a split: train, held_out or calibration (see splits.py).

        Raises:
            EpisodeError: if a data set has splits, but none of that name.
        """
        chosen, first = [], 0
        for part in self.parts:
            count = len(part.info["episodes"])
            numbers = range_of(part.info["splits"], name, count, part.folder)
            chosen += [first + number for number in numbers]
            first += count
        return torch.tensor(chosen, dtype=torch.int64)

    def rows(self, episodes: Tensor) -> Tensor:
        """Rows int64 [N] of all frames of some episodes, one episode after the other."""
        length = self.length[episodes]
        before = length.cumsum(0) - length
        within = torch.arange(int(length.sum()))
        return torch.repeat_interleave(self.start[episodes] - before, length) + within

    def whole(self, episodes: Tensor) -> tuple[Tensor, Tensor]:
        """Rows int64 [E, T] of all frames but the first of some episodes, the last repeated up to the
        longest, and which are no repeats, bool [E, T].
        """
        ahead = torch.arange(1, int(self.length[episodes].max()))
        last = self.length[episodes][:, None] - 1
        return self.start[episodes][:, None] + torch.minimum(ahead, last), ahead <= last

    def seeded(self, episodes: Tensor) -> Tensor:
        """Whether the seed of each of `episodes` [E] was recorded, bool [E]; that of others is their number,
        from which nothing was laid out.
        """
        known = [SEED in read_info(part.folder)["features"] for part in self.parts]
        owners = [self.episodes[number]["dataset"] for number in episodes.tolist()]
        return torch.tensor([known[owner] for owner in owners], dtype=torch.bool)

    def pictures(self, episodes: Tensor) -> Tensor:
        """Of how many frames of each of `episodes` [E] there is a picture, int64 [E]."""
        counted = torch.cat((torch.zeros(1, dtype=torch.int64), self.arrays["present"].long().cumsum(0)))
        return counted[self.start[episodes] + self.length[episodes]] - counted[self.start[episodes]]

    def success(self, episodes: Tensor, rows: Tensor) -> Tensor:
        """Whether the task is done in frames `rows` [B, ...] of `episodes` [B], float32 [B, ...]; NaN where
        nobody labelled the episode.
        """
        if "success" not in self.arrays:
            return torch.full(rows.shape, torch.nan)
        labelled = self.arrays["labelled"][episodes].reshape(-1, *[1] * (rows.ndim - 1))
        return torch.where(labelled, self.arrays["success"][rows].float(), torch.nan)

    # -- what simulators take
    def first(self, episodes: Tensor) -> TensorDict:
        """The first frames of episodes [E] with all that Simulator.reset takes.

        Raises:
            EpisodeError: if there is no picture of one of them; names the data set.
        """
        dark = episodes[~self.arrays["present"][self.start[episodes]]].tolist()
        if dark:
            owners = [row["dataset"] for row in self.episodes]
            owner = owners[dark[0]]
            raise EpisodeError(
                f"{self.parts[owner].folder}: {len(dark)} episodes, the first of them number"
                f" {dark[0] - owners.index(owner)}, have no picture at their first frame, from which video is"
                " generated; cut them to begin at a frame that has one, or leave them out of the data"
            )
        return self.at(episodes, torch.zeros_like(episodes))

    def at(self, episodes: Tensor, frame: Tensor) -> TensorDict:
        """Frame number `frame` [E] of `episodes` [E], as Simulator.reset takes it.

        Returns:
            TensorDict [E] with frames uint8 [V, 3, H, W], command [A], state [S]; of calibrated robots
            intrinsic [V, 3, 3] and c2w [V, 4, 4]; pose_map uint8 [V, 3, H, W] if the spec asks for it.
        """
        rows = self.start[episodes] + torch.minimum(frame, self.length[episodes] - 1)
        out = {
            "frames": self.frames(rows),
            "command": self.arrays["commands"][rows],
            "state": self.arrays["states"][rows],
            **self._conditioning(rows),
        }
        if self.spec.embodiment.calibrated:
            out["intrinsic"] = self.intrinsic[episodes]
        return TensorDict(out, episodes.shape)

    def until(self, episodes: Tensor, frame: Tensor, capacity: int = 1) -> TensorDict:
        """All frames of `episodes` [B] up to and with `frame` [B], as Simulator.resume takes them.

        Args:
            capacity: rows at least, so that a session has room for what it will imagine.

        Returns:
            TensorDict [B, P] with what `at` gives of a frame; pictures of rows beyond `frame` hold anything.
        """
        rows = max(int(frame.max()) + 1, capacity)
        at = torch.minimum(torch.arange(rows), frame[:, None])
        flat = self.start[episodes][:, None] + at
        pictures = {"frames": "frames"} | ({"pose_map": "pose_maps"} if self.spec.pose_map else {})
        out = {
            "command": self.arrays["commands"][flat],
            "state": self.arrays["states"][flat],
            **{name: self._spans(kind, flat[:, 0], frame + 1, rows) for name, kind in pictures.items()},
        }
        if "c2w" in self.arrays:
            out["c2w"] = self.arrays["c2w"][flat]
        if self.spec.embodiment.calibrated:
            out["intrinsic"] = self.intrinsic[episodes][:, None].expand(-1, rows, -1, -1, -1)
        return TensorDict(out, flat.shape)
