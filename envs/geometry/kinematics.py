"""From joints to flange poses: forward kinematics of any robot described by a URDF or MJCF file, or by a
library of its own.

MuJoCo reads the file; only its kinematic tree is used, so meshes need not be there. Makers who give out a
library and no file are served by a function of yours around it (Robot.model = "python:package.module.name").
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from envs.embodiment import PYTHON, Robot

# Joint angles float64 [N, J] of each arm and the joints that stand still -> flange poses [N, arms, 4, 4].
Solver = Callable[[list[NDArray[np.float64]], dict[str, float]], NDArray[np.float64]]


class KinematicsError(ValueError):
    """A robot description is missing or does not have the joints or frames that are asked for."""


class Kinematics:
    """Forward kinematics of all arms of a robot.

    Args:
        robot: which.

    Raises:
        KinematicsError: naming what the description lacks.
    """

    def __init__(self, robot: Robot):
        self.robot = robot
        if len(robot.joints) != len(robot.flanges):
            raise KinematicsError(
                f"kinematics.joints names {len(robot.joints)} arms, kinematics.flanges {len(robot.flanges)};"
                " name one list of joints and one flange for each arm"
            )
        own = robot.model.startswith(PYTHON)
        self._solve: Solver = _imported(robot.model) if own else _Description(robot).solve

    def flanges(self, joints: list[Tensor]) -> Tensor:
        """Flange poses float32 [..., arms, 6] = [x, y, z, roll, pitch, yaw] of joint angles [..., J] of each
        arm.

        Raises:
            KinematicsError: if an arm has another number of joints than the description names, or a solver of
                one's own answers with something else than poses.
        """
        for arm, (names, values) in enumerate(zip(self.robot.joints, joints, strict=True)):
            if len(names) != values.shape[-1]:
                raise KinematicsError(
                    f"kinematics.joints names {len(names)} joints of arm {arm}, its actions have"
                    f" {values.shape[-1]}"
                )
        rows = [arm.reshape(arm.shape[:-1].numel(), arm.shape[-1]).double().cpu().numpy() for arm in joints]
        poses = np.asarray(self._solve(rows, dict(self.robot.held)), np.float64)
        wanted = (len(rows[0]), len(rows), 4, 4)
        if poses.shape != wanted or not np.isfinite(poses).all():
            raise KinematicsError(
                f"{self.robot.model} answered {list(poses.shape)}, or numbers that are not finite; wanted are"
                f" flange poses [N, arms, 4, 4] = {list(wanted)}"
            )
        out = np.empty((*wanted[:2], 6))
        out[..., :3] = poses[..., :3, 3]
        turns = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)).as_euler("xyz")
        out[..., 3:] = turns.reshape(*wanted[:2], 3)
        return (
            torch.from_numpy(out)
            .to(joints[0].device, torch.float32)
            .reshape(*joints[0].shape[:-1], len(rows), 6)
        )


def _imported(model: str) -> Solver:
    module, _, name = model.removeprefix(PYTHON).rpartition(".")
    try:
        solver: Solver = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise KinematicsError(
            f"kinematics.model={model} does not import: {error}; give {PYTHON}package.module.function"
        ) from error
    return solver


class _Description:
    """The kinematic tree of a file."""

    def __init__(self, robot: Robot):
        self.robot = robot
        self.model = _compile(robot.model)
        self.data = mujoco.MjData(self.model)
        self._joints = [[self._joint(name) for name in arm] for arm in robot.joints]
        self._frames = [self._frame(name) for name in robot.flanges]
        for name, value in robot.held.items():
            self.data.qpos[self._joint(name)] = value

    def solve(self, rows: list[NDArray[np.float64]], held: dict[str, float]) -> NDArray[np.float64]:
        """See Solver."""
        out = np.zeros((len(rows[0]), len(rows), 4, 4))
        out[..., 3, 3] = 1
        for n in range(len(out)):
            for numbers, row in zip(self._joints, rows, strict=True):
                self.data.qpos[numbers] = row[n]
            mujoco.mj_kinematics(self.model, self.data)
            for arm, (position, rotation) in enumerate(self._frames):
                out[n, arm, :3, 3] = position
                out[n, arm, :3, :3] = rotation.reshape(3, 3)
        return out

    def _joint(self, name: str) -> int:
        number = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name)
        if number < 0:
            known = [self.model.joint(k).name for k in range(self.model.njnt)]
            raise KinematicsError(
                f"{self.robot.model} has no joint {name!r}; it has {known}."
                " Set kinematics.joints or kinematics.held."
            )
        return int(self.model.jnt_qposadr[number])

    def _frame(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Live views of position [3] and rotation [9] of a site or body."""
        number = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SITE, name)
        if number >= 0:
            return self.data.site_xpos[number], self.data.site_xmat[number]
        number = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name)
        if number >= 0:
            return self.data.xpos[number], self.data.xmat[number]
        known = [self.model.body(k).name for k in range(1, self.model.nbody)]
        raise KinematicsError(
            f"{self.robot.model} has no link or site {name!r}; its links are {known}. Set kinematics.flanges."
        )


def _compile(path: str) -> mujoco.MjModel:
    """The kinematic tree of a description, without shapes; kinematics ignores inertia, so links get a nominal
    one.
    """
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
