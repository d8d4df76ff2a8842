"""Where an object is in video, by its colour: the measuring stick for generated video.

The object's colour is read off the first, real frame at its known position. A colour is seldom unique in a
whole picture, so the object is followed from frame to frame: it is looked for no further from where it was
found last than it may have gone since. Where it truly is nobody tells the locator, so that its error on true
video is its own. Nothing is trained with this and no policy sees it.
"""

from __future__ import annotations

import torch
from torch import Tensor

_NEAR = 0.22  # colour distance (RGB in 0..1) within which a pixel is the object's
_FEWEST = 3.0  # pixels (weighted) below which the object counts as lost
_REACH = 1 / 8  # of the picture's shorter side: how far from its middle pixels may be the object's
_STEPS = 3  # in which the middle is found


def follow(frames: Tensor, first: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """Find an object in the video of one fixed camera.

    Args:
        frames: uint8 [N, T, 3, H, W], generated or true.
        first: uint8 [N, 3, H, W], the real frame before them.
        true: float [N, 1 + T, 2] pixels, where the object's centre truly is in first and in each frame: it is
            at true[:, 0] in first; of the others only how far it goes is used.

    Returns:
        pixels float32 [N, T, 2] (NaN where lost) and lost bool [N, T].
    """
    height, width = frames.shape[-2:]
    reach = _REACH * min(height, width)
    colour = _colour(first, true[:, 0])[:, :, None, None]
    gone = (true[:, 1:] - true[:, :-1]).norm(dim=-1)
    v, u = torch.arange(height)[:, None] + 0.5, torch.arange(width) + 0.5
    last = true[:, 0].float()  # where it was found last
    since = torch.zeros(len(frames))  # how far it went since
    found, lost = [], []
    for t in range(frames.shape[1]):
        weight = (1 - (frames[:, t].float().div(255) - colour).norm(dim=1) / _NEAR).clamp(min=0)
        since = since + gone[:, t]
        middle, within = last, reach + since
        for _ in range(_STEPS):
            off = (u - middle[:, :1, None]).square() + (v - middle[:, 1:, None]).square()
            near = weight * (off <= within.square()[:, None, None])
            mass = near.sum((1, 2))
            there = mass >= _FEWEST
            centre = torch.stack(((near * u).sum((1, 2)), (near * v).sum((1, 2))), -1)
            centre = centre / mass.clamp(min=1e-6)[:, None]
            middle = torch.where(there[:, None], centre, middle)
            within = torch.full_like(within, reach)
        last, since = torch.where(there[:, None], middle, last), torch.where(there, 0.0, since)
        found.append(torch.where(there[:, None], middle, torch.nan))
        lost.append(~there)
    return torch.stack(found, 1), torch.stack(lost, 1)


def _colour(first: Tensor, at: Tensor) -> Tensor:
    """Median colour [N, 3] in 0..1 of the nine pixels about `at` [N, 2] in pictures uint8 [N, 3, H, W]."""
    height, width = first.shape[-2:]
    column = at[:, 0].floor().long().clamp(1, width - 2)
    row = at[:, 1].floor().long().clamp(1, height - 2)
    around, here = torch.arange(-1, 2), torch.arange(len(first))[:, None, None]
    rows, columns = row[:, None, None] + around[:, None], column[:, None, None] + around
    return first.float().div(255)[here, :, rows, columns].flatten(1, 2).median(1).values
