"""What both hands do in each of gym-aloha's tasks, phase by phase.

A script is asked before every action where the hands should be now, given where things are: a thing that
slips or is knocked over is picked up again.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from envs.physics.aloha.arms import Array, Hand, facing

PITCH = 0.8  # rad by which hands look down when they pick things up
OPEN, CLOSED = 1.0, 0.0
MEETING = np.array([0.0, 0.5, 0.25])  # m, over the table's middle, where the hands meet


@dataclass(frozen=True)
class Sight:
    """What a script sees.

    Args:
        objects: [n, 7] position in metres and quaternion (w first) of each thing.
        hands: the left and the right one, as they are.
    """

    objects: Array
    hands: tuple[Hand, Hand]


class Script(ABC):
    """The phases of a task.

    Attributes:
        phases: seconds that the hands stay at the goals of each phase before the next begins.
    """

    phases: tuple[float, ...]

    @abstractmethod
    def goals(self, phase: int, sight: Sight) -> tuple[Hand, Hand]:
        """Where the left and the right hand should be."""

    @abstractmethod
    def lost(self, phase: int, sight: Sight) -> bool:
        """Whether something fell that should be held, so that the script must begin anew."""


class TransferCube(Script):
    """The right hand picks the cube up from the side, the left one takes it by its top and bottom."""

    #         over  down  grip  lift  meet  take  yield part
    phases = (0.10, 0.20, 0.30, 0.20, 0.20, 0.40, 0.30, 0.20)

    def goals(self, phase: int, sight: Sight) -> tuple[Hand, Hand]:
        """See Script."""
        cube = sight.objects[0, :3]
        turn = facing(0, 0.0, roll=np.pi / 2)
        if phase < 4:
            left = Hand(MEETING - (0.13, 0.0, 0.0), turn, OPEN)
        else:
            left = Hand(cube + (0.005, 0.0, 0.0), turn, OPEN if phase == 4 else CLOSED)
        if phase < 3:
            above = (0.0, 0.0, 0.10 if phase == 0 else 0.0)
            upright = facing(1, PITCH, _quarter(sight.objects[0]))
            right = Hand(cube + above, upright, CLOSED if phase == 2 else OPEN)
        elif phase < 7:
            right = Hand(MEETING, facing(1, PITCH), OPEN if phase == 6 else CLOSED)
        else:
            right = Hand(MEETING + (0.12, 0.0, 0.12), facing(1, PITCH), OPEN)
        return left, right

    def lost(self, phase: int, sight: Sight) -> bool:
        """Whether the cube is too low for hands that should hold it in the air."""
        return phase > 3 and bool(sight.objects[0, 2] < MEETING[2] - 0.08)


class Insertion(Script):
    """The left hand picks the socket up, the right one the peg, and pushes it in until it meets the pin."""

    #         over  down  grip  lift  align push
    phases = (0.10, 0.20, 0.30, 0.20, 0.30, 0.20)
    _GAP = (0.15, 0.10, 0.0)  # m from the socket's centre to the peg's: apart, and where the peg meets the pin

    def goals(self, phase: int, sight: Sight) -> tuple[Hand, Hand]:
        """See Script."""
        peg, socket = sight.objects[:, :3]
        if phase < 3:
            above = np.array([0.0, 0.0, 0.10 if phase == 0 else 0.0])
            opening = CLOSED if phase == 2 else OPEN
            left = Hand(socket + above, facing(0, PITCH, _yaw(sight.objects[1])), opening)
            right = Hand(peg + above, facing(1, PITCH, _yaw(sight.objects[0])), opening)
            return left, right
        left = Hand(MEETING - (0.075, 0.0, 0.0), facing(0, PITCH), CLOSED)
        if phase == 3:
            return left, Hand(MEETING + (0.075, 0.0, 0.0), facing(1, PITCH), CLOSED)
        ahead = np.array([0.15 if phase == 4 else 0.09, 0.0, 0.0])
        # The hand goes where the peg, as it lies in the hand, has the socket in front of it.
        return left, Hand(socket + ahead + sight.hands[1].position - peg, facing(1, PITCH), CLOSED)

    def lost(self, phase: int, sight: Sight) -> bool:
        """Whether peg or socket is too low for hands that should hold it in the air."""
        return phase > 3 and bool((sight.objects[:, 2] < MEETING[2] - 0.08).any())


def _yaw(pose: Array) -> float:
    """The heading of a long thing, whichever end is in front, in -pi/2..pi/2."""
    yaw = Rotation.from_quat(pose[3:], scalar_first=True).as_euler("ZYX")[0]
    return float((yaw + np.pi / 2) % np.pi - np.pi / 2)


def _quarter(pose: Array) -> float:
    """The heading of a cube, whichever side is in front, in -pi/4..pi/4."""
    return float((_yaw(pose) + np.pi / 4) % (np.pi / 2) - np.pi / 4)
