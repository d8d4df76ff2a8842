"""A robot goes into info.json and comes back; what cannot be is named by its key."""

from __future__ import annotations

from typing import Any

import pytest

from envs.embodiment import ActionKind, Arm, Embodiment, EmbodimentError
from envs.episodes.formats.lerobot.info import depth_features, from_info, to_info
from envs.episodes.formats.lerobot.names import feature_names, guess_action, guess_arms
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
        (("kLeftShoulderPitch", "kLeftWristYaw", "kRightElbow", "kLeftHandPinky", "kRightHandIndex"),
         (Arm("left", (0, 1)), Arm("right", (2,)))),  # as Unitree's sets say; fingers are no arm's
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


TWO = ("joint_0", "joint_1", "gripper")


@pytest.mark.parametrize(
    ("names", "told"),
    [
        ({"motors": ["a", "b", "c"]}, ("a", "b", "c")),
        ({"delta_x": 0, "gripper": 2, "delta_y": 1}, ("delta_x", "delta_y", "gripper")),
        ([["a", "b"], ["c"]], ("a", "b", "c")),
        ({"left": ["a", "b"], "right": ["c"]}, ("a", "b", "c")),
        ({"left": ["a", "b"], "right": ["a"]}, ("left.a", "left.b", "right.a")),
        ({"motors": {"left": ["a"], "right": ["a", "b"]}}, ("left.a", "right.a", "right.b")),
        ({"left": {"joints": ["a"], "hand": ["g"]}, "right": ["a"]},
         ("left.joints.a", "left.hand.g", "right.a")),
        ({"left": {"x": 0}, "right": {"y": 1, "x": 0}}, ("left.x", "right.x", "right.y")),
        (["a", "a", "b"], ("a_0", "a_1", "b")),
        (["a", "a", "a_0"], ("a_1", "a_2", "a_0")),
        (["a", "b"], ("0", "1", "2")),
        (None, ("0", "1", "2")),
    ],
    ids=str,
)  # fmt: skip
def test_every_number_has_a_name_of_its_own(names: Any, told: tuple[str, ...]) -> None:
    assert feature_names({"shape": [3], "names": names}) == told


@pytest.mark.parametrize(
    ("names", "arms"),
    [
        ({"left_arm": TWO, "right_arm": TWO}, (Arm("left", (0, 1), 2), Arm("right", (3, 4), 5))),
        (
            {side: {"joints": ["j0", "j1"], "gripper": ["g"]} for side in ("left", "right")},
            (Arm("left", (0, 1), 2), Arm("right", (3, 4), 5)),
        ),
        ({"left": ["x", "y", "z"], "right": ["x", "y", "z"]},
         (Arm("left", (0, 1, 2)), Arm("right", (3, 4, 5)))),
    ],
    ids=str,
)  # fmt: skip
def test_arms_are_guessed_from_names_below_keys(names: Any, arms: tuple[Arm, ...]) -> None:
    told = feature_names({"shape": [6], "names": names})
    assert guess_arms(told, guess_action(told)[0]) == arms


ARM = {"name": "a", "numbers": [0, 1]}


