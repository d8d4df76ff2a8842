"""What both hands do in each of gym-aloha's tasks, phase by phase.

A script is asked before every action where the hands should be now, given where things are: a thing that
slips or is knocked over is picked up again.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from envs.physics.aloha.arms import Array, Hand, Hands, facing

PUSH = 0.096
PITCH = 0.8  # rad by which hands look down when they pick things up
OPEN, CLOSED = 1.0, 0.0
_CLEAR = np.array([0.0, 0.0, 0.007])  # m above the peg's middle at which fingers do not rub on the table
MEETING = np.array([0.0, 0.5, 0.25])  # m, over the table's middle, where the hands meet


@dataclass(frozen=True)
class Sight:
    """What a script sees.

    Args:
        objects: [n, 7] position in metres and quaternion (w first) of each thing.
        hands: the left and the right one, as they are.
        aims: where they are sent now, which is a little ahead of where they are.
    """

    objects: Array
    hands: Hands
    aims: Hands


class Script(ABC):
    """The phases of a task.

    Attributes:
        phases: seconds that the hands stay at the goals of each phase before the next begins.
    """

    phases: tuple[float, ...]

    @abstractmethod
    def goals(self, phase: int, sight: Sight) -> Hands:
        """Where the left and the right hand should be."""

    @abstractmethod
    def lost(self, phase: int, sight: Sight) -> bool:
        """Whether something fell that should be held, so that the script must begin anew."""


class TransferCube(Script):
    """The right hand picks the cube up from the side, the left one takes it by its top and bottom."""

    #         over  down  grip  lift  meet  take  yield part
    phases = (0.10, 0.20, 0.30, 0.20, 0.20, 0.40, 0.30, 0.20)

    def goals(self, phase: int, sight: Sight) -> Hands:
        """See Script."""
        cube = sight.objects[0, :3]
        turn = facing(0, 0.0, roll=np.pi / 2)
        if phase < 4:
            left = Hand(MEETING - (0.13, 0.0, 0.0), turn, OPEN)
        else:
            left = Hand(cube + (0.005, 0.0, 0.0), turn, OPEN if phase == 4 else CLOSED)
        if phase < 2:
            above = (0.0, 0.0, 0.10 if phase == 0 else 0.0)
            right = Hand(cube + above, facing(1, PITCH, _quarter(sight.objects[0])), OPEN)
        elif phase == 2:
            right = replace(sight.aims[1], opening=CLOSED)
        elif phase < 7:
            right = Hand(MEETING, facing(1, PITCH), OPEN if phase == 6 else CLOSED)
        else:
            right = Hand(MEETING + (0.12, 0.0, 0.12), facing(1, PITCH), OPEN)
        return left, right

    def lost(self, phase: int, sight: Sight) -> bool:
        """Whether the cube is not where the hand is that goes for it or holds it."""
        return phase > 0 and _away(sight.hands[0 if phase > 5 else 1], sight.objects[0], phase > 1)


class Insertion(Script):
    """The left hand picks the socket up, the right one the peg, and pushes it in until it meets the pin."""

    #         over  down  grip  lift  align push
    phases = (0.20, 0.40, 0.70, 0.30, 0.40, 0.20)

    def goals(self, phase: int, sight: Sight) -> Hands:
        """See Script."""
        peg, socket = sight.objects[:, :3]
        if phase < 2:
            above = np.array([0.0, 0.0, 0.10 if phase == 0 else 0.0])
            left = Hand(socket + above, facing(0, PITCH, _yaw(sight.objects[1])), OPEN)
            return left, Hand(peg + above + _CLEAR, facing(1, PITCH, _yaw(sight.objects[0])), OPEN)
        if phase == 2:
            left, right = sight.aims
            return replace(left, opening=CLOSED), replace(right, opening=CLOSED)
        left = Hand(MEETING - (0.075, 0.0, 0.0), facing(0, PITCH), CLOSED)
        if phase == 3:
            return left, Hand(MEETING + (0.075, 0.0, 0.0), facing(1, PITCH), CLOSED)
        return left, _bring(sight, 0.15 if phase == 4 else PUSH)

    def lost(self, phase: int, sight: Sight) -> bool:
        """Whether peg or socket is not where its hand is."""
        pairs = zip(reversed(sight.hands), sight.objects, strict=True)
        return phase > 0 and any(_away(hand, thing, phase > 1) for hand, thing in pairs)


def _bring(sight: Sight, ahead: float) -> Hand:
    """The right hand at which the peg, as it lies in it, is `ahead` metres in front of the socket and in line
    with it.
    """
    hand, (peg, socket) = sight.hands[1], sight.objects
    hole, axis = (_rotation(pose).as_matrix()[:, 0] for pose in (socket, peg))
    hole = hole if hole[0] > 0 else -hole
    axis = axis if axis @ hole > 0 else -axis
    turn, _ = Rotation.align_vectors(hole[None], axis[None])
    position = socket[:3] + ahead * hole + turn.apply(hand.position - peg[:3])
    return Hand(position, (turn * Rotation.from_matrix(hand.rotation)).as_matrix(), CLOSED)


def _away(hand: Hand, thing: Array, level: bool) -> bool:
    """Whether a hand is not over a thing, or, when it should be `level` with it, not around it."""
    apart = np.abs(hand.position - thing[:3])
    return bool(np.hypot(*apart[:2]) > 0.05 or (level and apart[2] > 0.04))


def _yaw(pose: Array) -> float:
    """The heading of a long thing, whichever end is in front, in -pi/2..pi/2."""
    yaw = _rotation(pose).as_euler("ZYX")[0]
    return float((yaw + np.pi / 2) % np.pi - np.pi / 2)


def _quarter(pose: Array) -> float:
    """The heading of a cube, whichever side is in front, in -pi/4..pi/4."""
    return float((_yaw(pose) + np.pi / 4) % (np.pi / 2) - np.pi / 4)


def _rotation(pose: Array) -> Rotation:
    return Rotation.from_quat(pose[3:], scalar_first=True)
