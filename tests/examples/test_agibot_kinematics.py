"""The example around a maker's library: its arms' base moves with the waist. The library itself is in no
package index, so the two calls that the example makes are answered here by a planar arm.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from envs.embodiment import Robot
from envs.geometry.kinematics import Kinematics
from examples import agibot_kinematics

_WAIST = (
    '<robot name="g1"><link name="base"/><link name="arm_base_link"/>'
    '<joint name="waist" type="prismatic"><parent link="base"/><child link="arm_base_link"/>'
    '<origin xyz="0.1 0 0.5" rpy="0 0 1.5707963"/><axis xyz="0 0 1"/>'
    '<limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>'
)


class _Solver:
    """An arm that reaches out by its first joint, to the left or to the right."""

    def __init__(self, part: str, urdf_path: str, config_path: str):
        assert Path(urdf_path).is_file() and config_path.endswith(".yaml")
        self.side = 1.0 if part == "left" else -1.0

    def compute_fk(self, joints: np.ndarray) -> np.ndarray:
        out = np.eye(4, dtype=np.float32)
        out[0, 3], out[1, 3] = joints[0], self.side
        return out


def test_flanges_stand_on_the_waist(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / agibot_kinematics.URDF).write_text(_WAIST)
    library = ModuleType("ik_solver")
    library.Solver = _Solver  # type: ignore[attr-defined]
    library.RobotPart = SimpleNamespace(LEFT_ARM="left", RIGHT_ARM="right")  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ik_solver", library)
    monkeypatch.setenv("AGIBOT_IK_SDK", str(tmp_path))
    names = tuple(tuple(f"{side}{n}" for n in range(7)) for side in "lr")
    model = f"python:{agibot_kinematics.__name__}.flanges"
    robot = Robot(model, names, ("left", "right"), {"waist": 0.25})
    reach = torch.zeros(2, 7)
    reach[1, 0] = 0.3
    poses = Kinematics(robot).flanges([reach, torch.zeros(2, 7)])
    # the waist turns the arms' base by a quarter: ahead becomes left, left becomes behind
    assert torch.allclose(poses[1, 0, :3], torch.tensor([0.1 - 1.0, 0.3, 0.75]), atol=1e-5)
    assert torch.allclose(poses[1, 1, :3], torch.tensor([0.1 + 1.0, 0.0, 0.75]), atol=1e-5)
    assert torch.allclose(poses[..., 5], torch.full((2, 2), np.pi / 2), atol=1e-5)
