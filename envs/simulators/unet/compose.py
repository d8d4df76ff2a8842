"""Frames composed from moved and drawn sources, and where their errors count."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

SOURCES = 4  # last frame, first frame, last frame moved by the flow, drawn colour
_REACH = 8.0  # pixels that one unit of flow moves
_CHANGE = 0.1  # of 0..1: a pixel that differs by so much counts as moved


def compose(maps: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """Frames [B, K, 3, H, W] in about 0..1.

    Args:
        maps: [B, K, SOURCES + 5, H, W]: logits of the sources, flow (x, y), colour in about -1..1.
        first, last: the first remembered frame and the last, [B, 3, H, W] in 0..1.
    """
    _, chunk, _, height, width = maps.shape
    # Split, not sliced: the gradient of a slice is a full map of zeros.
    logits, flow, colour = maps.split((SOURCES, 2, 3), 2)
    still, begun, moves, drawn = logits.softmax(2).split(1, 2)
    step = 2 * _REACH / torch.tensor([width, height], device=maps.device)
    grid = torch.addcmul(pixel_grid(height, width, maps.device), flow.permute(0, 1, 3, 4, 2), step)
    # All frames of a chunk are sampled from one picture: stack them as rows of one tall grid.
    moved = F.grid_sample(last, grid.flatten(1, 2), padding_mode="border", align_corners=False)
    moved = moved.unflatten(2, (chunk, height)).transpose(1, 2)
    out = torch.addcmul(still * last[:, None], begun, first[:, None])
    return torch.addcmul(torch.addcmul(out, moves, moved), drawn, 0.5 + 0.5 * colour)


def motion_weight(truth: Tensor, first: Tensor, last: Tensor, gain: float) -> Tensor:
    """Loss weights [B, K, 1, H, W] of true frames [B, K, 3, H, W]: 1, and up to `gain` more where they differ
    from the
    last remembered frame or from the first, [B, 3, H, W]; floats in 0..1."""
    moved = torch.maximum((truth - last[:, None]).abs(), (truth - first[:, None]).abs()).amax(2, keepdim=True)
    return 1 + gain * (moved / _CHANGE).clamp(max=1)


def pixel_grid(height: int, width: int, device: torch.device) -> Tensor:
    """Middles of all pixels [H, W, 2] as (x, y) in -1..1, as grid_sample has them without aligned corners."""
    x = (torch.arange(width, device=device) * 2 + 1) / width - 1
    y = (torch.arange(height, device=device) * 2 + 1) / height - 1
    return torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], -1)
