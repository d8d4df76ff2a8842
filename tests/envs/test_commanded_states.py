"""Whether commands say states is a matter of names, not of sizes, and so is their order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from envs.commanded_states import as_commands, as_states, joints_are_states, same_numbers
from envs.embodiment import Embodiment
from envs.episodes.formats.lerobot.numbers import first_command
from envs.simulators.remote.engine import GivenStates, RemoteError, RemoteSimulator
from envs.simulators.state_experts.flow import StateTokens
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, BIMANUAL_JOINTS, BIMANUAL_POSES, world_spec

NAMES = BIMANUAL_JOINTS.action_names
GRIPPERS_LAST = replace(BIMANUAL_JOINTS, state_names=(*NAMES[:7], *NAMES[8:15], NAMES[7], NAMES[15]))
OTHERS = replace(BIMANUAL_JOINTS, state_names=tuple(f"torque{k}" for k in range(16)))


@pytest.mark.parametrize(
    ("robot", "same", "joints"),
    [
        (ARM_JOINTS, True, True),
        (GRIPPERS_LAST, True, True),
        (OTHERS, False, False),
        (BIMANUAL_POSES, True, False),
        (ARM_DELTAS, False, False),
        (replace(ARM_JOINTS, delta=True), False, False),
    ],
)
def test_names_say_whether_commands_are_states(robot: Embodiment, same: bool, joints: bool) -> None:
    assert same_numbers(robot) == same and joints_are_states(robot) == joints
    assert StateTokens(robot).absolute == joints


def test_orders_that_differ_are_brought_about_by_names() -> None:
    commands = np.arange(16.0)
    states = [*range(7), *range(8, 15), 7, 15]
    assert as_states(GRIPPERS_LAST, commands).tolist() == states
    assert as_states(GRIPPERS_LAST, torch.arange(32).reshape(2, 16))[1].tolist() == [16 + n for n in states]
    assert np.array_equal(as_commands(GRIPPERS_LAST, as_states(GRIPPERS_LAST, commands)), commands)


def test_grippers_are_counted_from_commands_to_readings() -> None:
    arms = (replace(BIMANUAL_JOINTS.arms[0], gripper_readings=(35.0, 120.0)), BIMANUAL_JOINTS.arms[1])
    robot, commands = replace(GRIPPERS_LAST, arms=arms), torch.zeros(2, 16)
    commands[:, 7] = torch.tensor([1.0, 0.2])
    states = as_states(robot, commands)
    assert states[:, 14].tolist() == [120.0, 52.0] and not states[:, [*range(14), 15]].any()
    assert torch.allclose(as_commands(robot, states), commands) and commands[0, 7] == 1.0
    closed = first_command(robot, commands.numpy(), states.numpy())  # no reading is taken for a command
    assert np.array_equal(closed, commands[0].numpy())


def test_the_first_command_of_a_recording_is_its_first_state_by_names() -> None:
    action, states = np.arange(48.0).reshape(3, 16), -np.arange(48.0).reshape(3, 16)
    first = first_command(GRIPPERS_LAST, action, states)
    assert first[[6, 7, 8, 15]].tolist() == [-6, -14, -7, -15]
    assert np.array_equal(first_command(OTHERS, action, states), action[0])


def test_commands_stand_in_for_states_by_names() -> None:
    zero, none = torch.zeros(1, dtype=torch.int64), TensorDict({}, [1])
    nothing, commands = torch.full((1, 4, 16), torch.nan), torch.arange(16.0).expand(1, 4, -1)

    def given(robot: Embodiment) -> torch.Tensor:
        connection = {"connect_s": 5.0, "deadline_s": 60.0, "retries": 1, "user": "test"}
        far = RemoteSimulator(world_spec(robot), 3, ("http://127.0.0.1:9",), connection)
        return GivenStates(far).decode(nothing, commands, none, zero, zero)

    assert given(GRIPPERS_LAST)[0, 0, [7, 14, 15]].tolist() == [8, 7, 15]
    with pytest.raises(RemoteError, match=r"no joints with the names of its state, \['torque0'"):
        given(OTHERS)
