"""From noise to latents: the three ways a velocity network is followed, each a few lines over the same call.

A velocity network sees z at level s in 0..1, z = (1 - s) x + s e of data x and noise e, and says e - x.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, Protocol

import torch
from torch import Tensor

Velocity = Callable[[Tensor, float], Tensor]

# Sigmas of the released four-step student: TrigFlow times pi/2, atan 15, atan 5, atan 5/3 as s = sigma / (1 +
# sigma).
DISTILLED = (1.0, 0.9375, 0.8333, 0.625)


class Sampler(Protocol):
    """Turns standard normal noise into data by asking for velocities."""

    @property
    def evaluations(self) -> int:
        """Velocities asked for."""

    @property
    def jumps(self) -> bool:
        """Whether each step goes straight to the data, which only a few-step student does well."""

    def __call__(self, velocity: Velocity, noise: Tensor) -> Tensor:
        """Data like `noise`; `velocity` is called with z and its level, last with the level whose features
        are kept.
        """


def shifted_levels(steps: int, shift: float) -> list[float]:
    """The levels of so many steps in falling order, from 1, with the 0 at which they end.

    Args:
        shift: 1 makes equal steps, more than 1 spends more of them near noise.
    """
    even = torch.linspace(1.0, 0.0, steps + 1)
    levels: list[float] = (shift * even / (1 + (shift - 1) * even)).tolist()
    return levels


@dataclass(frozen=True)
class Euler:
    """Straight steps along the flow (flow matching, Lipman et al. 2022).

    Args:
        steps: of the solver.
        shift: 1 makes equal steps, more than 1 spends more of them near noise.
    """

    steps: int
    shift: float
    jumps: ClassVar[bool] = False

    @property
    def evaluations(self) -> int:
        """See Sampler."""
        return self.steps

    def __call__(self, velocity: Velocity, noise: Tensor) -> Tensor:
        """See Sampler."""
        z = noise
        for level, following in pairwise(shifted_levels(self.steps, self.shift)):
            z = z + (following - level) * velocity(z, level)
        return z


@dataclass(frozen=True)
class Distilled:
    """The few-step student of GE-Sim 2.0: jump to the data, and back to the next level with the same noise
    each time.

    Args:
        sigmas: levels in falling order, below 1 but for the first; the default is the released student's.
    """

    sigmas: tuple[float, ...] = DISTILLED
    jumps: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if (
            not self.sigmas
            or any(not 0 < s <= 1 for s in self.sigmas)
            or list(self.sigmas) != sorted(self.sigmas, reverse=True)
        ):
            raise ValueError(f"sigmas={list(self.sigmas)} must fall from at most 1 and stay above 0")

    @property
    def evaluations(self) -> int:
        """See Sampler."""
        return len(self.sigmas)

    def before(self, number: int, velocity: Velocity, noise: Tensor) -> Tensor:
        """What step `number`, counted from 0, sees at its level."""
        z = noise
        for level, following in pairwise(self.sigmas[: number + 1]):
            data = z - level * velocity(z, level)
            z = (1 - following) * data + following * noise
        return z

    def __call__(self, velocity: Velocity, noise: Tensor) -> Tensor:
        """See Sampler."""
        z, last = self.before(self.evaluations - 1, velocity, noise), self.sigmas[-1]
        return z - last * velocity(z, last)


def few_steps(steps: int, shift: float) -> Distilled:
    """The sampler of a student of so many steps: jumps from the levels at which Euler steps would begin. The
    released student's are four of shift 5.
    """
    return Distilled(tuple(shifted_levels(steps, shift)[:-1]))


@dataclass(frozen=True)
class EDM:
    """The undistilled sampler: Euler steps in the variance-exploding frame of Karras et al. 2022, y = x +
    sigma e. The defaults are those of the released GE-Sim 1, which a checkpoint's scheduler may change.

    Args:
        steps: of the solver.
        sigma_max, sigma_min: noise at the first and at the last step; the last step has no length, as
            released.
        rho: spacing of the levels.
    """

    steps: int = 15
    sigma_max: float = 80.0
    sigma_min: float = 0.002
    rho: float = 7.0
    jumps: ClassVar[bool] = False

    @property
    def evaluations(self) -> int:
        """See Sampler."""
        return self.steps

    def sigmas(self) -> list[float]:
        """Noise of each step in falling order."""
        high, low = self.sigma_max ** (1 / self.rho), self.sigma_min ** (1 / self.rho)
        return (
            (high + torch.linspace(0, 1, self.steps, dtype=torch.float64) * (low - high)) ** self.rho
        ).tolist()

    def __call__(self, velocity: Velocity, noise: Tensor) -> Tensor:
        """See Sampler."""
        sigmas = self.sigmas()
        y = noise * sigmas[0]
        for sigma, following in pairwise((*sigmas, sigmas[-1])):
            level = sigma / (sigma + 1)
            z = y * (1 - level)  # the same point in the flow's frame
            data = z - level * velocity(z, level)
            y = y + (following - sigma) * (y - data) / sigma
        return y
