"""Where an object is in a picture, by its colour: the measuring stick for generated video.

The object's colour is read off the first, real frame at its known position; later frames are searched for it.
Nothing is trained with this and no policy sees it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from envs.geometry.cameras import project

_NEAR = 0.22  # colour distance (RGB in 0..1) within which a pixel is the object's
_FEWEST = 3.0  # pixels (weighted) below which the object counts as lost


def locate(
    frames: Tensor, first: Tensor, start: Tensor, intrinsic: Tensor, c2w: Tensor
) -> tuple[Tensor, Tensor]:
    """Find an object in the frames of one fixed camera.

    Args:
        frames: uint8 [..., T, 3, H, W].
        first: uint8 [..., 3, H, W], a real frame in which the object is at `start`.
        start: [..., 3] metres, the object's centre.
        intrinsic: [..., 3, 3] pixels; c2w: [..., 4, 4].

    Returns:
        pixels float32 [..., T, 2] (NaN where lost) and lost bool [..., T].
    """
    at, _ = project(start.unsqueeze(-2), intrinsic, c2w)
    height, width = frames.shape[-2:]
    column = at[..., 0, 0].round().long().clamp(1, width - 2)
    row = at[..., 0, 1].round().long().clamp(1, height - 2)
    flat = first.float().div(255).flatten(-2)  # [..., 3, H*W]
    samples = []
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            index = ((row + dy) * width + column + dx)[..., None, None].expand(*flat.shape[:-1], 1)
            samples.append(flat.gather(-1, index))
    colour = torch.cat(samples, -1).median(-1).values  # [..., 3]
    distance = (frames.float().div(255) - colour[..., None, :, None, None]).norm(dim=-3)
    weight = (1 - distance / _NEAR).clamp(min=0)
    mass = weight.sum((-2, -1))
    u = torch.arange(width, device=frames.device) + 0.5
    v = torch.arange(height, device=frames.device) + 0.5
    pixels = torch.stack(((weight.sum(-2) * u).sum(-1), (weight.sum(-1) * v).sum(-1)), -1) / mass.clamp(
        min=1e-6
    ).unsqueeze(-1)
    lost = mass < _FEWEST
    return torch.where(lost.unsqueeze(-1), torch.nan, pixels), lost
