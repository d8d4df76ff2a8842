"""Kinematics of both arms: flange poses of joints, and joints of flange poses by damped least squares with a
null space that prefers one posture.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from envs.physics.tabletop.scene import FLANGES, HOME, JOINTS, ROBOT_FILE

Array = NDArray[np.float64]
_DAMPING = 1e-4
_STEP_LIMIT = 0.35  # rad per iteration and joint
DOWN = np.array([np.pi, 0.0, 0.0])  # roll, pitch, yaw of a gripper that points at the table


def rpy_to_matrix(rpy: Array) -> Array:
    """Rotation matrix [3, 3] = Rz(yaw) Ry(pitch) Rx(roll) of angles [3] in radians."""
    return Rotation.from_euler("xyz", rpy).as_matrix()


def matrix_to_rpy(matrix: Array, near: Array) -> Array:
    """Roll, pitch, yaw [..., 3] of rotation matrices [..., 3, 3], shifted by whole turns to lie closest to
    `near` [3].
    """
    rpy = Rotation.from_matrix(matrix).as_euler("xyz")
    return rpy + 2 * np.pi * np.round((near - rpy) / (2 * np.pi))


class ArmKinematics:
    """Forward and inverse kinematics of the robot alone, on a state of its own.

    Joints have the same addresses in any model that adds things to the robot's file; sites need not.
    """

    def __init__(self) -> None:
        self.model = model = mujoco.MjModel.from_xml_path(str(ROBOT_FILE))
        self.data = mujoco.MjData(model)
        self.sites = [model.site(name).id for name in FLANGES]
        joints = [[model.joint(name) for name in arm] for arm in JOINTS]
        self.qpos = np.array([[j.qposadr[0] for j in arm] for arm in joints])  # [2, 7]
        self.dofs = np.array([[j.dofadr[0] for j in arm] for arm in joints])  # [2, 7]
        self.low = np.array([[j.range[0] for j in arm] for arm in joints])
        self.high = np.array([[j.range[1] for j in arm] for arm in joints])
        self._jac = np.zeros((6, model.nv))

    def flanges(self, joints: Array) -> Array:
        """Flange poses [2, 6] = [x, y, z, roll, pitch, yaw] of joint angles [2, 7] in radians."""
        self.data.qpos[self.qpos] = joints
        mujoco.mj_kinematics(self.model, self.data)
        return self.read(self.data)

    @staticmethod
    def read(data: mujoco.MjData) -> Array:
        """Flange poses [2, 6] that a simulation's arms have."""
        sites = [data.site(name) for name in FLANGES]
        rpy = matrix_to_rpy(np.stack([site.xmat.reshape(3, 3) for site in sites]), DOWN)
        return np.concatenate((np.stack([site.xpos for site in sites]), rpy), 1)

    def solve(self, poses: Array, start: Array, iterations: int = 20, tolerance: float = 2e-4) -> Array:
        """Joint angles [2, 7] in rad whose flanges reach `poses`.

        Args:
            poses: [2, 6] = [x, y, z, roll, pitch, yaw] of the left, then the right flange.
            start: joint angles [2, 7] to begin at; unreachable poses give the closest posture within limits.
            iterations: upper bound; the loop ends early once both arms are within `tolerance` (m and rad).
        """
        q = np.array(start)
        targets = [(pose[:3], rpy_to_matrix(pose[3:6])) for pose in poses]
        for _ in range(iterations):
            self.data.qpos[self.qpos] = q
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            worst = 0.0
            for k, (position, rotation) in enumerate(targets):
                site = self.sites[k]
                current = self.data.site_xmat[site].reshape(3, 3)
                error = np.empty(6)
                error[:3] = position - self.data.site_xpos[site]
                delta = rotation @ current.T
                # Small-angle axis: exact direction, and the magnitude only has to vanish at the solution.
                axis = 0.5 * np.array(
                    [delta[2, 1] - delta[1, 2], delta[0, 2] - delta[2, 0], delta[1, 0] - delta[0, 1]]
                )
                error[3:] = axis if np.trace(delta) > 0.0 else axis / (np.linalg.norm(axis) + 1e-9)
                off = float(np.abs(error).max())
                worst = max(worst, off)
                if off < tolerance:
                    continue  # most of the time one arm rests
                mujoco.mj_jacSite(self.model, self.data, self._jac[:3], self._jac[3:], site)
                jac = self._jac[:, self.dofs[k]]
                gram = np.linalg.inv(jac @ jac.T + _DAMPING * np.eye(6))
                pull = 0.1 * (HOME - q[k])
                pinv = jac.T @ gram
                step = pinv @ error + pull - pinv @ (jac @ pull)
                q[k] = np.clip(q[k] + np.clip(step, -_STEP_LIMIT, _STEP_LIMIT), self.low[k], self.high[k])
            if worst < tolerance:
                break
        return q
