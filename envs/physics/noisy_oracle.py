"""Noise levels for the closed-loop oracles of OGBench, which know none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from envs.physics.suite import Array, check_noise_level


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
        check_noise_level(noise_level)
        self.oracle, self.waypoint, self.noise_level, self.rng = oracle, waypoint, noise_level, rng
        self.keep = 0.8 ** (period / 0.1)
        self.start = 0.1 * noise_level**2 * period / 0.1  # chance that a way-point interrupts, per action
        self.frames = max(1, round(0.6 / period))  # of one way-point
        self.drift, self.left, self.away = np.zeros(4), 0, np.zeros(5)

    def __call__(self) -> Array:
        """The next action [5] in -1..1."""
        if self.left == 0 and (self.noise_level >= 1.0 or self.rng.random() < self.start):
            self.left = self.frames
            turn, grip = self.rng.uniform(-1, 1), self.rng.choice((-1.0, 1.0))
            self.away = np.clip(np.array([*5.0 * self.waypoint(), turn, grip]), -1.0, 1.0)
        action = np.array(self.away if self.left else self.oracle(), dtype=np.float64)
        self.left = max(0, self.left - 1)
        scale = 0.4 * self.noise_level * np.sqrt(1 - self.keep**2)
        self.drift = self.keep * self.drift + self.rng.normal(0.0, scale, 4)
        action[:4] += self.drift
        return np.clip(action, -1.0, 1.0)
