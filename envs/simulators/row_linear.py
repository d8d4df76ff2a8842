"""A linear layer whose rows do not depend on the batch they are in."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

_ROWS = 16


class RowLinear(nn.Linear):
    """nn.Linear on rows padded to a multiple of sixteen.

    CPU libraries multiply odd rows at the end of a matrix by other kernels, which round otherwise: an episode
    would differ in its last bits by the slot it is in. For the small matrices of conditioning, padding costs
    nothing.

    Examples:
        >>> layer, x = RowLinear(40, 256), torch.randn(5, 40)
        >>> torch.equal(layer(x)[4:], layer(x[4:]))
        True
    """

    def forward(self, rows: Tensor) -> Tensor:
        """[B, out_features] of [B, in_features]."""
        padded = F.pad(rows, (0, 0, 0, -len(rows) % _ROWS))
        return F.linear(padded, self.weight, self.bias)[: len(rows)]
