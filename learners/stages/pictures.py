"""Recorded pictures as judges and policies learn from them: colours and places disturbed a little."""

from __future__ import annotations

import torch
from torch import Tensor

COLOUR = 0.08  # largest change of a channel's gain, and of its offset in units of half the range
SHIFT = 0.02  # largest shift, of the picture's height and width


def augment(pictures: Tensor, generator: torch.Generator, shift: float = SHIFT) -> Tensor:
    """`augmented`, of which the pictures alone count."""
    return augmented(pictures, generator, shift)[0]


def augmented(pictures: Tensor, generator: torch.Generator, shift: float = SHIFT) -> tuple[Tensor, Tensor]:
    """Pictures uint8 [N, V, 3, H, W] with other colours and shifted by whole pixels, alike in all views; and
    by how much things in them have moved, float32 [N, 2], (u, v) as shares of width and height.

    The colours are a random gain and offset per channel (Laskin et al. 2020); a shift repeats the border
    (Kostrikov et al. 2021). Everything is drawn from the generator, on the CPU.
    """
    count = len(pictures)
    draw = torch.rand((2, count, 1, 3, 1, 1), generator=generator).mul(2 * COLOUR).sub(COLOUR)
    gain, offset = draw.to(pictures.device)
    moved, by = _shifted(pictures, generator, shift) if shift else (pictures, torch.zeros(count, 2))
    signed = moved.float().mul_(1 / 127.5).sub_(1.0)
    coloured = signed.mul_(1 + gain).add_(offset).add_(1).mul_(127.5).round_().clamp_(0, 255)
    return coloured.to(torch.uint8), by


def _shifted(pictures: Tensor, generator: torch.Generator, shift: float) -> tuple[Tensor, Tensor]:
    moved, shares = pictures, list[Tensor]()
    for axis in (-2, -1):
        size = pictures.shape[axis]
        most = round(shift * size)
        by = torch.randint(-most, most + 1, (len(pictures), 1), generator=generator)
        shares.insert(0, -by[:, 0].float() / size)  # what is seen at x lay at x + by
        source = (torch.arange(size) + by).clamp(0, size - 1).to(pictures.device)
        shape = [len(pictures), 1, 1, 1, 1]
        shape[axis] = size
        moved = moved.gather(axis, source.reshape(shape).expand_as(moved))
    return moved, torch.stack(shares, 1)
