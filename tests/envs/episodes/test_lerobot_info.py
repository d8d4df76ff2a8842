"""A robot goes into info.json and comes back; what cannot be is named by its key."""

from __future__ import annotations

from typing import Any

import pytest

from envs.embodiment import ActionKind, Arm, Embodiment, EmbodimentError
from envs.episodes.formats.lerobot_info import from_info, guess_action, guess_arms, to_info
from tests.embodiments import ARM_JOINTS, EMBODIMENTS


def described(robot: Embodiment, own: dict[str, Any]) -> dict[str, Any]:
    features: dict[str, Any] = {
        "action": {
            "shape": [robot.action_dim],
            "names": list(robot.action_names),
            "info": {"worldloop": own},
        },
        "observation.state": {"shape": [robot.state_dim], "names": list(robot.state_names)},
    }
    for camera in robot.cameras:
        features[f"observation.images.{camera.name}"] = {"dtype": "video", "shape": [*camera.size, 3]}
    return {"robot_type": robot.robot, "fps": robot.fps, "features": features}


@pytest.mark.parametrize("name", sorted(EMBODIMENTS))
def test_every_robot_comes_back(name: str) -> None:
    robot = EMBODIMENTS[name]
    assert from_info(described(robot, to_info(robot))) == robot


def test_a_few_keys_written_by_hand_are_enough() -> None:
    robot = ARM_JOINTS
    view = robot.views[0]
    own = {"arms": [{"name": "arm", "numbers": [0, 1]}], "cameras": {view: {"wrist": "arm"}}}
    found = from_info(described(robot, {**own, "action_kind": "joints"}))
    assert found.action_kind is ActionKind.JOINTS and found.arms[0].gripper is None
    assert found.cameras[0].wrist == "arm" and not found.cameras[0].calibrated


@pytest.mark.parametrize(
    ("names", "arms"),
    [
        (("delta_x", "delta_y", "delta_z", "gripper"), (Arm("arm", (0, 1, 2), 3),)),
        (("gripper", "yaw", "pitch", "roll", "z", "y", "x"), (Arm("arm", (6, 5, 4, 3, 2, 1), 0),)),
        (("ee.x", "ee.y", "ee.z", "ee.wx", "ee.wy", "ee.wz"), (Arm("arm", (0, 1, 2)),)),
        (
            ("right_x", "right_y", "right_z", "left_x", "left_y", "left_z", "left_gripper"),
            (Arm("right", (0, 1, 2)), Arm("left", (3, 4, 5), 6)),
        ),
        (("joint_1", "joint_2", "gripper_position"), (Arm("arm", (0, 1), 2),)),
        (
            ("arm_shoulder_pan.pos", "arm_elbow_flex.pos", "arm_wrist_roll.pos", "arm_gripper.pos", "x.vel"),
            (Arm("arm", (0, 1, 2), 3, (100.0, 0.0)),),
        ),
        (("left_joint1", "left_gripper", "right_joint1", "right_gripper", "head_joint1"),
         (Arm("left", (0,), 1), Arm("right", (2,), 3))),
        (("joint_1", "gripper_left_finger", "gripper_right_finger"), ()),  # sides of one gripper
        (("joint_1", "joint_2", "gripper_a", "gripper_b"), ()),  # which is the gripper?
        (("x", "y", "z", "target_x", "target_y", "target_z"), ()),  # which is the pose?
        (("motor_0", "motor_1"), ()),
        (("0", "1", "2", "3", "4", "5", "6"), ()),
    ],
    ids=str,
)  # fmt: skip
def test_arms_are_guessed_where_names_tell(names: tuple[str, ...], arms: tuple[Arm, ...]) -> None:
    assert guess_arms(names, guess_action(names)[0]) == arms


@pytest.mark.parametrize(
    ("own", "match"),
    [
        ({"action_kind": "legs"}, r"info\.worldloop.*'legs'"),
        ({"arms": [{"name": "arm"}]}, r"info\.worldloop.*numbers"),
        ({"arms": [{"name": "arm", "numbers": [99]}]}, r"arm uses numbers \[99\]"),
        ({"cameras": {"nose": {"calibrated": True}}}, r"cameras names \['nose'\]"),
        ({"kinematics": {"model": "python:os.getcwd", "joints": [], "flanges": []}}, "names code"),
    ],
)
def test_what_cannot_be_is_named(own: dict[str, Any], match: str) -> None:
    with pytest.raises(EmbodimentError, match=match):
        from_info(described(ARM_JOINTS, own))
