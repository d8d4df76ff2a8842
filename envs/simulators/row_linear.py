"""A linear layer whose rows do not depend on the batch they are in."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

_ROWS = 16


class RowLinear(nn.Linear):
    """nn.Linear on rows padded to a multiple of sixteen.

    CPU libraries multiply odd rows at the end of a matrix by other kernels, which round otherwise: an episode
    would differ in its last bits by the slot it is in. For the small matrices of conditioning, padding costs
    nothing, and large ones of even size are not copied.

    Examples:
        >>> layer, x = RowLinear(40, 256), torch.randn(5, 40)
        >>> torch.equal(layer(x)[4:], layer(x[4:]))
        True
    """

    def forward(self, rows: Tensor) -> Tensor:
        """[..., out_features] of [..., in_features]."""
        return row_linear(rows, self.weight, self.bias)


def row_linear(rows: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """[..., out] of rows [..., in] and a weight [out, in]; see RowLinear."""
    flat = rows.flatten(0, -2)
    if missing := -len(flat) % _ROWS:
        flat = F.pad(flat, (0, 0, 0, missing))
    out = F.linear(flat, weight, bias)
    return out[: len(out) - missing].unflatten(0, rows.shape[:-1])
