"""Which held-out episodes make up the benchmark's set: those of each task that overlap least."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from pipeline.evaluation.ewmbench.coverage import least_overlap, mean_overlap, overlaps, voxels
from pipeline.evaluation.grippers.end_effectors import EndEffectors
from pipeline.evaluation.grippers.ruler import GripperRuler


@dataclass(frozen=True)
class Paths:
    """Trajectories of episodes, one of each: [T, arms, D], and in words what they are."""

    paths: list[Tensor]
    by: str


@dataclass(frozen=True)
class BenchSet:
    """The set.

    Args:
        episodes: int64 [N].
        by: how it was chosen, in words.
        of: episodes that it was chosen from.
        overlap, overlap_of_all: mean intersection over union of pairs of one task; None without trajectories.
    """

    episodes: Tensor
    by: str
    of: int
    overlap: float | None
    overlap_of_all: float | None


def in_space(store: ClipStore, ends: EndEffectors, episodes: Tensor) -> Paths:
    """Trajectories in space, metres."""
    paths = [ends.positions[store.rows(episodes[n : n + 1])] for n in range(len(episodes))]
    return Paths(paths, f"least overlap of end effectors in space ({ends.source})")


def in_pictures(store: ClipStore, ruler: GripperRuler, episodes: Tensor) -> Paths:
    """Trajectories in the pictures of the detector's cameras, in widths of a picture, where space is unknown;
    each camera's count for arms of their own.
    """
    views = torch.arange(len(ruler.views))
    paths = []
    for n in range(len(episodes)):
        rows = store.rows(episodes[n : n + 1])
        rows = rows[store.arrays["present"][rows]]
        found = [
            ruler.detector.detect(store.frames(some)[:, list(ruler.views)], views) for some in rows.split(64)
        ]
        paths.append(torch.cat(found).flatten(1, 2) / store.spec.size[1])
    return Paths(
        paths, "least overlap of grippers in the picture plane, as detected: where they are is unknown"
    )


def choose(
    episodes: Tensor, tasks: Sequence[str], count: int, side: float, trajectories: Paths | None
) -> BenchSet:
    """`count` episodes of each task at most.

    Args:
        episodes: int64 [N] to choose from.
        tasks: of each.
        side: of a voxel, in the trajectories' units.
        trajectories: of each; None takes episodes that are evenly spread.
    """
    chosen: list[int] = []
    overlap: list[tuple[float, float]] = []
    for task in sorted(set(tasks)):
        mine = [n for n, one in enumerate(tasks) if one == task]
        if trajectories is None:
            spread = torch.linspace(0, len(mine) - 1, min(count, len(mine))).round().long()
            chosen += [mine[n] for n in spread.tolist()]
            continue
        iou = overlaps([voxels(trajectories.paths[n], side) for n in mine])
        some = least_overlap(iou, count)
        overlap.append((mean_overlap(iou, some), mean_overlap(iou, list(range(len(mine))))))
        chosen += [mine[n] for n in some]
    means = [sum(pair[k] for pair in overlap) / len(overlap) if overlap else None for k in (0, 1)]
    by = "evenly spread, for nobody knows any trajectory" if trajectories is None else trajectories.by
    return BenchSet(episodes[torch.tensor(chosen, dtype=torch.int64)], by, len(episodes), means[0], means[1])
