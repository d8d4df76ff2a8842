"""A maker's own kinematics library in place of a description: AgiBot's `ik_solver`.

    AGIBOT_IK_SDK=<folder> worldloop serve simulator=gesim simulator.checkpoint=<folder> \\
        'simulator.kinematics={model: "python:examples.agibot_kinematics.flanges",
                               joints: [[...7], [...7]], flanges: [left, right], held: {...}}'

The folder is the one beside the library with the robot's URDF and the solver's settings. The library says
flange poses in the arms' common base, which waist joints move; where that stands is read from the URDF.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from envs.embodiment import Robot
from envs.geometry.kinematics import Kinematics

URDF, SETTINGS, BASE = "G1_NO_GRIPPER.urdf", "g1_solver.yaml", "arm_base_link"
_ARMS = ("LEFT_ARM", "RIGHT_ARM")


def flanges(joints: list[NDArray[np.float64]], held: dict[str, float]) -> NDArray[np.float64]:
    """Flange poses float64 [N, arms, 4, 4] in the robot's base, of joint angles [N, 7] of each arm."""
    base = _base(tuple(sorted(held.items())))
    poses = [
        [
            base @ np.asarray(solver.compute_fk(row), np.float64).reshape(4, 4)
            for row in arm.astype(np.float32)
        ]
        for solver, arm in zip(_solvers(), joints, strict=True)
    ]
    return np.stack([np.stack(arm) for arm in poses], 1)


def _sdk() -> Path:
    folder = os.environ.get("AGIBOT_IK_SDK")
    if folder is None:
        raise ImportError(f"set AGIBOT_IK_SDK to the folder that holds {URDF} and {SETTINGS}")
    return Path(folder)


@cache
def _solvers() -> tuple[Any, ...]:
    import ik_solver  # type: ignore[import-not-found]  # comes with the robot's software, from no package index

    files = {"urdf_path": str(_sdk() / URDF), "config_path": str(_sdk() / SETTINGS)}
    return tuple(ik_solver.Solver(part=getattr(ik_solver.RobotPart, arm), **files) for arm in _ARMS)


@cache
def _base(held: tuple[tuple[str, float], ...]) -> NDArray[np.float64]:
    """Pose [4, 4] of the arms' common base when waist joints stand as they are held."""
    robot = Robot(str(_sdk() / URDF), ((),), (BASE,), dict(held))
    pose = Kinematics(robot).flanges([torch.zeros(1, 0)])[0, 0].double().numpy()
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_euler("xyz", pose[3:]).as_matrix(), pose[:3]
    return out
