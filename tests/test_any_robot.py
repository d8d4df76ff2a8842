"""The whole loop at its smallest, for robots that differ in all that an embodiment may differ in."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from envs.embodiment import Embodiment
from envs.episodes.formats.lerobot.info import from_info
from tests.commands import worldloop
from tests.envs.episodes.lerobot.sets import FakeSet, write_set

POSE = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
SMALL = (
    "experiment=soak",
    "track=disabled",
    "collect.episodes={train: 16, held_out: 6, calibration: 6}",
    "imitation.demos=2",
)


def loop(command: str, folder: Path, *words: str) -> None:
    """Run a command of the loop in a process of its own: `run`, or `rl` up to the last policy."""
    out = worldloop(folder, command, *SMALL, f"runs={folder}", *words)
    assert out.status == 0, out.output[-4000:]
    assert list((folder / "soak/stages").glob("rl-1-*/weights.safetensors"))


def robot_of(folder: Path) -> Embodiment:
    """The robot of what was collected."""
    (info,) = (folder / "soak/stages").glob("collect-*/dataset/meta/info.json")
    return from_info(json.loads(info.read_text()))


@pytest.mark.slow
@pytest.mark.long
def test_two_arms_by_poses_with_calibrated_cameras(tmp_path: Path) -> None:
    cameras = "task.suite.cameras=[head,hand_left,hand_right]"
    loop("rl", tmp_path, "task=push", cameras, "task.chunk=4", "task.horizon=12", "task.size=[48,48]")
    robot = robot_of(tmp_path)
    assert robot.action_dim == 14 and robot.calibrated and len(robot.cameras) == 3


@pytest.mark.slow
@pytest.mark.long
def test_two_arms_by_joints_inside_gesim(tmp_path: Path) -> None:
    joints = (
        "task=push",
        "task.suite.actions=joints",
        "task.chunk=5",
        "task.horizon=10",
        "task.size=[32,48]",
    )
    loop("rl", tmp_path, *joints, "simulator=gesim_tiny", "task.mode=absolute")
    assert robot_of(tmp_path).action_dim == 16


@pytest.mark.slow
@pytest.mark.long
def test_one_arm_by_deltas_of_meta_world(tmp_path: Path) -> None:
    pytest.importorskip("metaworld", reason="make setup installs metaworld")
    loop(
        "rl",
        tmp_path,
        "task=metaworld",
        "task.name=reach-v3",
        "task.chunk=4",
        "task.horizon=12",
        "task.size=[32,32]",
    )
    robot = robot_of(tmp_path)
    assert robot.action_dim == 4 and robot.delta and not robot.calibrated and len(robot.cameras) == 2


@pytest.mark.slow
def test_one_arm_from_recordings_with_cameras_of_different_sizes(tmp_path: Path) -> None:
    cameras = {"observation.images.front": (48, 64), "observation.images.wrist": (32, 32)}
    about = FakeSet("arm", 10.0, cameras, {"axes": POSE}, 7, labelled=True)
    write_set(tmp_path / "set", about)
    words = (
        "task=lerobot",
        f"task.data=[{tmp_path / 'set'}]",
        "task.chunk=4",
        "task.horizon=8",
        "task.size=[32,32]",
    )
    loop("run", tmp_path, *words, "imitation.sources=['*']")
    result = json.loads((tmp_path / "soak/result.json").read_text())
    assert result["physics_after"] is None and result["imagined_after"]["episodes"] > 0


@pytest.mark.slow
def test_somebody_elses_task_policy_and_algorithm(tmp_path: Path) -> None:
    suite = "suite: {_target_: examples.task_suite.DotToSquare}"
    task = f"+task={{{suite}, name: reach, size: [32,32], chunk: 4, horizon: 12, mode: absolute}}"
    policy = "+policy={_target_: examples.policy.CoarsePolicy, width: 32, std: 0.3}"
    algorithm = "+algorithm={_target_: examples.algorithm.Reinforce, entropy: 0.0}"
    loop("rl", tmp_path, "~task", task, "~policy", policy, "~algorithm", algorithm)
    assert robot_of(tmp_path).robot == "dot"
