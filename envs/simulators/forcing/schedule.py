"""Noise levels of diffusion forcing: the sigmoid schedule, and the DDIM steps that follow it.

As everywhere in samplers.py, noisy latents are z = (1 - s) x + s e of data x, noise e and level s in 0..1.
Schedules of signal and noise whose squares add up to 1 show the network z scaled to unit variance
(`unit_parts`), and their DDIM steps are straight steps in z.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor

from envs.simulators.samplers import Velocity


@dataclass(frozen=True)
class Sigmoid:
    """The sigmoid schedule (Jabri et al. 2022) over times 0 (data) .. 1 (noise).

    Args:
        start, end: of the stretch of the sigmoid that is used.
        temperature: by which it is flattened.

    Raises:
        ValueError: unless end is above start, and temperature above 0.

    Examples:
        >>> Sigmoid(-3.0, 3.0, 1.0).levels(2)
        [1.0, 0.5, 0.0]
    """

    start: float
    end: float
    temperature: float

    def __post_init__(self) -> None:
        if self.temperature <= 0 or self.end <= self.start:
            raise ValueError(
                f"start={self.start}, end={self.end}, temperature={self.temperature} are no schedule: end"
                " must be above start, and temperature above 0"
            )

    def level(self, time: Tensor) -> Tensor:
        """Level s, like `time` in 0..1; the share of the signal's variance falls along the sigmoid."""
        ends = torch.tensor([self.start, self.end], dtype=time.dtype, device=time.device)
        low, high = torch.sigmoid(ends / self.temperature)
        at = torch.sigmoid((time * (self.end - self.start) + self.start) / self.temperature)
        signal = ((high - at) / (high - low)).clamp(0, 1)
        noise = (1 - signal).sqrt()
        return noise / (signal.sqrt() + noise)

    def levels(self, steps: int) -> list[float]:
        """The levels between so many steps of equal time, falling from 1 to 0."""
        return [*self.level(torch.linspace(1, 0, steps + 1, dtype=torch.float64)).tolist()[:-1], 0.0]


@dataclass(frozen=True)
class DDIM:
    """Deterministic steps (Song et al. 2021) from noise to data.

    Args:
        levels: falling from 1 to 0.
    """

    levels: Sequence[float]
    jumps: ClassVar[bool] = False

    @property
    def evaluations(self) -> int:
        """See Sampler."""
        return len(self.levels) - 1

    def __call__(self, velocity: Velocity, noise: Tensor) -> Tensor:
        """Data like `noise`; `velocity` is called with z and its level."""
        z = noise
        for level, following in pairwise(self.levels):
            z = z + (following - level) * velocity(z, level)
        return z


def unit_parts(level: Tensor) -> tuple[Tensor, Tensor]:
    """Signal and noise, like `level`, of the same mixture at unit variance: their squares add up to 1."""
    size = ((1 - level).square() + level.square()).sqrt()
    return (1 - level) / size, level / size
