"""Commands as states and states as commands, where both hold the same numbers by their names.

Orders may differ: GE-Sim's robot is commanded as [left joints, gripper, right joints, gripper], and policies
of it see both grippers last. Equal sizes say nothing. Nothing here imports torch.
"""

from __future__ import annotations

from typing import Any, TypeVar

from envs.embodiment import ActionKind, Embodiment

Numbers = TypeVar("Numbers", bound=Any)  # an array or a tensor


def same_numbers(robot: Embodiment) -> bool:
    """Whether an action holds targets of just the numbers that a state holds, in whatever order."""
    return not robot.delta and {*robot.action_names} == {*robot.state_names}


def joints_are_states(robot: Embodiment) -> bool:
    """Whether an action holds targets of just the joints that a state holds, in whatever order."""
    return robot.action_kind is ActionKind.JOINTS and same_numbers(robot)


def as_states(robot: Embodiment, commands: Numbers) -> Numbers:
    """Commands [..., A] as states [..., A], of robots of the same numbers; grippers in units of readings."""
    out = commands[..., [robot.action_names.index(name) for name in robot.state_names]]
    for arm, readings in _read_otherwise(robot):
        place = robot.state_names.index(robot.action_names[arm.gripper])
        out[..., place] = _between(out[..., place], arm.gripper_range, readings)
    return out


def as_commands(robot: Embodiment, states: Numbers) -> Numbers:
    """The inverse of `as_states`."""
    out = states[..., [robot.state_names.index(name) for name in robot.action_names]]
    for arm, readings in _read_otherwise(robot):
        out[..., arm.gripper] = _between(out[..., arm.gripper], readings, arm.gripper_range)
    return out


def _read_otherwise(robot: Embodiment) -> list[tuple[Any, tuple[float, float]]]:
    """Arms whose grippers states hold in another unit than commands, and their readings open and closed."""
    read = [(arm, arm.gripper_readings) for arm in robot.arms if arm.gripper is not None]
    return [(arm, readings) for arm, readings in read if readings is not None]


def _between(values: Numbers, known: tuple[float, float], wanted: tuple[float, float]) -> Numbers:
    """Values counted from one range to another, beyond where they go beyond."""
    return wanted[0] + (values - known[0]) * ((wanted[1] - wanted[0]) / (known[1] - known[0]))
