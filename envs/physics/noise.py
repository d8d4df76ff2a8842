"""What bends scripted behaviours towards chance, whatever the suite: a slow drift, and random way-points that
interrupt them.

Both are the same at any rate of actions: `period` is the seconds between two of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import numpy as np

from envs.physics.suite import Array, check_noise_level

T = TypeVar("T")
_STEP = 0.1  # s that the constants below speak of
_KEPT = 0.8  # of the drift after a step
_STARTS = 0.1  # chance that a way-point interrupts in a step, at noise level 1


class Drift:
    """A slowly varying offset (an Ornstein-Uhlenbeck process from zero).

    Args:
        spread: its standard deviation in the long run.
        shape: of the offset.
        rng: of the noise.
        period: see the module's docstring.
    """

    def __init__(self, spread: float, shape: int | tuple[int, ...], rng: np.random.Generator, period: float):
        self._keep = _KEPT ** (period / _STEP)
        self._scale, self._rng = spread * np.sqrt(1 - self._keep**2), rng
        self._now: Array = np.zeros(shape)

    def __call__(self) -> Array:
        """The next offset."""
        self._now = self._keep * self._now + self._rng.normal(0.0, self._scale, self._now.shape)
        return self._now


class Interruptions(Generic[T]):
    """When random way-points take the place of a behaviour; at noise level 1 always.

    Args:
        noise_level: 0 is never.
        lasting: seconds of one way-point.
        rng, period: see Drift.

    Raises:
        ValueError: if the noise level lies outside [0, 1].
    """

    def __init__(self, noise_level: float, lasting: float, rng: np.random.Generator, period: float):
        check_noise_level(noise_level)
        self._always, self._rng = noise_level >= 1.0, rng
        self._chance = _STARTS * noise_level**2 * period / _STEP
        self._frames, self._left = max(1, round(lasting / period)), 0
        self._now: T | None = None

    def __call__(self, draw: Callable[[], T]) -> T | None:
        """The way-point that takes the place of the next action, None where none does; `draw` makes one."""
        if self._left == 0:
            if not self._always and self._rng.random() >= self._chance:
                return None
            self._left, self._now = self._frames, draw()
        self._left -= 1
        return self._now
