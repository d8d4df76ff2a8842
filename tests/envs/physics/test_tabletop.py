"""The bench: arms do what they are told, success is held, cameras see what they should."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from envs.geometry.cameras import project
from envs.geometry.kinematics import Kinematics
from envs.physics.suite import SuiteError, build_suite
from envs.physics.tabletop.actions import MAX_JOINT_SPEED
from envs.physics.tabletop.suite import Tabletop
from envs.targets import ConfigError
from tests.envs.physics.sections import task_section


def tabletop(seed: int, **changes: Any) -> Tabletop:
    suite = build_suite(task_section("push", **{"control_hz": 10.0, **changes})["suite"])
    assert isinstance(suite, Tabletop)
    suite.reset("push", seed)
    return suite


@pytest.mark.parametrize("actions", ["end_effector", "joints"])
@pytest.mark.parametrize("control_hz", [10.0, 5.0])
def test_expert_succeeds_on_unseen_seeds(actions: str, control_hz: float) -> None:
    suite, won = tabletop(0, actions=actions, control_hz=control_hz), 0
    for seed in range(500_000, 500_015):
        suite.reset("push", seed)
        expert = suite.expert(0.0, np.random.default_rng(0))
        for _ in range(round(4 * control_hz)):
            if not suite.observe().success:
                suite.step(expert())
        won += suite.observe().success
    assert won >= 14


def test_success_must_be_held() -> None:
    suite = tabletop(1)
    bench, task = suite._bench, suite._task
    bench.data.qpos[task.joint : task.joint + 2] = task.target
    still = suite.observe().command
    for step in range(4):  # 0.4 s at 10 Hz
        assert suite.observe().success is False, step
        suite.step(still)
    assert suite.observe().success is True


def test_arms_reach_their_commands() -> None:
    suite = tabletop(3)
    command = suite.observe().command
    command[0] += 0.05
    command[7] += 0.05
    for _ in range(6):
        suite.step(command)
    assert np.abs(suite.privileged()["flange_poses"] - command.reshape(2, 7)[:, :6])[:, :3].max() < 0.008


@pytest.mark.parametrize("arm", [0, 1])
def test_arms_go_as_far_as_they_can_towards_what_lies_too_far_away(arm: int) -> None:
    suite = tabletop(3, control_hz=5.0)
    place = slice(7 * arm, 7 * arm + 3)
    for lateral in np.linspace(0.0, 0.3, 4) * (1 if arm else -1):  # across the middle, at the far edge
        for _ in range(8):
            command = suite.observe().command
            command[7 * (1 - arm)], command[7 * (1 - arm) + 1] = 0.0, 0.36 * (1 if arm else -1)
            command[place] = 0.46, lateral, command[place][2]
            suite.step(command)
        now = suite.observe().command[place]
        assert np.abs(suite.privileged()["flange_poses"][arm, :3] - now).max() < 0.004, lateral
        assert now[2] == command[place][2] and now[0] > 0.25


def test_joints_move_no_faster_than_they_may() -> None:
    suite = tabletop(3, actions="joints")
    before = suite.observe().command
    suite.step(before + 1.0)
    after = suite.observe().command
    assert np.abs(after - before)[:7].max() == pytest.approx(MAX_JOINT_SPEED / 10.0)
    assert after[7] == 1.0  # a gripper closes no further than it can


def test_described_kinematics_are_those_of_the_bench() -> None:
    suite = tabletop(4, actions="joints")
    seen, robot = suite.observe(), suite.embodiment
    assert robot.kinematics is not None and robot.commands_poses and seen.poses is not None
    assert tabletop(4).embodiment.kinematics is None and tabletop(4).embodiment.commands_poses
    kinematics = Kinematics(robot.kinematics)
    joints = [torch.from_numpy(seen.command[list(arm.numbers)]) for arm in robot.arms]
    told = kinematics.flanges(joints)[:, :3]
    assert np.abs(told.numpy() - seen.poses[:, :3]).max() < 1e-5
    assert np.abs(seen.poses[:, :3] - suite.privileged()["flange_poses"][:, :3]).max() < 0.005


def test_state_and_joint_commands_have_one_layout() -> None:
    suite = tabletop(5, actions="joints")
    seen = suite.observe()
    assert suite.embodiment.state_names == suite.embodiment.action_names
    assert np.abs(seen.state - seen.command).max() < 1e-6
    command = seen.command.copy()
    command[15] = 0.0  # open the right gripper
    for _ in range(3):
        suite.step(command)
    state = suite.observe().state
    assert state[15] < 0.1 and state[7] > 0.9


def test_block_is_seen_where_it_is() -> None:
    suite = tabletop(5, size=[128, 128], cameras=["head"])
    seen, block = suite.observe(), suite.privileged()["object_poses"][0, :3]
    picture = suite.render()[0].astype(float) / 255
    at, _ = project(
        torch.from_numpy(block).float()[None],
        torch.from_numpy(seen.intrinsic[0]).float(),
        torch.from_numpy(seen.c2w[0]).float(),
    )
    u, v = at[0].round().long().tolist()
    colour = suite._bench.model.geom("block").rgba[:3]
    shown = picture[:, v - 1 : v + 2, u - 1 : u + 2].mean((1, 2))
    assert np.abs(shown / shown.max() - colour / colour.max()).max() < 0.15
    assert suite.embodiment.views == ("head",) and suite.embodiment.wrists == (None,)


def test_unknown_actions_are_named() -> None:
    with pytest.raises(ConfigError, match=r"task\.suite\.actions='voice' .*end_effector.*joints"):
        tabletop(0, actions="voice")


def test_a_rate_that_the_simulation_does_not_divide_into_is_refused() -> None:
    for rate in (5.0, 8.0, 10.0, 25.0, 50.0):
        bench = tabletop(0, control_hz=rate)._bench
        assert bench.glides * bench.substeps * 0.005 == pytest.approx(1 / rate)
    with pytest.raises(SuiteError, match=r"task\.suite\.control_hz=15.0 must divide 200"):
        tabletop(0, control_hz=15.0)
