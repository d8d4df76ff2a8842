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
    """Commands [..., A] as states [..., A], of robots of the same numbers."""
    return commands[..., [robot.action_names.index(name) for name in robot.state_names]]


def as_commands(robot: Embodiment, states: Numbers) -> Numbers:
    """The inverse of `as_states`."""
    return states[..., [robot.state_names.index(name) for name in robot.action_names]]
