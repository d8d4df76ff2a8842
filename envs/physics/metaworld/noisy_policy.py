"""Meta-World's scripted policies with any share of chance in them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from envs.physics.suite import Array, check_noise_level


class NoisyPolicy:
    """A scripted policy that is bent towards chance, whatever its task.

    Noise moves where things and goal are believed to be, adds a slowly varying offset to the motion, and
    interrupts the policy by random way-points about the thing; at 1 nothing else is left.

    Args:
        policy: full observation [39] -> action [4].
        sight: () -> the full observation now.
        noise_level: 0 is the policy itself, 1 pays no heed to the task.
        rng: of the noise.
        period: seconds between two calls.

    Raises:
        ValueError: if the noise level lies outside [0, 1].
    """

    def __init__(
        self,
        policy: Callable[[Array], Array],
        sight: Callable[[], Array],
        noise_level: float,
        rng: np.random.Generator,
        period: float,
    ):
        check_noise_level(noise_level)
        self.policy, self.sight, self.noise_level, self.rng = policy, sight, noise_level, rng
        self.keep = 0.8 ** (period / 0.1)
        self.start = 0.1 * noise_level**2 * period / 0.1  # chance that a way-point interrupts, per action
        self.frames = max(1, round(1.0 / period))  # of one way-point
        self.drift = np.zeros(3)
        self.object_bias, self.goal_bias = rng.normal(0.0, 0.03 * noise_level, (2, 3))
        self.left, self.waypoint, self.grip = 0, np.zeros(3), 0.0

    def __call__(self) -> Array:
        """The next action [4] in -1..1."""
        seen = self.sight()
        if self.left == 0 and (self.noise_level >= 1.0 or self.rng.random() < self.start):
            self.left = self.frames
            self.waypoint = seen[4:7] + self.rng.normal(0.0, 0.1, 3)
            self.grip = float(self.rng.choice((-1.0, 1.0)))
        if self.left:
            self.left -= 1
            action = np.append(10.0 * (self.waypoint - seen[:3]), self.grip)
        else:
            seen[4:7] += self.object_bias
            seen[36:39] += self.goal_bias
            action = np.asarray(self.policy(seen), dtype=np.float64)
        scale = 0.3 * self.noise_level * np.sqrt(1 - self.keep**2)
        self.drift = self.keep * self.drift + self.rng.normal(0.0, scale, 3)
        action = np.clip(action, -1.0, 1.0)
        action[:3] += self.drift
        return np.clip(action, -1.0, 1.0)
