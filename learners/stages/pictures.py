"""Recorded pictures as judges and policies learn from them: colours disturbed, and where objects are to be
seen.
"""

from __future__ import annotations

import torch
from torch import Tensor

from envs.encoders import Gaze
from envs.episodes.clips import ClipStore
from envs.geometry.cameras import project
from envs.specs import first_objects


def augment(pictures: Tensor, generator: torch.Generator, strength: float = 0.08) -> Tensor:
    """Colour gain and offset per picture and channel, alike in all views; pictures float [N, V, 3, H, W] in
    -1..1.
    """
    draw = torch.rand((2, len(pictures), 1, 3, 1, 1), generator=generator).mul(2).sub(1).to(pictures.device)
    return pictures * (1 + strength * draw[0]) + strength * draw[1]


def sights(store: ClipStore, objects: Tensor, rows: Tensor, count: int) -> Tensor:
    """Where objects [N, S, 4] are in the first view at the cameras of `rows` [N]: [N, count, 2] in
    half-pictures from the middle, NaN where unknown or out of sight.
    """
    owner = torch.searchsorted(store.start, rows, right=True) - 1
    pixels, depth = project(
        first_objects(objects, count)[..., :3], store.intrinsic[owner, 0], store.arrays["c2w"][rows, 0]
    )
    where = pixels / (torch.tensor(store.size[::-1]) / 2) - 1
    return torch.where(((depth > 0.02) & (where.abs() < 1).all(-1))[..., None], where, torch.nan)


def survey(gaze: Gaze, store: ClipStore, rows: Tensor) -> None:
    """Teach `gaze` the ground of its objects by where they are and are seen in frames `rows` [N]."""
    objects = store.arrays["objects"][rows]
    gaze.survey(sights(store, objects, rows, gaze.aims), first_objects(objects, gaze.aims)[..., :2])
