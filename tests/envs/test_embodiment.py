"""Descriptions of robots that contradict themselves are refused, and lists are as good as tuples."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from envs.embodiment import Arm, Camera, EmbodimentError
from tests.embodiments import ARM_DELTAS


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"action_names": ("x", "x", "z", "gripper")}, r"action_names holds \['x'\] more than once"),
        ({"state_names": ("a", "b", "a")}, r"state_names holds \['a'\] more than once"),
        ({"state_names": ()}, r"state_names is empty; there is at least one number"),
        ({"action_names": (), "arms": ()}, r"action_names is empty"),
        ({"fps": 0.0}, r"fps=0\.0 must be frames per second, above 0"),
        ({"fps": -5.0}, r"fps=-5\.0 must be"),
        ({"fps": float("nan")}, r"fps=nan must be"),
    ],
)
def test_contradictions_are_refused_by_name(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(EmbodimentError, match=rf"^one_arm_deltas: {said}"):
        replace(ARM_DELTAS, **changes)


def test_grippers_open_where_they_are_not_closed() -> None:
    for name in ("gripper_range", "gripper_readings"):
        with pytest.raises(EmbodimentError, match=rf"arm arm has {name}=\(1\.0, 1\.0\), which is empty"):
            replace(ARM_DELTAS, arms=(replace(ARM_DELTAS.arms[0], **{name: [1.0, 1.0]}),))


def test_lists_are_taken_for_tuples() -> None:
    arms = [Arm("arm", [0, 1, 2], 3, [-1.0, 1.0])]  # type: ignore[arg-type]
    cameras = [Camera("corner", [32, 32]), Camera("behind", [32, 32])]  # type: ignore[arg-type]
    named = {name: list(getattr(ARM_DELTAS, name)) for name in ("action_names", "state_names")}
    robot = replace(ARM_DELTAS, arms=arms, cameras=cameras, **named)
    assert robot == ARM_DELTAS and not robot.differs(ARM_DELTAS) and hash(robot) == hash(ARM_DELTAS)
