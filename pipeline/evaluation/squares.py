"""Where the squares of the gridworld are in generated pictures, against where they truly were."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.episodes.privileged import read_privileged
from envs.physics.gridworld import COLOURS, EDGE, SIDE
from envs.simulators.replay import Replay
from pipeline.evaluation.objects.error import POSES
from pipeline.evaluation.statistics import mean, quantiles

_NEAR = 90.0  # grey levels by which a pixel may differ from a square's colour, in its worst channel
_HIDDEN = 0.35  # share of a square's area below which it is not counted as seen


def find_squares(frames: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Middles float [..., count, 2] = (x, y) in pixels of a 256 x 256 picture, and which squares are seen,
    bool [..., count], in pictures uint8 [..., 3, H, W].

    A square's middle is that of its colour, pixels weighted by how near they are to it.
    """
    height, width = frames.shape[-2:]
    colours = torch.tensor(list(COLOURS.values())[:count]).float()
    gap = (frames.float()[..., None, :, :, :] - colours[:, :, None, None]).abs().amax(-3)
    weight = (1 - gap / _NEAR).clamp(min=0)
    mass = weight.sum((-2, -1))
    x, y = ((torch.arange(n) + 0.5) * EDGE / n for n in (width, height))
    place = torch.stack([(weight.sum(-2) * x).sum(-1), (weight.sum(-1) * y).sum(-1)], -1)
    seen = mass > _HIDDEN * height * width * (SIDE / EDGE) ** 2
    return place / mass.clamp(min=1e-6)[..., None], seen


def square_errors(store: ClipStore, episodes: Tensor, made: Replay, steps: tuple[int, ...]) -> dict[str, Any]:
    """Distance of generated from true middles in pixels of a 256 x 256 picture, after some numbers of steps.

    Squares that the finder does not see in the true picture, for others lie over them, are left out.

    Returns:
        by step: error (median and 90th percentile) of squares that are seen, None if all are lost; `lost`,
        the share that is; `still`, the median error of whoever takes the squares to stay where they began;
        and `finder`, the finder's own on true pictures. All are None where no true picture shows a square.

    Raises:
        ValueError: if the data do not say where squares were.
    """
    poses = read_privileged(store, POSES)
    if poses is None:
        raise ValueError(f"the data have no column {POSES}; record them with task=gridworld")
    places = EDGE * poses[..., :2].float()
    count = places.shape[1]
    out: dict[str, Any] = {}
    for step in steps:
        rows = made.rows[:, step - 1]
        truth, first = places[rows], places[store.start[episodes]]
        known, shown = find_squares(store.frames(rows)[:, 0], count)
        found, seen = find_squares(made.frames[:, step - 1, 0], count)
        use = shown & made.valid[:, step - 1, None]
        still, finder = (quantiles((place - truth).norm(dim=-1)[use]) for place in (first, known))
        out[str(step)] = {
            "error": quantiles((found - truth).norm(dim=-1)[use & seen]),
            "lost": mean((~seen)[use].float()),
            "still": None if still is None else still["median"],
            "finder": None if finder is None else finder["median"],
        }
    return out
