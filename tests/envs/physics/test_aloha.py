"""gym-aloha: its rewards decide, experts succeed, divergence is an error, missing packages are named."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from envs.embodiment import ActionKind
from envs.physics.mujoco_suite import SimulationDiverged
from envs.physics.suite import build_suite
from envs.targets import ConfigError
from tests.envs.physics.sections import task_section

pytest.importorskip("gym_aloha", reason="make setup installs gym-aloha")

from envs.physics.aloha.arms import ArmKinematics, Hand, facing
from envs.physics.aloha.cameras import load_model
from envs.physics.aloha.suite import Aloha


@pytest.fixture(scope="module")
def suite() -> Aloha:
    made = built()
    assert isinstance(made, Aloha)
    return made


def built(**changes: Any) -> Any:
    return build_suite(task_section("aloha", **changes)["suite"])


@pytest.mark.parametrize("task", ["transfer_cube", "insertion"])
def test_experts_succeed(suite: Aloha, task: str) -> None:
    won = 0
    for seed in range(4):
        suite.reset(task, 300 + seed)
        expert = suite.expert(0.0, np.random.default_rng(seed))
        rewards = [suite.observe().progress]
        for _ in range(70):
            if not suite.observe().success:
                suite.step(expert())
                rewards.append(suite.observe().progress)
        won += suite.observe().success
        assert set(rewards) <= {0.0, 0.25, 0.5, 0.75, 1.0}
        assert not suite.observe().success or rewards[-1] == 1.0
    assert won >= 3


@pytest.mark.parametrize("task", ["transfer_cube", "insertion"])
def test_starts_and_dynamics_are_those_of_gym_aloha(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from dm_control.mujoco import Physics
    from gym_aloha.env import AlohaEnv

    # its pictures play no part here, and ask for a screen
    monkeypatch.setattr(Physics, "render", lambda *_, **__: np.zeros((48, 64, 3), np.uint8))
    theirs = AlohaEnv(task)
    theirs.reset(seed=7)
    ours = built(control_hz=50.0, hold=0.0)
    ours.reset(task, 7)
    physics, env = theirs._env.physics, theirs._env
    assert np.array_equal(
        physics.data.qpos[16:], ours.privileged()["object_poses"].flatten()[: physics.model.nq - 16]
    )
    for k in range(25):
        command = ours.observe().command + 0.02 * np.cos(np.arange(14) + k)
        ours.step(command)
        env.task.before_step(ours.observe().command, physics)
        physics.step(env._n_sub_steps)
        assert np.array_equal(env.task.get_qpos(physics), ours.observe().state)
        assert env.task.get_reward(physics) == 4 * ours.observe().progress


@pytest.mark.parametrize("task", ["transfer_cube", "insertion"])
def test_every_start_is_either_inner_or_outer(suite: Aloha, task: str) -> None:
    inner, outer = (built(starts=starts) for starts in ("inner", "outer"))
    found = []
    for seed in range(12):
        for one in (suite, inner, outer):
            one.reset(task, seed)
        poses = [one.privileged()["object_poses"] for one in (suite, inner, outer)]
        assert 0.42 <= poses[1][0, 1] <= 0.58  # of .4..6 m
        found.append(tuple(np.array_equal(poses[0], chosen) for chosen in poses[1:]))
    assert set(found) == {(True, False), (False, True)}


def test_fourteen_joint_commands_move_two_arms(suite: Aloha) -> None:
    robot = suite.embodiment
    assert robot.action_kind is ActionKind.JOINTS and not robot.delta
    assert robot.action_names[6] == "left_gripper" and robot.action_names[7] == "right_waist"
    suite.reset("transfer_cube", 1)
    before = suite.observe()
    command = before.command.copy()
    command[[0, 13]] = 0.3, 1.0  # turn the left waist, open the right gripper
    for _ in range(10):
        suite.step(command)
    moved = suite.observe().state - before.state
    assert abs(moved[0] - 0.3) < 0.03 and moved[13] > 0.7
    assert np.abs(np.delete(moved, (0, 13))).max() < 0.03
    assert np.array_equal(suite.observe().command, command)


def test_commands_are_cut_at_limits_and_speed(suite: Aloha) -> None:
    suite.reset("transfer_cube", 1)
    start = suite.observe().command
    suite.step(np.full(14, 9.0))
    assert np.allclose(suite.observe().command[:3], start[:3] + 0.4)  # 4 rad/s for 0.1 s
    assert suite.observe().command[6] == 1.0
    for _ in range(20):
        suite.step(np.full(14, 9.0))
    assert np.allclose(suite.observe().command[:3], (3.14158, 1.25664, 1.6057))


def test_flailing_never_breaks_an_episode(suite: Aloha) -> None:
    rng = np.random.default_rng(0)
    suite.reset("insertion", 1)
    for _ in range(60):
        suite.step(rng.uniform(-3.2, 3.2, 14))
        assert np.isfinite(suite.observe().state).all()


@pytest.mark.parametrize("speed", [1e12, np.nan])
def test_physics_that_diverges_is_an_error_and_no_episode_at_rest(
    suite: Aloha, speed: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log
    suite.reset("insertion", 1)
    suite.step(suite.observe().command)
    suite._bench.data.qvel[0] = speed
    with pytest.raises(SimulationDiverged, match=r"physics diverged under the action \[.*: mjWARN_BADQ"):
        suite.step(suite.observe().command + 0.1)


def test_the_state_says_nothing_of_objects(suite: Aloha) -> None:
    states, objects = [], []
    for seed in (1, 2):
        suite.reset("insertion", seed)
        states.append(suite.observe().state)
        objects.append(suite.privileged()["object_poses"])
    assert np.array_equal(*states) and not np.array_equal(*objects)
    suite.reset("transfer_cube", 1)
    cube, none = suite.privileged()["object_poses"]
    assert cube[:3].any() and not none.any()


def test_joints_are_found_that_bring_both_hands_to_a_place() -> None:
    from gym_aloha.constants import ASSETS_DIR, START_ARM_POSE

    path = str(ASSETS_DIR / "bimanual_viperx_transfer_cube.xml")
    arms = ArmKinematics(mujoco.MjModel.from_xml_path(path))
    start = np.reshape(START_ARM_POSE, (2, 8))[:, :6]
    wanted = [Hand(np.array([x, 0.45, 0.1]), facing(side, 0.8), 1.0) for side, x in enumerate((-0.1, 0.1))]
    found = arms.forward(arms.solve(wanted, start, np.pi, iterations=100), (1.0, 1.0))
    for hand, goal in zip(found, wanted, strict=True):
        assert np.abs(hand.position - goal.position).max() < 2e-3
        assert np.abs(hand.rotation - goal.rotation).max() < 5e-3


def test_cameras_are_added_and_nothing_else() -> None:
    from gym_aloha.constants import ASSETS_DIR

    path = str(ASSETS_DIR / "bimanual_viperx_insertion.xml")
    ours, theirs = load_model(path), mujoco.MjModel.from_xml_path(path)
    assert ours.ncam == theirs.ncam + 3
    for name in ("body_mass", "body_inertia", "geom_size", "geom_friction", "mesh_vert", "actuator_gainprm"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name)), name


def test_cameras_may_be_calibrated() -> None:
    suite = built(calibrated=True, cameras=["scene", "top", "vis", "right_hand"])
    suite.reset("transfer_cube", 1)
    seen = suite.observe()
    assert suite.embodiment.calibrated and seen.c2w.shape == (4, 4, 4)
    assert seen.c2w[0, 2, 1] < 0  # the picture's down is the world's down
    assert [camera.wrist for camera in suite.embodiment.cameras] == [None, None, None, "right"]
    cube = np.append(suite.privileged()["object_poses"][0, :3], 1.0)
    point = seen.intrinsic[0] @ (np.linalg.inv(seen.c2w[0]) @ cube)[:3]
    column, row = np.rint(point[:2] / point[2] - 0.5).astype(int)
    red, green, _ = suite.render()[0, :, row, column].astype(int)
    assert red > green + 60  # the cube is where calibration says


def test_rates_must_divide_that_of_the_simulation() -> None:
    with pytest.raises(ConfigError, match=r"task\.suite\.control_hz=30.0 must divide"):
        built(control_hz=30.0)


def test_a_missing_package_is_named_with_the_line_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gym_aloha.tasks.sim", None)
    with pytest.raises(ConfigError, match=r"pip install --no-deps dm_control==1\.0\.41 gym-aloha==0\.1\.5"):
        built()
