"""Meta-World's scripted policies with any share of chance in them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from envs.physics.noise import Drift, Interruptions
from envs.physics.suite import Array


class NoisyPolicy:
    """A scripted policy that is bent towards chance, whatever its task.

    Noise moves where things and goal are believed to be, adds a slowly varying offset to the motion, and
    interrupts the policy by random way-points about the thing; at 1 nothing else is left.

    Args:
        policy: full observation [39] -> action [4].
        sight: () -> the full observation now.
        hold: (policy, full observation) -> the action [4] that stands for it until the next call.
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
        hold: Callable[[Callable[[Array], Array], Array], Array],
        noise_level: float,
        rng: np.random.Generator,
        period: float,
    ):
        self.policy, self.sight, self.hold, self.rng = policy, sight, hold, rng
        self.interruptions = Interruptions[Array](noise_level, 1.0, rng, period)
        self.drift = Drift(0.3 * noise_level, 3, rng, period)
        self.object_bias, self.goal_bias = rng.normal(0.0, 0.03 * noise_level, (2, 3))

    def __call__(self) -> Array:
        """The next action [4] in -1..1."""
        seen = self.sight()
        waypoint = self.interruptions(lambda: self._about(seen[4:7]))
        if waypoint is not None:
            action = np.append(10.0 * (waypoint[:3] - seen[:3]), waypoint[3])
        else:
            action = self.hold(self._misled, seen)
        action = np.clip(action, -1.0, 1.0)
        action[:3] += self.drift()
        return np.clip(action, -1.0, 1.0)

    def _misled(self, seen: Array) -> Array:
        """The policy's action [4] where thing and goal are believed to be elsewhere."""
        seen = seen.copy()
        seen[4:7] += self.object_bias
        seen[36:39] += self.goal_bias
        return self.policy(seen)

    def _about(self, thing: Array) -> Array:
        """A place [3] in metres about the thing, and the gripper's command there."""
        place = thing + self.rng.normal(0.0, 0.1, 3)
        return np.append(place, self.rng.choice((-1.0, 1.0)))