@pytest.mark.parametrize(
    ("own", "match"),
    [
        ({"action_knid": "joints"}, r"worldloop\.action_knid is not an option.*did you mean action_kind"),
        ({"Delta": True}, r"worldloop\.Delta is not an option.*did you mean delta"),
        ({"delta": "false"}, r"worldloop\.delta='false' should be a valid boolean"),
        ({"cameras": ["front"]}, r"worldloop\.cameras=\('front',\) should be a"),
        ({"cameras": {"front": True}}, r"worldloop\.cameras\.front=True should be a"),
        ({"cameras": {"front": {"calibrated": "no"}}}, r"cameras\.front\.calibrated='no' should be a"),
        ({"cameras": {"front": {"size": [9, 9]}}}, r"cameras\.front\.size is not an option"),
        ({"arms": [{**ARM, "grippr": 6}]}, r"arms\.0\.grippr is not an option.*did you mean gripper"),
        ({"arms": [{**ARM, "numbers": [0.0, 1.0]}]}, r"arms\.0\.numbers\.0=0\.0 should be a valid integer"),
        ({"arms": [{**ARM, "numbers": ["0"]}]}, r"arms\.0\.numbers\.0='0' should be a valid integer"),
        ({"arms": [{**ARM, "gripper": 6.0}]}, r"arms\.0\.gripper=6\.0 should be a"),
        ({"arms": [{**ARM, "gripper_range": [0, "1"]}]}, r"arms\.0\.gripper_range\.1='1' should be a"),
        ({"arms": [{**ARM, "numbers": [0, 0]}]}, "number 0 of the action is of arm a and again of arm a"),
        ({"arms": [{**ARM, "gripper": 1}]}, "number 1 of the action is of arm a and again of arm a"),
        ({"arms": [ARM, {**ARM, "name": "b"}]}, "number 0 of the action is of arm a and again of arm b"),
        ({"arms": [ARM, {**ARM, "numbers": [2]}]}, r"arms \['a', 'a'\] need different names"),
        ({"kinematics": {"model": "a.urdf", "joints": [], "flange": []}}, r"kinematics\.flange is not an"),
        ([], r"worldloop=\[\] should be a dictionary"),
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


@pytest.mark.parametrize(
    ("key", "value", "match"),
    [
        ("fps", None, "^fps=None should be the number of frames"),
        ("fps", 0, "^fps=0 should be"),
        ("fps", "30", "^fps='30' should be"),
        ("features", [1], r"^features=\[1\] should hold a dictionary"),
        ("features.action.shape", None, r"^features\.action\.shape=None should be a list"),
        ("features.observation.state.shape", [6.5], r"^features\.observation\.state\.shape=\[6\.5\] should"),
        (
            "features.observation.images.front.shape",
            None,
            r"^features\.observation\.images\.front\.shape=None",
        ),
        ("features.observation.images.front.shape", [9], r"front\.shape=\[9\] should be \[height"),
        ("features.action.info", "x", r"^features\.action\.info='x' should be a dictionary"),
    ],
)
def test_what_is_wrong_elsewhere_is_not_blamed_on_our_section(key: str, value: Any, match: str) -> None:
    info = described(ARM_JOINTS, {})
    del info["features"]["action"]["info"]
    first, _, rest = key.partition(".")
    if rest:
        feature, _, part = rest.rpartition(".")
        info[first][feature][part] = value
    else:
        info[first] = value
    with pytest.raises(EmbodimentError, match=match):
        from_info(info)


def test_pictures_of_one_channel_or_many_bits_are_no_cameras() -> None:
    info = described(ARM_JOINTS, {})
    shown = {
        "deep": {"dtype": "image", "shape": [48, 64, 1], "names": ["height", "width", "channels"]},
        "first": {"dtype": "image", "shape": [1, 48, 64], "names": ["channels", "height", "width"]},
        "flat": {"dtype": "image", "shape": [48, 64]},
        "wide": {"dtype": "video", "shape": [48, 64, 3], "info": {"video.pix_fmt": "gray16le"}},
    }
    info["features"] |= {f"observation.images.{name}": feature for name, feature in shown.items()}
    marked = {"dtype": "video", "shape": [48, 64, 3], "info": {"video.is_depth_map": True}}
    info["features"]["observation.images.marked"] = marked
    assert from_info(info).views == ARM_JOINTS.views
    assert depth_features(info["features"]) == [f"observation.images.{name}" for name in shown]
    for camera in ARM_JOINTS.cameras:
        del info["features"][f"observation.images.{camera.name}"]
    with pytest.raises(EmbodimentError, match=r"images\.\*'\] are missing.*images\.deep.*for depth"):
        from_info(info)
