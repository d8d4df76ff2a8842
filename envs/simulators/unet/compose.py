"""Frames composed from remembered, moved and drawn sources."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

DRAWN = 4  # maps of the drawn source: its logit and its colour
LOGIT_GAIN = 3.0  # on the choice between sources, so that it soon becomes one
_REACH = 8.0  # pixels that one unit of flow moves
_CHANGE = 0.25  # of 0..1: a pixel that differs by so much counts as changed in full


def compose(maps: Tensor, flow: Tensor, memory: Tensor) -> Tensor:
    """Frames [B, K, 3, H, W] in about 0..1.

    Args:
        maps: [B, K, M + 1 + DRAWN, H, W]: logits of the M remembered frames, the moved and the drawn one,
            then the drawn colour in about -1..1.
        flow: [B, K, 2, H, W] from a frame to the last remembered one (x, y).
        memory: [B, M, 3, H, W] remembered frames in 0..1, the last one last.
    """
    count, height, width = memory.shape[1], *maps.shape[-2:]
    # Split, not sliced: the gradient of a slice is a full map of zeros.
    logits, colour = maps.split((count + 2, 3), 2)
    still, moves, drawn = (LOGIT_GAIN * logits).softmax(2).split((count, 1, 1), 2)
    step = 2 * _REACH / torch.tensor([width, height], device=maps.device)
    grid = torch.addcmul(pixel_grid(height, width, maps.device), flow.permute(0, 1, 3, 4, 2), step)
    # All frames of a chunk are sampled from one picture: stack them as rows of one tall grid.
    moved = F.grid_sample(memory[:, -1], grid.flatten(1, 2), padding_mode="border", align_corners=False)
    moved = moved.unflatten(2, (maps.shape[1], height)).transpose(1, 2)
    out = torch.addcmul(moves * moved, drawn, 0.5 + 0.5 * colour)
    for number in range(count):
        out = torch.addcmul(out, still[:, :, number, None], memory[:, None, number])
    return out


def changed(frames: Tensor, last: Tensor) -> Tensor:
    """How much pixels of frames [B, K, 3, H, W] differ from the frame before, [B, 3, H, W]: 0..1, [B, K, 1,
    H, W].
    """
    return ((frames - last[:, None]).abs().amax(2, keepdim=True) / _CHANGE).clamp(max=1)


def pixel_grid(height: int, width: int, device: torch.device) -> Tensor:
    """Middles of all pixels [H, W, 2] as (x, y) in -1..1, as grid_sample has them without aligned corners."""
    x = (torch.arange(width, device=device) * 2 + 1) / width - 1
    y = (torch.arange(height, device=device) * 2 + 1) / height - 1
    return torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], -1)
