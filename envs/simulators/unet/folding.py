"""Squares of pixels: into channels, out of them, and into one pixel."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

_WIDE = {2: torch.int16, 4: torch.int32, 8: torch.int64, 16: torch.complex128}  # by bytes


def fold(pictures: Tensor, edge: int) -> Tensor:
    """Pictures [B, C, H, W] as [B, H / edge, W / edge, C * edge * edge]; floats pass gradients.

    Of bytes, a row of a square, of 4, 8 or 16, is copied as one number, which is several times faster than
    pixel by pixel.
    """
    if pictures.is_floating_point():
        return F.pixel_unshuffle(pictures, edge).permute(0, 2, 3, 1)
    batch, channels, height, width = pictures.shape
    rows = pictures.contiguous().view(_WIDE[edge * pictures.element_size()])
    squares = (
        rows.view(batch, channels, height // edge, edge, width // edge).permute(0, 2, 4, 1, 3).contiguous()
    )
    return squares.view(pictures.dtype).flatten(3)


def unfold(maps: Tensor, edge: int) -> Tensor:
    """The reverse of fold, with gradient: [B, h, w, C * edge * edge] -> [B, C, edge h, edge w]; fastest where
    the channels lie side by side.
    """
    if edge * maps.element_size() not in _WIDE:
        return F.pixel_shuffle(maps.permute(0, 3, 1, 2), edge)
    out: Tensor = _Unfold.apply(maps, edge)
    return out


class _Unfold(torch.autograd.Function):
    """See unfold; torch does not know the gradient of reading numbers as others."""

    @staticmethod
    def forward(ctx: Any, maps: Tensor, edge: int) -> Tensor:
        """See unfold."""
        ctx.edge = edge
        batch, height, width, channels = maps.shape
        rows = maps.contiguous().view(_WIDE[edge * maps.element_size()])
        squares = (
            rows.view(batch, height, width, channels // edge**2, edge).permute(0, 3, 1, 4, 2).contiguous()
        )
        return squares.view(maps.dtype).view(batch, channels // edge**2, height * edge, width * edge)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """Squares of gradients as channels."""
        return fold(gradient, ctx.edge), None
