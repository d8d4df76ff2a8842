"""A Gaussian over whole action chunks: the randomness lives in a few knots, so that exploration is smooth in time."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.distributions import Distribution, constraints


def knot_basis(chunk: int, knots: int) -> Tensor:
    """Linear interpolation [chunk, knots] from rest at time 0 through knots spread evenly up to the chunk's end."""
    times = torch.arange(1, chunk + 1, dtype=torch.float32)
    at = torch.linspace(0, chunk, knots + 1)
    hats = torch.stack([(1 - (times - at[k]).abs() * knots / chunk).clamp(min=0) for k in range(1, knots + 1)], 1)
    return hats


class ChunkGaussian(Distribution):
    """chunk = offset + gain * basis @ knots with knots ~ Normal(loc, scale); dimensions with gain 0 are constant.

    The density is that of the knots; a chunk determines them exactly (the basis has full column rank), so
    likelihood ratios are those of the chunk.

    Args:
        loc: [..., n, A] mean knots in normalised units.
        scale: [..., n, A] standard deviations.
        basis: [K, n]; gain and offset: [A] in action units.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {"loc": constraints.real, "scale": constraints.positive}
    has_rsample = True

    def __init__(self, loc: Tensor, scale: Tensor, basis: Tensor, gain: Tensor, offset: Tensor, validate_args: bool | None = None):
        self.loc, self.scale = loc, scale
        shared = basis.ndim - 2  # TensorDict hands shared tensors over with batch dimensions; every row is the same
        self.basis = basis[(0,) * shared]
        self.gain, self.offset = gain[(0,) * (gain.ndim - 1)], offset[(0,) * (offset.ndim - 1)]
        self.active = self.gain > 0
        super().__init__(loc.shape[:-2], torch.Size([self.basis.shape[0], loc.shape[-1]]), validate_args=False)

    def _decode(self, knots: Tensor) -> Tensor:
        return self.offset + self.gain * (self.basis @ knots)

    def _encode(self, chunk: Tensor) -> Tensor:
        safe = torch.where(self.active, self.gain, 1.0)
        return torch.linalg.pinv(self.basis) @ ((chunk - self.offset) / safe)

    @property
    def mean(self) -> Tensor:
        return self._decode(self.loc)

    @property
    def mode(self) -> Tensor:
        return self.mean

    deterministic_sample = mean

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        shape = (*sample_shape, *self.loc.shape)
        return self._decode(self.loc + self.scale * torch.randn(shape, device=self.loc.device))

    def sample(self, sample_shape: Any = ()) -> Tensor:
        with torch.no_grad():
            return self.rsample(sample_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        normal = torch.distributions.Normal(self.loc, self.scale)
        return (normal.log_prob(self._encode(value)) * self.active).sum((-2, -1))

    def entropy(self) -> Tensor:
        return (torch.distributions.Normal(self.loc, self.scale).entropy() * self.active).sum((-2, -1))
