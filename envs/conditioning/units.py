"""Numbers in units of their spread in data, orientations told the nearest way."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from envs.conditioning.turns import Turns

# Spread below which a number is a constant, in any unit in use (metres, radians, degrees, shares): no motor
# moves by less.
RESOLUTION = 1e-4
LEAST_SPREAD = 0.02  # of a state's number: what hardly moves is not blown up
UNTOLD = 1e9  # the unit of numbers that networks are not told


class Units(nn.Module):
    """Means and spreads of some numbers of a robot, taken from data.

    Orientations are told as near to their mean as may be, so that they do not jump, wherever they come from:
    recordings, a robot, or a decoder that counts on beyond pi (turns.py).

    Args:
        size: how many numbers.
        rotations: positions of the numbers of each orientation, see Turns.
        least: spreads are at least so large, so that what hardly moves is not blown up.
        still: the unit of numbers that do not vary in the data; None takes `least`, UNTOLD leaves them out.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        size: int,
        rotations: Sequence[Sequence[int]] = (),
        least: float = RESOLUTION,
        still: float | None = None,
    ):
        super().__init__()
        self.least, self.still = least, still
        self.turns = Turns(size, rotations)
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    @torch.no_grad()
    def normalise(self, values: Tensor) -> None:
        """Take mean and spread from values [N, size]."""
        values = values.to(self.mean)
        self.mean.copy_(self.turns.fit(values))
        spread = self.turns.nearest(values, self.mean).std(0, unbiased=False)
        self.std.copy_(spread.clamp(min=self.least))
        if self.still is not None:
            self.std[spread <= self.least] = self.still

    def forward(self, values: Tensor) -> Tensor:
        """Values [..., size] in units around the mean."""
        return self.change(values, self.mean)

    def moves(self, values: Tensor, since: Tensor) -> Tensor:
        """How far values [..., size] are from others, in their own units."""
        return self.turns.nearest(values, since) - since

    def change(self, values: Tensor, since: Tensor) -> Tensor:
        """How far values [..., size] are from others, in units."""
        return self.moves(values, since) / self.std

    def values(self, told: Tensor) -> Tensor:
        """The inverse of `forward`, up to how orientations are told."""
        return told * self.std + self.mean
