"""How commands, or an instruction, condition every block of a world of tokens.

They come as a few tokens per frame, `cond` [B, T, N, width], which are read by cross-attention, as in
RoboScape-R, or modulate the norms (adaLN, Peebles & Xie 2023).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch.nn.functional as F
from torch import Tensor, nn

from envs.ranges import Count
from envs.simulators.row_linear import RowLinear
from envs.simulators.tokens.layers import TokenAttention

PARTS = 3  # of a block that are modulated: attention over space, over time, feed-forward


class Reader(nn.Module):
    """The part of a block that reads `cond`; x are tokens [B, T, P, width]."""

    def norm(self, part: int, x: Tensor, cond: Tensor) -> Tensor:
        """The input of one of the block's parts."""
        raise NotImplementedError

    def gate(self, part: int, update: Tensor, cond: Tensor) -> Tensor:
        """What one of the block's parts adds."""
        return update

    def read(self, x: Tensor, cond: Tensor) -> Tensor:
        """The tokens after they have read `cond`; here nothing is read directly."""
        return x


class Conditioning(Protocol):
    """A way to condition blocks; a config names its class.

    Attributes:
        tokens: per frame that commands become.
    """

    @property
    def tokens(self) -> int:
        """See the class."""

    def reader(self, width: int, heads: int) -> Reader:
        """The part of a new block that reads `cond`."""


@dataclass(frozen=True)
class CrossAttention:
    """Every token attends to the `cond` tokens of its frame.

    Args:
        tokens: per frame that commands become: of one alone every place would read the same.
    """

    tokens: Count

    def reader(self, width: int, heads: int) -> Reader:
        """See Conditioning."""
        return _Attending(width, heads)


@dataclass(frozen=True)
class AdaLN:
    """The mean of a frame's `cond` shifts, scales and gates all its tokens alike."""

    tokens: Count = 1

    def reader(self, width: int, heads: int) -> Reader:
        """See Conditioning."""
        return _Modulated(width)


class _Attending(Reader):
    def __init__(self, width: int, heads: int):
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(PARTS + 1))
        self.attn = TokenAttention(width, heads)

    def norm(self, part: int, x: Tensor, cond: Tensor) -> Tensor:
        return self.norms[part](x)

    def read(self, x: Tensor, cond: Tensor) -> Tensor:
        return x + self.attn(self.norms[PARTS](x), self.attn.keys_of(cond))


class _Modulated(Reader):
    """Begins with the identity: gates start at zero."""

    def __init__(self, width: int):
        super().__init__()
        self.width = width
        self.maps = nn.ModuleList(RowLinear(width, 3 * width) for _ in range(PARTS))
        for parameter in self.maps.parameters():
            nn.init.zeros_(parameter)

    def norm(self, part: int, x: Tensor, cond: Tensor) -> Tensor:
        shift, scale, _ = self._values(part, cond)
        return F.layer_norm(x, (self.width,)) * (1 + scale) + shift

    def gate(self, part: int, update: Tensor, cond: Tensor) -> Tensor:
        return update * self._values(part, cond)[2]

    def _values(self, part: int, cond: Tensor) -> tuple[Tensor, ...]:
        """Shift, scale and gate of a part, each [B, T, 1, width]."""
        return self.maps[part](F.silu(cond.mean(2, keepdim=True))).chunk(3, -1)
