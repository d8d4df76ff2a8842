"""Layers of the U-Net engine."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.precision import working_dtype
from envs.simulators.unet.folding import fold

FOLD = 4  # pixels folded into channels, both ways


class FilmBlock(nn.Module):
    """Residual block of two 3x3 convolutions whose middle is scaled and shifted by the actions (FiLM).

    Args:
        width: channels, a multiple of 8.
        cond: numbers of the conditioning vector.
    """

    def __init__(self, width: int, cond: int):
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(8, width), nn.GroupNorm(8, width)
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        self.film = nn.Linear(cond, 2 * width)
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.film.weight)
        nn.init.zeros_(self.film.bias)

    def forward(self, x: Tensor, cond: Tensor) -> Tensor:
        """[B, width, h, w] of the same, and [B, cond]."""
        h = self.conv1(F.silu(self.norm1(x)))
        scale, shift = self.film(cond)[..., None, None].chunk(2, 1)
        h = self.conv2(F.silu(self.norm2(h) * (1 + scale) + shift))
        return x + h


class Embed(nn.Module):
    """Looks at one view, square by square.

    Args:
        channels: of the pictures, which are bytes.
        width: of what comes out.
        shrink: 2 looks at the mean of each four pixels, 1 at all.
    """

    def __init__(self, channels: int, width: int, shrink: int):
        super().__init__()
        self.shrink = shrink
        bound = channels**-0.5 / FOLD
        self.weight = nn.Parameter(torch.empty(width, channels, FOLD, FOLD).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(width).uniform_(-bound, bound))

    def forward(self, pictures: Tensor) -> Tensor:
        """[B, width, h / 4, w / 4] of pictures uint8 [B, C, shrink h, shrink w]."""
        dtype = working_dtype(pictures.device, self.weight.dtype)
        weight: Tensor = self.weight
        if self.shrink > 1:
            weight = (
                weight.repeat_interleave(self.shrink, 2).repeat_interleave(self.shrink, 3) / self.shrink**2
            )
        # Bytes stay what they are; that they are meant as -1..1 is left to the weights.
        weight = weight.flatten(1)
        folded = fold(pictures, FOLD * self.shrink).to(dtype)
        return F.linear(folded, weight / 127.5, self.bias - weight.sum(1)).permute(0, 3, 1, 2)


def output_head(width: int, chunk: int, maps: int) -> nn.Sequential:
    """Output layer of one view; it starts from the last frame, for random output takes hundreds of steps to
    unlearn.
    """
    last = nn.Conv2d(width, maps * chunk * FOLD**2, 1)
    bias = torch.zeros(chunk, maps, FOLD**2)
    bias[:, 0] = 3.0
    nn.init.zeros_(last.weight)
    last.bias = nn.Parameter(bias.flatten())
    return nn.Sequential(nn.GroupNorm(8, width), nn.SiLU(), last)


def at_detail(pictures: Tensor, shrink: int) -> Tensor:
    """Bytes [B, 3, H, W] as float in 0..1, with shrink = 2 the mean of each four pixels."""
    x = pictures.float().div_(255)
    if shrink == 1:
        return x
    # Four sums are faster than torch's pooling.
    return (x[..., ::2, ::2] + x[..., 1::2, ::2] + x[..., ::2, 1::2] + x[..., 1::2, 1::2]) / 4
