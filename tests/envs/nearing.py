"""Frames that come nearer to golden goals, which text worlds of random weights make much like the first."""

from __future__ import annotations

import torch
from torch import Tensor

from envs.judges.golden_goal import GoldenGoalJudge

_ROUNDS, _TRIED = 16, 12
_PATCH = 8  # pixels
_CHANGED = 0.05  # share of the patches, in every round


def nearing(judge: GoldenGoalJudge, first: Tensor, instruction: list[str]) -> Tensor:
    """Frames uint8 [B, V, 3, H, W]: first frames of that shape with noise in some patches, of which in every
    round that stays which brings the judge's goal nearer.
    """
    g = torch.Generator().manual_seed(0)
    goals, best = judge.goals(first, instruction).frames, first
    batch, views, _, height, width = first.shape
    for _ in range(_ROUNDS):
        grid = torch.rand(batch, _TRIED, views, 1, height // _PATCH, width // _PATCH, generator=g) < _CHANGED
        grid[:, 0] = False
        noise = torch.randint(0, 256, (batch, _TRIED, *first.shape[1:]), dtype=torch.uint8, generator=g)
        mask = grid.repeat_interleave(_PATCH, -1).repeat_interleave(_PATCH, -2)
        tried = torch.where(mask, noise, best[:, None])
        best = tried[torch.arange(batch), judge.away(tried, goals).argmin(1)]
    return best
