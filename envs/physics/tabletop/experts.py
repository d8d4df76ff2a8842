"""Scripted behaviours of the bench: experts of tasks, and noise that bends them towards chance.

A behaviour sees the true state and says where one arm's fingertips go next, on the table's plane.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from envs.physics.noise import Drift

Array = NDArray[np.float64]
SPEED = 0.22  # m/s a fingertip moves at most
_STANDOFF = 0.055  # m from block centre to fingertip centre when the push begins
_LATERAL = 0.012  # m off the push line at which the gripper still counts as aligned


class FingertipExpert(ABC):
    """A behaviour of one arm.

    Attributes:
        arm: which, by its position in scene.ARMS; the other stands still.
    """

    arm: int

    @abstractmethod
    def fingertip(self, tip: Array) -> Array:
        """The next fingertip position [2] in metres, from the present one [2]."""


class PushExpert(FingertipExpert):
    """Go behind the block as seen from the target, then push through it, steering back onto the line.

    Args:
        arm: which arm pushes.
        block: () -> the block's centre [2] as the expert believes it, in metres.
        target: [2] where it believes the target.
        half: half edge length of the block.
        period: seconds between two calls.
    """

    def __init__(self, arm: int, block: Callable[[], Array], target: Array, half: float, period: float):
        self.arm, self.block, self.target, self.half, self.period = arm, block, target, half, period
        self.behind = False

    def fingertip(self, tip: Array) -> Array:
        """The next fingertip position [2] in metres."""
        block, target = self.block(), self.target
        gap = target - block
        distance = float(np.hypot(*gap))
        if distance < 0.012:
            return tip  # there: stay
        line = gap / max(distance, 1e-6)
        normal = np.array([-line[1], line[0]])
        offset = tip - block
        along, across = float(offset @ line), float(offset @ normal)
        reach = self.half + 0.012
        if self.behind and (along > -0.5 * reach or abs(across) > 0.03):
            self.behind = False
        if not self.behind and along < -reach and abs(across) < _LATERAL:
            self.behind = True
        if self.behind:
            # Lead the block towards the line: push a little from the side it has drifted to.
            goal = target - line * reach - normal * across * 1.5
            speed = min(SPEED, 0.1 + 5.0 * distance)
        elif along > -reach and abs(across) < self.half + 0.03:
            side = 1.0 if across >= 0 else -1.0  # beside or ahead of it: go round
            goal = block + normal * side * (self.half + 0.06) - line * 0.08
            speed = SPEED
        else:
            goal = block - line * _STANDOFF
            speed = SPEED
        return _towards(tip, goal, speed * self.period)


class WaypointWalk(FingertipExpert):
    """Random way-points around something, whatever the task.

    Args:
        arm: which arm walks.
        centre: () -> [2] in metres, around which way-points scatter.
        rng: of the way-points.
        period: seconds between two calls.
    """

    def __init__(self, arm: int, centre: Callable[[], Array], rng: np.random.Generator, period: float):
        self.arm, self.centre, self.rng, self.period = arm, centre, rng, period
        self.waypoint: Array | None = None

    def fingertip(self, tip: Array) -> Array:
        """The next fingertip position [2] in metres."""
        if (
            self.waypoint is None
            or np.hypot(*(self.waypoint - tip)) < 0.02
            or self.rng.random() < 1 - 0.95 ** (self.period / 0.1)
        ):
            self.waypoint = self.centre() + self.rng.normal(0.0, 0.09, 2)
        return _towards(tip, self.waypoint, SPEED * self.period)


class Drifting(FingertipExpert):
    """Another behaviour under a slowly varying offset on its fingertip.

    Args:
        expert: the behaviour.
        noise_level: 0..1, scales the offset, whose standard deviation is 13.3 mm at 1.
        rng: of the offset.
        period: seconds between two calls; the offset forgets at the same pace whatever the control rate.
    """

    def __init__(self, expert: FingertipExpert, noise_level: float, rng: np.random.Generator, period: float):
        self.expert, self.arm = expert, expert.arm
        self.drift = Drift(0.0133 * noise_level, 2, rng, period)

    def fingertip(self, tip: Array) -> Array:
        """The next fingertip position [2] in metres."""
        goal = self.expert.fingertip(tip)
        return goal + self.drift()


def _towards(tip: Array, goal: Array, stride: float) -> Array:
    """`goal`, or the point at `stride` metres on the way to it."""
    step = goal - tip
    return tip + step * min(1.0, stride / max(float(np.hypot(*step)), 1e-9))
