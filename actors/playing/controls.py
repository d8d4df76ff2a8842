"""The keyboard as a robot's action: each number of the action by its name, whatever robot it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.embodiment import ActionKind, Embodiment

# Per second, of a key that is held: metres of a position, radians of an angle or a joint, anything else.
_METRES, _RADIANS, _OTHER = 0.25, 1.0, 0.5
_GRIPPER_SECONDS = 0.5  # from open to closed
# Keys that raise and lower the numbers of the chosen arm, in the action's order.
_KEYS = tuple(zip("waruijty", "sdfoklgh", strict=True))
_CLOSE, _OPEN = "e", "q"


@dataclass(frozen=True)
class Channel:
    """One number of the action.

    Args:
        name: as in the embodiment.
        number: its position in the action.
        arm: position of the arm that it belongs to.
        rate: by how much a held key moves it in a second; of changes and velocities, its value while the key
            is held.
        raises, lowers: keys that do so while its arm is chosen, "" for none.
        limits: least and greatest value, None if they are the robot's affair.
    """

    name: str
    number: int
    arm: int
    rate: float
    raises: str
    lowers: str
    limits: tuple[float, float] | None = None


class Controls:
    """Turns held channels into actions.

    Args:
        robot: whose actions; numbers that belong to no arm are one more group, as an arm is.
        travel: how far each number usually goes, float [A]: the standard deviation of absolute commands, or
            of deltas that of themselves. A held key moves a number so far in a second, or so far an action.
            None: by metres and radians, which recordings of a robot that says degrees do not know.

    Attributes:
        arms: names of the groups.
        channels: every number of the action that a person can move, in order.
    """

    def __init__(self, robot: Embodiment, travel: NDArray[Any] | None = None):
        self.robot, self._travel = robot, travel
        self.arms = [arm.name for arm in robot.arms]
        self.channels: list[Channel] = []
        rest = set(range(robot.action_dim))
        for k, arm in enumerate(robot.arms):
            self._group(k, arm.numbers)
            rest -= {*arm.numbers, arm.gripper}
            if arm.gripper is not None:
                opened, closed = arm.gripper_range
                limits = (min(opened, closed), max(opened, closed))
                rate = (closed - opened) / _GRIPPER_SECONDS
                name = robot.action_names[arm.gripper]
                self.channels.append(Channel(name, arm.gripper, k, rate, _CLOSE, _OPEN, limits))
        if rest:
            self._group(len(self.arms), sorted(rest))
            self.arms.append("other" if self.arms else robot.robot)
        self._changes = {*robot.changes}

    def _group(self, arm: int, numbers: Any) -> None:
        for place, number in enumerate(numbers):
            raises, lowers = _KEYS[place] if place < len(_KEYS) else ("", "")
            name = self.robot.action_names[number]
            self.channels.append(Channel(name, number, arm, self._rate(place, number), raises, lowers))

    def _rate(self, place: int, number: int) -> float:
        if self._travel is not None and self._travel[number] > 0:
            return float(self._travel[number])
        if self.robot.delta:
            return 1.0
        if self.robot.action_kind is ActionKind.END_EFFECTOR:
            return _METRES if place < 3 else _RADIANS
        return _RADIANS if self.robot.action_kind is ActionKind.JOINTS else _OTHER

    def start(self, command: NDArray[Any]) -> NDArray[np.float64]:
        """The command [A] to begin from: the one in force, but for changes and velocities, which are 0; of
        delta actions open grippers.
        """
        out = np.array(command, dtype=np.float64)
        out[list(self._changes)] = 0.0
        if self.robot.delta:
            for arm in self.robot.arms:
                if arm.gripper is not None:
                    out[arm.gripper] = arm.gripper_range[0]
        return out

    def action(
        self, command: NDArray[Any], held: Mapping[int, float], speed: float = 1.0
    ) -> NDArray[np.float64]:
        """The next action [A] after `command` [A].

        Args:
            held: how far each number is pushed, -1..1, by its position; others rest: absolute numbers and
                grippers stay as they are, changes and velocities are 0.
            speed: factor of the rates.
        """
        out = np.array(command, dtype=np.float64)
        for channel in self.channels:
            push = float(np.clip(held.get(channel.number, 0.0), -1.0, 1.0)) * speed
            at = channel.number
            if at in self._changes:
                out[at] = push * channel.rate
            else:
                out[at] += push * channel.rate / self.robot.fps
            if channel.limits is not None:
                out[at] = np.clip(out[at], *channel.limits)
        return out
