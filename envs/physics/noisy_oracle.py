"""Noise levels for the closed-loop oracles of OGBench, which know none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from envs.physics.noise import Drift, Interruptions
from envs.physics.suite import Array


class NoisyOracle:
    """An oracle that is bent towards chance: a slowly varying offset is added to its motion, and random
    way-points interrupt it; at noise level 1 nothing else is left.

    Args:
        oracle: () -> action [5].
        waypoint: () -> the way [3] in metres to a random place.
        noise_level: 0 is the oracle itself, 1 pays no heed to the task.
        rng: of the noise.
        period: seconds between two calls.

    Raises:
        ValueError: if the noise level lies outside [0, 1].
    """

    def __init__(
        self,
        oracle: Callable[[], Array],
        waypoint: Callable[[], Array],
        noise_level: float,
        rng: np.random.Generator,
        period: float,
    ):
        self.oracle, self.waypoint, self.rng = oracle, waypoint, rng
        self.interruptions = Interruptions[Array](noise_level, 0.6, rng, period)
        self.drift = Drift(0.4 * noise_level, 4, rng, period)

    def __call__(self) -> Array:
        """The next action [5] in -1..1."""
        away = self.interruptions(self._away)
        action = np.array(self.oracle() if away is None else away, dtype=np.float64)
        action[:4] += self.drift()
        return np.clip(action, -1.0, 1.0)

    def _away(self) -> Array:
        turn, grip = self.rng.uniform(-1, 1), self.rng.choice((-1.0, 1.0))
        return np.clip(np.array([*5.0 * self.waypoint(), turn, grip]), -1.0, 1.0)
