"""How plans are carried out: as they are, or bent in one of three ways, as in RoboScape-R.

Suboptimal behaviour visits unrelated way-points, stops on the way, or is disturbed where it matters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from envs.physics.tabletop.arms import rpy_to_matrix
from envs.physics.tabletop.scene import TIP_HEIGHT, TOOL_OFFSET
from envs.physics.tabletop.scenes.plans import FAST, SLOW, Waypoint

Array = NDArray[np.float64]
TURN = 2.5  # rad/s of a hand
_DETOUR, _DETOUR_TURN = 0.12, 0.5  # m and rad, spread of unrelated way-points at noise 1
_ASIDE = 0.02  # m, spread of stops around the straight line at noise 1
_SHIFT, _SHIFT_TURN = 0.05, 0.4  # m and rad, spread of disturbances at noise 1
_WANDER = 0.09  # m, spread of random way-points around things


def detours(
    points: list[Waypoint], hands: Array, noise_level: float, rng: np.random.Generator
) -> list[Waypoint]:
    """A plan with unrelated way-points in it, whose position and rotation are noise.

    Args:
        points: the plan.
        hands: [2, 7] fingertip poses and grippers that it starts at.
        noise_level: 0..1, how many, and how far off they are.
        rng: of the noise.
    """
    # Between grasping and placing fingers stay as they are, and detours are flown over things.
    free = [k for k, point in enumerate(points) if not point.phase]
    chosen = rng.choice(free, min(len(free), 1 + round(2 * noise_level)), replace=False)
    out, last = [], hands
    for k, point in enumerate(points):
        if k in chosen:
            moving = np.abs(point.hands - last).max(1) > 1e-6
            middle = (last + point.hands) / 2
            middle[:, 6] = last[:, 6]
            noise = np.zeros(7)  # the same for both hands, which may hold a thing between them
            noise[:3] = rng.normal(0.0, 0.03 + _DETOUR * noise_level, 3)
            noise[3:6] = rng.normal(0.0, 0.1 + _DETOUR_TURN * noise_level, 3)
            middle += noise * moving[:, None]
            middle[:, 2] = np.maximum(middle[:, 2], np.where(moving, 0.09, 0.0))
            out.append(Waypoint(middle))
        out.append(point)
        last = point.hands
    return out


def stops(
    points: list[Waypoint], hands: Array, noise_level: float, rng: np.random.Generator
) -> list[Waypoint]:
    """A plan with further points between its way-points, more and farther aside the higher the noise; for
    arguments see `detours`.
    """
    out, last = [], hands
    for point in points:
        far = np.abs(point.hands - last)[:, :3].max() > 0.02
        moving = np.abs(point.hands - last).max(1) > 1e-6
        for part in np.sort(rng.random(rng.binomial(2, 0.3 + 0.5 * noise_level) if far else 0)):
            between = last + part * (point.hands - last)
            between[:, 6] = last[:, 6] if point.phase else point.hands[:, 6]
            between[:, :3] += moving[:, None] * rng.normal(0.0, _ASIDE * noise_level, (2, 3))
            between[:, 2] = np.maximum(between[:, 2], 0.010)
            out.append(replace(point, hands=between, wait=0.0))
        out.append(point)
        last = point.hands
    return out


def disturbances(
    points: list[Waypoint], hands: Array, noise_level: float, rng: np.random.Generator
) -> list[Waypoint]:
    """A plan whose hands are shifted and turned where they grasp, place, push or press; for arguments see
    `detours`.
    """
    shifts = {}
    for phase in ("grasp", "place", "push", "press"):
        shift = np.zeros((2, 7))
        shift[:, :2] = rng.normal(0.0, _SHIFT * noise_level, (2, 2))
        shift[:, 2] = np.abs(rng.normal(0.0, _SHIFT / 3 * noise_level, 2))
        shift[:, 3:6] = rng.normal(0.0, _SHIFT_TURN * noise_level, (2, 3))
        shifts[phase] = shift
    out = []
    for point in points:
        used = np.abs(point.hands - hands).max(1) > 1e-6  # the other hand rests
        shift = shifts.get(point.phase, np.zeros((2, 7))) * used[:, None]
        out.append(replace(point, hands=point.hands + shift))
    return out


# In which behaviour is suboptimal; recordings name them by their places here.
MANNERS = (detours, stops, disturbances)


class Wander:
    """Random way-points about things: pays no heed to the task.

    Args:
        things: () -> [n, 2] places in metres.
        rng: of the way-points.
    """

    def __init__(self, things: Callable[[], Array], rng: np.random.Generator):
        self.things, self.rng = things, rng

    def next(self, hands: Array) -> Waypoint:
        """A way-point for one hand, or for both."""
        out = hands.copy()
        for arm in (0, 1) if self.rng.random() < 0.3 else (int(self.rng.integers(2)),):
            place = self.things()[self.rng.integers(2)] + self.rng.normal(0.0, _WANDER, 2)
            turn = np.array([np.pi, 0.0, 0.0]) + self.rng.normal(0.0, (0.2, 0.2, 0.5))
            out[arm] = [*place, self.rng.uniform(TIP_HEIGHT, 0.15), *turn, self.rng.uniform()]
        return Waypoint(out, speed=float(self.rng.choice((SLOW, FAST))))


class Follower:
    """Carries out way-points, a step at every call.

    Args:
        points: in order; after the last one the hands rest.
        hands: [2, 7] fingertip poses and grippers to begin at.
        period: seconds between two calls.
        more: what gives a further way-point when there are no more, None to rest.
    """

    def __init__(
        self,
        points: list[Waypoint],
        hands: Array,
        period: float,
        more: Callable[[Array], Waypoint] | None = None,
    ):
        self.points, self.hands, self.period, self.more = list(points), hands.copy(), period, more
        self.waited = 0.0

    def __call__(self) -> Array:
        """The next fingertip poses and grippers [2, 7]."""
        if not self.points and self.more is not None:
            self.points.append(self.more(self.hands))
        if not self.points:
            return self.hands
        point = self.points[0]
        gap = point.hands - self.hands
        steps = max(
            np.linalg.norm(gap[:, :3], axis=1).max() / (point.speed * self.period),
            np.abs(gap[:, 3:6]).max() / (TURN * self.period),
        )
        # A hundredth of a step more is no reason for a step more.
        self.hands = self.hands + gap * min(1.0, 1.0 / max(np.ceil(steps - 0.01), 1.0))
        self.hands[:, 6] = point.hands[:, 6]
        if steps <= 1.01:
            self.waited += self.period
            if self.waited > point.wait + 1e-9:
                self.points.pop(0)
                self.waited = 0.0
        return self.hands


def flanges(hands: Array) -> Array:
    """Flange poses and grippers [2, 7] of fingertip poses and grippers."""
    return _shifted(hands, -TOOL_OFFSET)


def fingertips(flange_poses: Array) -> Array:
    """The inverse of `flanges`."""
    return _shifted(flange_poses, TOOL_OFFSET)


def _shifted(poses: Array, along: float) -> Array:
    out = poses.copy()
    for pose in out:
        pose[:3] += along * rpy_to_matrix(pose[3:6])[:, 2]
    return out
