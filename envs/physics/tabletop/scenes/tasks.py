"""The five tasks: when each is done, and how far it has come.

Each asks for something to be done with one object while the other one stays where it is, so doing both of two
things is no success.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.physics.tabletop.bench import Goal
from envs.physics.tabletop.scene import ARMS
from envs.physics.tabletop.scenes.catalogue import CONTAINER_COLOURS, INNER, MAT, MAT_COLOURS, RIM
from envs.physics.tabletop.scenes.layout import OBJECTS, Layout

Array = NDArray[np.float64]
DISTANCE = 0.08  # m that things are pushed or pulled at least
ASIDE = 0.05  # m that they may stray sideways
STILL = 0.04  # m that the other object may be moved
RAISED = 0.04  # m above the table that carried things are at least
SETTLED = 0.015  # m above the table that what stands on it may be, tilted a little
NEAR = 0.30  # m from the hands at which progress begins


@dataclass(frozen=True)
class Request:
    """What the words ask for.

    Args:
        layout: of the episode.
        thing: which of the layout's two objects.
        goal: colour of the mat or container, "" for tasks without one.
    """

    layout: Layout
    thing: int
    goal: str

    @property
    def place(self) -> Array:
        """[2] of the goal, in metres."""
        return {**self.layout.containers, **self.layout.mats}[self.goal]


class SceneTask(Goal):
    """What a request asks for, in a world laid out accordingly.

    Args:
        request: what is asked for.
        model: of the world.

    Attributes:
        goals: colours of what can be asked for as a goal, and what it is; {} for tasks without one.
    """

    goals: tuple[str, ...] = ()

    def __init__(self, request: Request, model: mujoco.MjModel):
        self.request = request
        self._joints = [int(model.joint(name).qposadr[0]) for name in OBJECTS]
        self._body = model.body(OBJECTS[request.thing]).id
        self._start = request.layout.objects[:, :2]
        fingers = [[model.body(f"{arm}_finger_{end}").id for end in "ab"] for arm in ARMS]
        self._hand_of = {body: k for k, pair in enumerate(fingers) for body in pair}
        self._geom_body = model.geom_bodyid

    def satisfied(self, data: mujoco.MjData) -> bool:
        """Whether it is done, and the other object left alone."""
        other = 1 - self.request.thing
        moved = np.hypot(*(self._place(data, other)[:2] - self._start[other]))
        return bool(moved < STILL and self._done(data))

    def progress(self, data: mujoco.MjData) -> float:
        """1 if done; else a quarter for a hand near the object, and the rest for what has come of it."""
        if self.satisfied(data):
            return 1.0
        thing = self._place(data, self.request.thing)
        tips = [(data.body(f"{arm}_finger_a").xpos + data.body(f"{arm}_finger_b").xpos) / 2 for arm in ARMS]
        nearest = min(float(np.linalg.norm(tip - thing)) for tip in tips)
        near = np.clip(1.0 - (nearest - 0.05) / NEAR, 0.0, 1.0)
        return float(0.25 * near + 0.65 * np.clip(self._advance(data), 0.0, 1.0))

    def object_poses(self, data: mujoco.MjData) -> Array:
        """[x, y, z, heading] of what the words name, then of the other object."""
        order = (self.request.thing, 1 - self.request.thing)
        return np.array([[*self._place(data, k), self._heading(data, k)] for k in order])

    @abstractmethod
    def _done(self, data: mujoco.MjData) -> bool:
        """Whether what is asked for has happened to the object."""

    @abstractmethod
    def _advance(self, data: mujoco.MjData) -> float:
        """How much of it has happened, 0..1."""

    def _place(self, data: mujoco.MjData, thing: int) -> Array:
        start = self._joints[thing]
        return data.qpos[start : start + 3]

    def _heading(self, data: mujoco.MjData, thing: int) -> float:
        a, b, c, d = data.qpos[self._joints[thing] + 3 : self._joints[thing] + 7]
        return float(np.arctan2(2 * (a * d + b * c), 1 - 2 * (c * c + d * d)))

    def _here(self, data: mujoco.MjData) -> Array:
        return self._place(data, self.request.thing)

    def _moved(self, data: mujoco.MjData) -> Array:
        """[2] of the object, since the start."""
        return self._here(data)[:2] - self._start[self.request.thing]

    def _missing(self, data: mujoco.MjData) -> Array:
        """[2] from the object to the goal."""
        return self.request.place - self._here(data)[:2]

    def _gone(self, data: mujoco.MjData) -> float:
        """Share of the way to the goal."""
        whole = np.hypot(*(self.request.place - self._start[self.request.thing]))
        return 1.0 - float(np.hypot(*self._missing(data)) / whole)

    def _hands(self, data: mujoco.MjData) -> set[int]:
        """Which hands touch the object with their fingers."""
        pairs = self._geom_body[data.contact.geom]
        mine = pairs[(pairs == self._body).any(1)]
        return {self._hand_of[body] for body in mine.flatten().tolist() if body in self._hand_of}


class Push(SceneTask):
    """Away from the robot by DISTANCE along the table."""

    way = 1.0

    def _done(self, data: mujoco.MjData) -> bool:
        along, aside = self._moved(data)
        return self.way * along >= DISTANCE and abs(aside) <= ASIDE and self._here(data)[2] < SETTLED

    def _advance(self, data: mujoco.MjData) -> float:
        return float(self.way * self._moved(data)[0] / DISTANCE)


class Pull(Push):
    """Towards the robot by DISTANCE along the table."""

    way = -1.0


class PickPlace(SceneTask):
    """Within a container's walls, with no hand on it."""

    goals = tuple(CONTAINER_COLOURS)

    def _done(self, data: mujoco.MjData) -> bool:
        inside = np.abs(self._missing(data)).max() < INNER and self._here(data)[2] < RIM
        return bool(inside) and not self._hands(data)

    def _advance(self, data: mujoco.MjData) -> float:
        return 0.3 * min(1.0, self._here(data)[2] / RAISED) + 0.7 * self._gone(data)


class MoveToAim(SceneTask):
    """On a mat, with no hand on it."""

    goals = tuple(MAT_COLOURS)

    def _done(self, data: mujoco.MjData) -> bool:
        there = np.abs(self._missing(data)).max() < MAT and self._here(data)[2] < SETTLED
        return bool(there) and not self._hands(data)

    def _advance(self, data: mujoco.MjData) -> float:
        return self._gone(data)


class Carry(SceneTask):
    """Over a mat, off the table, held by both hands."""

    goals = tuple(MAT_COLOURS)

    def _done(self, data: mujoco.MjData) -> bool:
        over = np.abs(self._missing(data)).max() < MAT and self._here(data)[2] > RAISED
        return bool(over) and self._hands(data) == {0, 1}

    def _advance(self, data: mujoco.MjData) -> float:
        raised = min(1.0, self._here(data)[2] / RAISED)
        return 0.25 * len(self._hands(data)) + 0.25 * raised + 0.25 * self._gone(data)


TASKS: dict[str, type[SceneTask]] = {
    "push": Push,
    "pull": Pull,
    "pick_place": PickPlace,
    "move_to_aim": MoveToAim,
    "carry": Carry,
}
