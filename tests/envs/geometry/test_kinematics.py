"""Forward kinematics agrees with the physics bench, and reads URDF files without their meshes."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from envs.embodiment import EmbodimentError, Robot
from envs.episodes.formats.lerobot.info import INFO_KEY, from_info, to_info
from envs.geometry.kinematics import Kinematics, KinematicsError
from tests.embodiments import BIMANUAL_JOINTS


def _urdf(path: Path) -> Path:
    links, joints = ['<link name="base"/>'], []
    for side, y in (("l", 0.2), ("r", -0.2)):
        before = "base"
        for k in range(1, 8):
            name = f"link{k}_{side}"
            links.append(
                f'<link name="{name}"><visual><geometry><mesh filename="nowhere/{name}.stl"/></geometry>'
                "</visual></link>"
            )
            offset = f"0 {y} 0" if k == 1 else "0 0 0.1"
            joints.append(
                f'<joint name="joint{k}_{side}" type="revolute"><parent link="{before}"/>'
                f'<child link="{name}"/><origin xyz="{offset}" rpy="0 0 0"/>'
                '<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
            )
            before = name
        links.append(f'<link name="tool_{side}"/>')
        joints.append(
            f'<joint name="fixed_{side}" type="fixed"><parent link="{before}"/>'
            f'<child link="tool_{side}"/><origin xyz="0.05 0 0" rpy="0 0 0"/></joint>'
        )
    path.write_text(f'<robot name="two">{"".join(links)}{"".join(joints)}</robot>')
    return path


def test_a_urdf_without_its_meshes(tmp_path: Path) -> None:
    names = tuple(tuple(f"joint{k}_{side}" for k in range(1, 8)) for side in "lr")
    arms = Kinematics(Robot(str(_urdf(tmp_path / "two.urdf")), names, ("tool_l", "tool_r")))
    turned = torch.zeros(2, 7)
    turned[1, 0] = np.pi / 2
    poses = arms.flanges([turned, torch.zeros(2, 7)])
    assert torch.allclose(poses[0, 0], torch.tensor([0.05, 0.2, 0.6, 0, 0, 0]), atol=1e-6)
    assert torch.allclose(poses[1, 0], torch.tensor([0.0, 0.25, 0.6, 0, 0, np.pi / 2]), atol=1e-5)
    assert torch.allclose(poses[1, 1], poses[0, 1])
    with pytest.raises(KinematicsError, match="7 joints of arm 0"):
        arms.flanges([turned[:, :6], turned])
    one = Kinematics(Robot(str(tmp_path / "two.urdf"), names[1:], ("tool_r",)))
    assert torch.allclose(one.flanges([torch.zeros(7)])[0], poses[0, 1])
    with pytest.raises(KinematicsError, match="no joint 'elbow'"):
        Kinematics(Robot(str(tmp_path / "two.urdf"), (("elbow",) * 7, names[1]), ("tool_l", "tool_r")))
    with pytest.raises(KinematicsError, match="no link or site 'hand'"):
        Kinematics(Robot(str(tmp_path / "two.urdf"), names, ("hand", "tool_r")))
    with pytest.raises(KinematicsError, match="does not exist"):
        Kinematics(Robot(str(tmp_path / "none.urdf"), names, ("tool_l", "tool_r")))
    (tmp_path / "bad.urdf").write_text("<robot")
    with pytest.raises(KinematicsError, match="cannot be read"):
        Kinematics(Robot(str(tmp_path / "bad.urdf"), names, ("tool_l", "tool_r")))


def turning(joints: list[np.ndarray], held: dict[str, float]) -> np.ndarray:
    """A maker's library: each arm turns about z by the sum of its joints, at the height of the waist."""
    out = np.tile(np.eye(4), (len(joints[0]), len(joints), 1, 1))
    for arm, angles in enumerate(joints):
        turn = angles.sum(-1)
        out[:, arm, 0, 0] = out[:, arm, 1, 1] = np.cos(turn)
        out[:, arm, 1, 0], out[:, arm, 0, 1] = np.sin(turn), -np.sin(turn)
        out[:, arm, 2, 3] = held["waist"]
    return out


def test_a_library_instead_of_a_description() -> None:
    names = (("a", "b"), ("c", "d"))
    robot = Robot(f"python:{__name__}.turning", names, ("left", "right"), {"waist": 0.4})
    poses = Kinematics(robot).flanges([torch.full((3, 5, 2), 0.25), torch.zeros(3, 5, 2)])
    assert poses.shape == (3, 5, 2, 6)
    assert torch.allclose(poses[1, 2, 0], torch.tensor([0, 0, 0.4, 0, 0, 0.5]), atol=1e-6)
    assert torch.allclose(poses[1, 2, 1], torch.tensor([0, 0, 0.4, 0, 0, 0.0]), atol=1e-6)
    with pytest.raises(KinematicsError, match="does not import"):
        Kinematics(Robot(f"python:{__name__}.nothing", names, ("left", "right")))
    other = Kinematics(Robot(f"python:{__name__}.nonsense", names, ("left", "right")))
    with pytest.raises(KinematicsError, match=r"flange poses \[N, arms, 4, 4\]"):
        other.flanges([torch.zeros(1, 2)] * 2)
    own = replace(BIMANUAL_JOINTS, kinematics=robot)
    assert to_info(own)["kinematics"] is None
    features = {"action": {"shape": [1], "info": {INFO_KEY: {"kinematics": asdict(robot)}}}}
    features["observation.state"] = {"shape": [1]}
    features["observation.images.a"] = {"shape": [8, 8, 3], "dtype": "video"}
    with pytest.raises(EmbodimentError, match="names code"):
        from_info({"features": features, "fps": 10})


def nonsense(joints: list[np.ndarray], held: dict[str, float]) -> np.ndarray:
    """A library that answers joints."""
    return joints[0]
