"""Scripted behaviours of the bench: the expert, and a noise_level that bends it towards noise and chance.

A behaviour sees the true state and returns one absolute 14-D command per control step.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.physics.tabletop.tasks import Layout, Push

Array = NDArray[np.float64]
SPEED = 0.22  # m/s a gripper moves at most
_STANDOFF = 0.055  # m from block centre to fingertip centre when the push begins
_LATERAL = 0.012  # m off the push line at which the gripper still counts as aligned


class PushExpert:
    """Go behind the block as seen from the target, then push through it, steering back onto the line at every
    step of `period` seconds.
    """

    def __init__(self, task: Push, layout: Layout, period: float = 0.1):
        self.task, self.layout, self.period = task, layout, period
        self.behind = False

    def fingertip(self, block: Array, tip: Array) -> Array:
        """The next fingertip position [2] in metres of the near arm, from block and fingertip positions [2]."""
        target = self.layout.target
        gap = target - block
        distance = float(np.hypot(*gap))
        if distance < 0.012:
            return tip  # there: stay
        line = gap / max(distance, 1e-6)
        normal = np.array([-line[1], line[0]])
        offset = tip - block
        along, across = float(offset @ line), float(offset @ normal)
        reach = self.layout.block_half + 0.012
        if self.behind and (along > -0.5 * reach or abs(across) > 0.03):
            self.behind = False
        if not self.behind and along < -reach and abs(across) < _LATERAL:
            self.behind = True
        if self.behind:
            # Lead the block towards the line: push a little from the side it has drifted to.
            goal = target - line * reach - normal * across * 1.5
            speed = min(SPEED, 0.1 + 5.0 * distance)
        elif along > -reach and abs(across) < self.layout.block_half + 0.03:
            side = 1.0 if across >= 0 else -1.0  # beside or ahead of it: go round
            goal = block + normal * side * (self.layout.block_half + 0.06) - line * 0.08
            speed = SPEED
        else:
            goal = block - line * _STANDOFF
            speed = SPEED
        step = goal - tip
        length = float(np.hypot(*step))
        return tip + step * min(1.0, speed * self.period / max(length, 1e-9))


class Behaviour:
    """An episode's behaviour, from the expert (noise_level = 0) through noise to chance (noise_level = 1).

    The noise_level scales a slowly varying offset on the commanded fingertip, shifts where the expert
    believes block
    and target to be, and gives the chance that the whole episode follows random way-points near the block.

    Args:
        noise_level: 0 is the expert, 1 pays no heed to the task.
        period: seconds per control step.
    """

    def __init__(
        self, task: Push, layout: Layout, noise_level: float, rng: np.random.Generator, period: float = 0.1
    ):
        if not 0.0 <= noise_level <= 1.0:
            raise ValueError(
                f"behaviour noise_level {noise_level} must lie in [0, 1]: 0 is the expert, 1 is random"
            )
        believed = layout
        if noise_level > 0:
            shift = rng.normal(0.0, 0.05 * noise_level, 2)
            believed = Layout(**{**vars(layout), "target": layout.target + shift})
        self.expert = PushExpert(task, believed, period)
        self.noise_level, self.rng, self.period = noise_level, rng, period
        self.keep = 0.8 ** (period / 0.1)  # the drift forgets at the same pace whatever the control rate
        self.drift = np.zeros(2)
        self.bias = rng.normal(0.0, 0.05 * noise_level, 2)
        self.random = noise_level >= 1.0
        self.waypoint: Array | None = None

    def fingertip(self, block: Array, tip: Array) -> Array:
        """The next fingertip position [2] of the near arm in metres."""
        if self.random:
            if (
                self.waypoint is None
                or np.hypot(*(self.waypoint - tip)) < 0.02
                or self.rng.random() < 1 - 0.95 ** (self.period / 0.1)
            ):
                self.waypoint = block + self.rng.normal(0.0, 0.09, 2)
            step = self.waypoint - tip
            goal = tip + step * min(1.0, SPEED * self.period / max(float(np.hypot(*step)), 1e-9))
        else:
            goal = self.expert.fingertip(block + self.bias, tip)
        self.drift = self.keep * self.drift + self.rng.normal(
            0.0, 0.0133 * self.noise_level * np.sqrt(1 - self.keep**2), 2
        )
        return goal + self.drift
