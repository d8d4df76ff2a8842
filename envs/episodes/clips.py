"""Clips for training: a memory-mapped cache of decoded frames and pose maps, and stateless sampling from it.

A batch is a function of (seed, step) alone, so a resumed run sees the batches it would have seen.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from envs.conditioning import CANVAS, PoseMapStyle, render_pose_map
from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.formats.lerobot import LeRobotDataset
from envs.geometry.cameras import follow_hands, hands_of
from envs.language import tokenize
from envs.layouts import CommandLayout


@dataclass(frozen=True)
class ClipSpec:
    """Shape of a training clip.

    Args:
        memory: sparse memory frames, evenly spread over the past and always with the first.
        chunk: frames a chunk adds, K.
        chunks: consecutive chunks per clip, L.
        stride: frames between two frames of the clip.
    """

    memory: int = 4
    chunk: int = 8
    chunks: int = 1
    stride: int = 1


def memory_indices(length: Tensor, count: int) -> Tensor:
    """Frames to remember out of the first `length` [...]: `count` of them, evenly spread, first and last
    included -> [..., count].
    """
    share = torch.linspace(0, 1, count, dtype=torch.float64, device=length.device)
    return ((length.unsqueeze(-1) - 1) * share).round().long()


class ClipStore:
    """Episodes of several data sets as flat arrays; frames and pose maps stay on disk behind a memory map.

    Row i of every array is one video frame; `start[e] .. start[e] + length[e]` are the rows of episode e.

    Args:
        folders: LeRobot data sets with equal views, sizes and rates.
        layout: which commands `commands` are.
        style: how pose maps are drawn.

    Raises:
        EpisodeError: if the data sets differ, or have no commands of that layout.
    """

    def __init__(
        self,
        folders: Sequence[Path],
        layout: CommandLayout = CommandLayout.EEF,
        style: PoseMapStyle | None = None,
    ):
        self.parts = [_open(Path(folder), style or PoseMapStyle()) for folder in folders]
        first = self.parts[0]
        for part in self.parts[1:]:
            if part.info["views"] != first.info["views"] or part.info["size"] != first.info["size"]:
                raise EpisodeError(
                    f"{part.folder} holds views {part.info['views']} of {part.info['size']}, {first.folder} {first.info['views']} of {first.info['size']}"
                )
        self.views: tuple[str, ...] = tuple(first.info["views"])
        self.size: tuple[int, int] = (first.info["size"][0], first.info["size"][1])
        self.fps: float = first.info["fps"]
        join = {name: np.concatenate([part.arrays[name] for part in self.parts]) for name in first.arrays}
        self.arrays = {name: torch.from_numpy(value) for name, value in join.items()}
        self.episodes: list[dict[str, Any]] = [row for part in self.parts for row in part.info["episodes"]]
        if layout is not CommandLayout.EEF:
            other = sorted({row["recorded_layout"] for row in self.episodes} - {layout.value})
            if other:
                raise EpisodeError(
                    f"simulator.layout={layout.value}, but the data have recorded actions of layout {other}; convert data that have joint commands, or use simulator.layout=eef"
                )
            self.arrays["commands"] = self.arrays["recorded"]
        self.length = torch.tensor([row["length"] for row in self.episodes])
        self.start = torch.cat([torch.zeros(1, dtype=torch.int64), self.length.cumsum(0)])[:-1]
        self.intrinsic = torch.tensor([row["intrinsic"] for row in self.episodes])
        # int64 [episodes, WORDS]
        self.tokens = torch.stack([tokenize(row["instruction"]) for row in self.episodes])
        bounds = np.cumsum([0] + [len(part.frames) for part in self.parts])
        self._bounds = bounds

    def __len__(self) -> int:
        return len(self.episodes)

    def _pictures(self, name: str, rows: Tensor) -> Tensor:
        """Pictures uint8 [*rows.shape, V, 3, H, W] of `frames` or `pose_maps`."""
        flat = rows.reshape(-1).numpy()
        if len(self.parts) == 1:
            return torch.from_numpy(getattr(self.parts[0], name)[flat]).reshape(
                *rows.shape, len(self.views), 3, *self.size
            )
        out = np.empty((len(flat), len(self.views), 3, *self.size), np.uint8)
        owner = np.searchsorted(self._bounds, flat, side="right") - 1
        for k, part in enumerate(self.parts):
            at = owner == k
            out[at] = getattr(part, name)[flat[at] - self._bounds[k]]
        return torch.from_numpy(out).reshape(*rows.shape, len(self.views), 3, *self.size)

    def frames(self, rows: Tensor) -> Tensor:
        """Video frames uint8 [*rows.shape, V, 3, H, W] of flat row numbers."""
        return self._pictures("frames", rows)

    def pose_maps(self, rows: Tensor) -> Tensor:
        """Pose maps uint8 [*rows.shape, V, 3, H, W] of flat row numbers."""
        return self._pictures("pose_maps", rows)

    def select(self, behaviours: Iterable[str] | None = None, succeeded: bool | None = None) -> Tensor:
        """Numbers of the episodes with one of these behaviours (a trailing * matches any ending) and this
        outcome.
        """
        wanted = None if behaviours is None else list(behaviours)
        keep = []
        for number, row in enumerate(self.episodes):
            name = row["behaviour"]
            if wanted is not None and not any(
                name == w or (w.endswith("*") and name.startswith(w[:-1])) for w in wanted
            ):
                continue
            if succeeded is not None and row["success"] != succeeded:
                continue
            keep.append(number)
        return torch.tensor(keep, dtype=torch.int64)

    def clips(self, episode: Tensor, begin: Tensor, spec: ClipSpec) -> TensorDict:
        """Clips that begin at frame `begin` [B] of `episode` [B].

        Returns:
            TensorDict [B] with memory (index [L, M], frames, pose_map uint8 [L, M, V, 3, H, W], c2w [L, M, V,
            4, 4], objects [L, M, 2, 4]),
            future (frames, pose_map [L*K, V, 3, H, W], c2w, commands [L*K, 14], states [L*K, 16], objects
            [L*K, 2, 4], valid [L*K]),
            now (command [14], state [16], objects [2, 4]), history (states, commands [M, ...]), intrinsic [V,
            3, 3], begin [].
            Frames past the episode's end repeat its last, and they and black frames are not valid.
        """
        total = spec.chunks * spec.chunk
        last = self.length[episode] - 1
        base = self.start[episode]
        ahead = begin[:, None] + spec.stride * torch.arange(1, total + 1)
        rows = base[:, None] + torch.minimum(ahead, last[:, None])
        valid = (ahead <= last[:, None]) & self.arrays["seen"][rows]
        # frames before each chunk, in strides
        past = begin[:, None] // spec.stride + spec.chunk * torch.arange(spec.chunks)
        index = memory_indices(past + 1, spec.memory)  # [B, L, M], in strides from `begin % stride`
        at = (begin % spec.stride)[:, None, None] + index * spec.stride
        memory = base[:, None, None] + torch.minimum(at, last[:, None, None])
        now = base + begin
        recent = base[:, None] + (begin[:, None] - spec.stride * torch.arange(spec.memory - 1, -1, -1)).clamp(
            min=0
        )
        size = episode.shape

        def pick(name: str, where: Tensor) -> Tensor:
            return self.arrays[name][where]

        return TensorDict(
            {
                "memory": TensorDict(
                    {
                        "index": index,
                        "frames": self.frames(memory),
                        "pose_map": self.pose_maps(memory),
                        "c2w": pick("c2w", memory),
                        "objects": pick("objects", memory),
                    },
                    size,
                ),
                "future": TensorDict(
                    {
                        "frames": self.frames(rows),
                        "pose_map": self.pose_maps(rows),
                        "c2w": pick("c2w", rows),
                        "commands": pick("commands", rows),
                        "states": pick("states", rows),
                        "objects": pick("objects", rows),
                        "valid": valid,
                    },
                    size,
                ),
                "now": TensorDict(
                    {
                        "command": pick("commands", now),
                        "state": pick("states", now),
                        "objects": pick("objects", now),
                    },
                    size,
                ),
                "history": TensorDict(
                    {"commands": pick("commands", recent), "states": pick("states", recent)}, size
                ),
                "intrinsic": self.intrinsic[episode],
                "begin": begin // spec.stride,
            },
            size,
        )

    def rows(self, episodes: Tensor) -> Tensor:
        """Rows int64 [N] of all frames of some episodes, one episode after the other."""
        length = self.length[episodes]
        before = length.cumsum(0) - length
        return torch.repeat_interleave(self.start[episodes] - before, length) + torch.arange(
            int(length.sum())
        )

    def whole(self, episodes: Tensor) -> tuple[Tensor, Tensor]:
        """Rows int64 [N, T] of all frames but the first of some episodes, the last repeated up to the
        longest, and which are no repeats, bool [N, T].
        """
        ahead = torch.arange(1, int(self.length[episodes].max()))
        last = self.length[episodes][:, None] - 1
        return self.start[episodes][:, None] + torch.minimum(ahead, last), ahead <= last

    def shots(self, episodes: Tensor, count: int, generator: torch.Generator) -> TensorDict:
        """`count` random pictures of the first view, three of four an episode's first.

        Returns:
            TensorDict [count] with frames uint8 [3, H, W], objects [2, 4], intrinsic [3, 3] and c2w [4, 4].
        """
        chosen = episodes[torch.randint(len(episodes), (count,), generator=generator)]
        ahead = (torch.rand(count, generator=generator) * self.length[chosen]).long()
        ahead[torch.arange(count) % 4 > 0] = 0
        rows = self.start[chosen] + ahead
        arrays = {
            "objects": self.arrays["objects"][rows],
            "c2w": self.arrays["c2w"][rows, 0],
            "intrinsic": self.intrinsic[chosen, 0],
        }
        return TensorDict({"frames": self.frames(rows)[:, 0], **arrays}, [count])

    def motions(self, episodes: Tensor, count: int, chunk: int, generator: torch.Generator) -> TensorDict:
        """`count` random chunks without pictures, each wholly within its episode.

        Returns:
            TensorDict [count] with recent [1 + K, 14], the commands up to now, now (objects [2, 4]) and
            future (commands [K, 14],
            objects [K, 2, 4]).
        """
        choices = (self.length[episodes] - chunk).clamp(min=0)
        if not int(choices.sum()):
            raise EpisodeError(f"no episode is longer than a chunk of {chunk} frames; lower task.chunk")
        edges = choices.cumsum(0)
        draw = torch.randint(int(edges[-1]), (count,), generator=generator)
        chosen = torch.searchsorted(edges, draw, right=True)
        now = self.start[episodes[chosen]] + draw - (edges[chosen] - choices[chosen])
        ahead = now[:, None] + torch.arange(1, chunk + 1)
        before = torch.maximum(now[:, None] + torch.arange(-chunk, 1), self.start[episodes[chosen]][:, None])
        commands, objects = self.arrays["commands"], self.arrays["objects"]
        return TensorDict(
            {
                "recent": commands[before],
                "now": TensorDict({"objects": objects[now]}, [count]),
                "future": TensorDict(
                    {"commands": commands[ahead], "objects": objects[ahead]}, [count, chunk]
                ),
            },
            [count],
        )

    def sample(self, episodes: Tensor, count: int, spec: ClipSpec, generator: torch.Generator) -> TensorDict:
        """`count` random clips of the given episodes, every frame that has a successor being equally likely
        to begin one.
        """
        choices = (self.length[episodes] - spec.stride).clamp(min=1)
        edges = choices.cumsum(0)
        draw = torch.randint(int(edges[-1]), (count,), generator=generator)
        chosen = torch.searchsorted(edges, draw, right=True)
        begin = draw - (edges[chosen] - choices[chosen])
        return self.clips(episodes[chosen], begin, spec)


@dataclass
class _Part:
    folder: Path
    info: dict[str, Any]
    frames: NDArray[np.uint8]
    pose_maps: NDArray[np.uint8]
    arrays: dict[str, NDArray[Any]]


_CACHE_FORM = b"3"  # changes when what a cache holds does
_NUMERIC = ("commands", "achieved", "states", "c2w", "success", "progress", "objects", "seen", "recorded")


def _open(folder: Path, style: PoseMapStyle) -> _Part:
    """Open the cache of a data set, making it first if it is missing or older than the data."""
    source = folder / "meta/info.json"
    if not source.exists():
        raise EpisodeError(f"{folder} is not a LeRobot data set: {source} is missing")
    stamp = hashlib.sha256(source.read_bytes() + _CACHE_FORM + repr(style).encode()).hexdigest()[:16]
    cache = folder / ".cache"
    marker = cache / "info.json"
    if not marker.exists() or json.loads(marker.read_text())["stamp"] != stamp:
        _build(folder, cache, stamp, style)
    info = json.loads(marker.read_text())
    arrays = {name: np.load(cache / f"{name}.npy") for name in _NUMERIC}
    return _Part(
        folder,
        info,
        np.load(cache / "frames.npy", mmap_mode="r"),
        np.load(cache / "pose_maps.npy", mmap_mode="r"),
        arrays,
    )


def _build(folder: Path, cache: Path, stamp: str, style: PoseMapStyle) -> None:
    data = LeRobotDataset(folder)
    cache.mkdir(exist_ok=True)
    (cache / "info.json").unlink(missing_ok=True)
    total = int(data.episode_rows()[-1]["dataset_to_index"])
    shape = (total, len(data.views), 3, *data.size)
    pictures = {
        name: np.lib.format.open_memmap(cache / f"{name}.npy", "w+", np.uint8, shape)
        for name in ("frames", "pose_maps")
    }
    columns: dict[str, list[NDArray[Any]]] = {name: [] for name in _NUMERIC}
    episodes, row = [], 0
    for episode in data:
        rows = slice(row, row + len(episode))
        pictures["frames"][rows] = episode.frames
        # Wrist cameras are placed where the commands lead them, as they will be in imagination, where nobody
        # can measure them.
        c2w = commanded_cameras(episode)
        pictures["pose_maps"][rows] = pose_maps_of(episode, c2w, style).transpose(0, 1).numpy()
        numbers = {name: getattr(episode, name) for name in _NUMERIC} | {"c2w": c2w.numpy()}
        if episode.recorded is None:
            numbers["recorded"] = np.zeros((len(episode), 0), np.float32)
        # Networks take no NaN: what is unknown of arms and cameras is nothing, and a camera at the world's
        # origin.
        for name in ("commands", "achieved", "states"):
            numbers[name] = np.nan_to_num(numbers[name])
        numbers["c2w"] = np.where(np.isnan(numbers["c2w"]), np.eye(4, dtype=np.float32), numbers["c2w"])
        for name, values in numbers.items():
            columns[name].append(values)
        episodes.append(
            {
                "length": len(episode),
                "instruction": episode.instruction,
                "behaviour": episode.behaviour,
                "seed": episode.seed,
                "success": episode.succeeded,
                "recorded_layout": episode.recorded_layout,
                "intrinsic": episode.intrinsic.tolist(),
            }
        )
        row = rows.stop
    for array in pictures.values():
        array.flush()
    for name, values in columns.items():
        np.save(cache / f"{name}.npy", np.concatenate(values))
    temporary = cache / ".info.part"
    temporary.write_text(
        json.dumps(
            {"stamp": stamp, "views": data.views, "size": data.size, "fps": data.fps, "episodes": episodes}
        )
    )
    os.replace(temporary, cache / "info.json")


def pose_maps_of(episode: Episode, c2w: Tensor, style: PoseMapStyle | None = None) -> Tensor:
    """Pose maps uint8 [V, T, 3, H, W] of an episode's commands seen from c2w [T, V, 4, 4]; empty where a
    camera or the commands are unknown.
    """
    length, views = c2w.shape[:2]
    size = (episode.frames.shape[-2], episode.frames.shape[-1])
    maps = torch.full((views, length, 3, *size), CANVAS, dtype=torch.uint8)
    known = (
        torch.isfinite(c2w).all((0, 2, 3))
        if np.isfinite(episode.commands).all()
        else torch.zeros(views, dtype=torch.bool)
    )
    if known.any():
        maps[known] = render_pose_map(
            torch.from_numpy(episode.commands),
            c2w[:, known].transpose(0, 1),
            torch.from_numpy(episode.intrinsic)[known],
            size,
            style=style,
        )
    return maps


def commanded_cameras(episode: Episode) -> Tensor:
    """Camera poses [T, V, 4, 4] if the arms had followed their commands exactly from the first frame on; as
    recorded where commands are unknown, or cameras move by themselves.
    """
    if not np.isfinite(episode.commands).all():
        return torch.from_numpy(episode.c2w)
    commands = torch.from_numpy(episode.commands)
    return follow_hands(torch.from_numpy(episode.c2w[0]), commands[0], commands, hands_of(episode.views))
