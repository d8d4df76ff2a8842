"""From joints to flange poses: forward kinematics of any two-armed robot described by a URDF or MJCF file.

MuJoCo reads the file; only its kinematic tree is used, so meshes need not be there.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
import torch
from torch import Tensor

from envs.layouts import JointLayout, Joints
from envs.physics.tabletop.scene import build_mjcf


class KinematicsError(ValueError):
    """A robot description is missing or does not have the joints or frames that are asked for."""


@dataclass(frozen=True)
class Robot:
    """A robot description and the names in it.

    Args:
        model: path of a URDF or MJCF file; "" is our own bench.
        joints: names of the seven joints of the left, then of the right arm.
        flanges: names of the two bodies (URDF links) or sites whose poses are end-effector poses.
        held: joints that stand still, such as head and waist, and their values in radians.
    """

    model: str = ""
    joints: tuple[tuple[str, ...], tuple[str, ...]] = (
        tuple(f"left_joint{k}" for k in range(1, 8)),
        tuple(f"right_joint{k}" for k in range(1, 8)),
    )
    flanges: tuple[str, str] = ("left_flange", "right_flange")
    held: Mapping[str, float] = field(default_factory=dict)


class Kinematics:
    """Forward kinematics of both arms.

    Args:
        robot: which.

    Raises:
        KinematicsError: naming what the description lacks.
    """

    def __init__(self, robot: Robot | None = None):
        self.robot = robot = robot or Robot()
        self.model = _compile(robot.model)
        self.data = mujoco.MjData(self.model)
        if any(len(arm) != 7 for arm in robot.joints):
            raise KinematicsError(
                f"kinematics.joints must name seven joints an arm, got {[len(arm) for arm in robot.joints]}"
            )
        self.places = np.array([[self._joint(name) for name in arm] for arm in robot.joints])
        self.frames = [self._frame(name) for name in robot.flanges]
        for name, value in robot.held.items():
            self.data.qpos[self._joint(name)] = value

    def _joint(self, name: str) -> int:
        number = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name)
        if number < 0:
            known = [self.model.joint(k).name for k in range(self.model.njnt)]
            raise KinematicsError(
                f"{self.robot.model or 'the bench'} has no joint {name!r}; it has {known}. Set kinematics.joints or kinematics.held."
            )
        return int(self.model.jnt_qposadr[number])

    def _frame(self, name: str) -> tuple[str, int]:
        for kind, what in (("site", mujoco.mjtObj.mjOBJ_SITE), ("body", mujoco.mjtObj.mjOBJ_BODY)):
            number = mujoco.mj_name2id(self.model, what, name)
            if number >= 0:
                return kind, number
        known = [self.model.body(k).name for k in range(1, self.model.nbody)]
        raise KinematicsError(
            f"{self.robot.model or 'the bench'} has no link or site {name!r}; its links are {known}. Set kinematics.flanges."
        )

    def flanges(self, joints: Joints) -> Tensor:
        """Flange poses float32 [..., 14] = [x, y, z, roll, pitch, yaw, gripper] x 2 of joint numbers;
        grippers pass as they are.
        """
        rows = joints.to(JointLayout.PER_ARM)
        flat = rows.reshape(-1, 16).double().cpu().numpy()
        out = np.empty((len(flat), 14))
        for n, row in enumerate(flat):
            self.data.qpos[self.places] = (row[:7], row[8:15])
            mujoco.mj_kinematics(self.model, self.data)
            for arm, (kind, number) in enumerate(self.frames):
                position, matrix = (
                    (self.data.site_xpos, self.data.site_xmat)
                    if kind == "site"
                    else (self.data.xpos, self.data.xmat)
                )
                out[n, arm * 7 : arm * 7 + 3] = position[number]
                turn = matrix[number].reshape(3, 3)
                out[n, arm * 7 + 3 : arm * 7 + 6] = (
                    np.arctan2(turn[2, 1], turn[2, 2]),
                    np.arcsin(np.clip(-turn[2, 0], -1, 1)),
                    np.arctan2(turn[1, 0], turn[0, 0]),
                )
                out[n, arm * 7 + 6] = row[7 + 8 * arm]
        return torch.from_numpy(out).to(rows.device, torch.float32).reshape(*rows.shape[:-1], 14)


def _compile(path: str) -> mujoco.MjModel:
    """The kinematic tree of a description, without shapes; links without inertia get a nominal one, which
    kinematics ignores.
    """
    if not path:
        return mujoco.MjModel.from_xml_string(build_mjcf())
    if not Path(path).is_file():
        raise KinematicsError(f"kinematics.model={path} does not exist; give the path of a URDF or MJCF file")
    try:
        spec = mujoco.MjSpec.from_file(path)
        for geom in spec.geoms:
            spec.delete(geom)
        for mesh in spec.meshes:
            spec.delete(mesh)
        spec.compiler.fusestatic = False  # fixed links, such as flanges, must keep their names
        spec.compiler.boundmass, spec.compiler.boundinertia = 1e-3, 1e-6
        spec.compiler.balanceinertia = True
        return spec.compile()
    except ValueError as error:
        raise KinematicsError(f"kinematics.model={path} cannot be read: {error}") from error
