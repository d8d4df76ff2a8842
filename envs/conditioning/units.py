"""Numbers in units of their spread in data, angles by the shortest way round."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

# Spread below which a number is a constant, in any unit in use (metres, radians, degrees, shares): no motor
# moves by less.
RESOLUTION = 1e-4
LEAST_SPREAD = 0.02  # of a state's number: what hardly moves is not blown up
UNTOLD = 1e9  # the unit of numbers that networks are not told
_TURN = 2 * math.pi


class Units(nn.Module):
    """Means and spreads of some numbers of a robot, taken from data.

    Roll, pitch and yaw jump by a whole turn where they pass pi, which a gripper that points down does from
    one episode to the next, or within one. Told by how far they are from their mean, the shortest way, they
    do not, wherever they come from: recordings, a robot, or a decoder that counts on beyond pi.

    Args:
        size: how many numbers.
        angles: positions of those that are angles in radians, if data bear it out: what goes beyond a turn
            either way is counted in something else, or counted on, and is taken as it is.
        least: spreads are at least so large, so that what hardly moves is not blown up.
        still: the unit of numbers that do not vary in the data; None takes `least`, UNTOLD leaves them out.
    """

    mean: Tensor
    std: Tensor
    turn: Tensor

    def __init__(
        self, size: int, angles: Sequence[int] = (), least: float = RESOLUTION, still: float | None = None
    ):
        super().__init__()
        self.angles, self.least, self.still = list(angles), least, still
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))
        self.register_buffer("turn", torch.zeros(size))  # of angles; 0 of all others

    @torch.no_grad()
    def normalise(self, values: Tensor) -> None:
        """Take mean and spread from values [N, size]."""
        values = values.to(self.mean)
        self.turn.zero_()
        for number in self.angles:
            self.turn[number] = _TURN * bool((values[:, number].abs() <= _TURN).all())
        middle = torch.atan2(values.sin().mean(0), values.cos().mean(0))
        self.mean.copy_(torch.where(self.turn > 0, middle, values.mean(0)))
        away = self.shortest(values - self.mean)
        self.mean.add_(torch.where(self.turn > 0, away.mean(0), 0.0))
        spread = self.shortest(values - self.mean).std(0, unbiased=False)
        self.std.copy_(spread.clamp(min=self.least))
        if self.still is not None:
            self.std[spread <= self.least] = self.still

    def shortest(self, changes: Tensor) -> Tensor:
        """Changes [..., size] without whole turns of angles."""
        if not self.angles:
            return changes
        turn = self.turn
        return changes - turn * (changes / torch.where(turn > 0, turn, 1.0)).round()

    def forward(self, values: Tensor) -> Tensor:
        """Values [..., size] in units around the mean."""
        return self.shortest(values - self.mean) / self.std

    def change(self, values: Tensor, since: Tensor) -> Tensor:
        """How far values [..., size] are from others, in units."""
        return self.shortest(values - since) / self.std

    def values(self, told: Tensor) -> Tensor:
        """The inverse of `forward`, up to whole turns."""
        return told * self.std + self.mean
