"""The benchmark's set: trajectories chosen one after the other so that they overlap least (EWMBench, 6.1).

A trajectory is the set of voxels that its end effectors pass; two overlap by the intersection over union of
theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def voxels(path: Tensor, side: float) -> NDArray[np.int64]:
    """The different voxels int64 [n, 1 + D] that a path passes: the arm's number, then whole multiples of
    `side`. Straight lines join one frame to the next, so that speed opens no gaps.

    Args:
        path: [T, arms, D], NaN where nothing is known.
        side: of a voxel, in the path's units.
    """
    found = []
    for arm in range(path.shape[1]):
        points = path[:, arm].double()
        points = points[torch.isfinite(points).all(-1)]
        if not len(points):
            continue
        steps = [points[:1]]
        for begin, end in pairwise(points):
            count = int((2 * (end - begin).norm() / side).ceil().clamp(min=1))
            share = torch.arange(1, count + 1, dtype=torch.float64)[:, None] / count
            steps.append(begin + share * (end - begin))
        cells = np.floor(torch.cat(steps).numpy() / side).astype(np.int64)
        found.append(np.insert(np.unique(cells, axis=0), 0, arm, axis=1))
    return np.concatenate(found) if found else np.zeros((0, 1 + path.shape[-1]), np.int64)


def overlaps(cells: Sequence[NDArray[np.int64]]) -> Tensor:
    """Intersection over union float64 [E, E] of sets of voxels; 0 where both are empty."""
    counts = [len(some) for some in cells]
    _, number = np.unique(np.concatenate(list(cells)), axis=0, return_inverse=True)
    member = torch.zeros(len(cells), int(number.max(initial=-1)) + 1, dtype=torch.float64)
    owner = torch.repeat_interleave(torch.arange(len(cells)), torch.tensor(counts))
    member[owner, torch.from_numpy(number.reshape(-1))] = 1
    both = member @ member.T
    either = member.sum(1)[:, None] + member.sum(1)[None] - both
    return both / either.clamp(min=1)


def least_overlap(iou: Tensor, count: int) -> list[int]:
    """Up to `count` positions in the order in which they are chosen: first the trajectory that overlaps least
    with all others, then always the one whose largest overlap with those chosen is least. Of equal ones the
    first is taken.

    Args:
        iou: [E, E], see `overlaps`.
    """
    left = list(range(len(iou)))
    if not left or count < 1:
        return []
    away = iou.clone().fill_diagonal_(0.0)
    chosen = [min(left, key=lambda n: float(away[n].sum()))]
    left.remove(chosen[0])
    while left and len(chosen) < count:
        following = min(left, key=lambda n: (float(iou[n, chosen].max()), float(iou[n, chosen].sum())))
        chosen.append(following)
        left.remove(following)
    return chosen


def mean_overlap(iou: Tensor, chosen: Sequence[int]) -> float:
    """The mean overlap of pairs of those chosen; 0 of a single one."""
    part = iou[list(chosen)][:, list(chosen)]
    pairs = len(chosen) * (len(chosen) - 1)
    return float(part.sum() - part.diagonal().sum()) / pairs if pairs else 0.0
