"""A robot goes into info.json and comes back; what cannot be is named by its key."""

from __future__ import annotations

from typing import Any

import pytest

from envs.embodiment import ActionKind, Embodiment, EmbodimentError
from envs.episodes.formats.lerobot_info import from_info, to_info
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
