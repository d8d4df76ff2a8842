"""Inverse kinematics of both arms by damped least squares, with a null space that prefers one posture."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.physics.tabletop.scene import ARMS, HOME

Array = NDArray[np.float64]
_DAMPING = 1e-4
_STEP_LIMIT = 0.35  # rad per iteration and joint


def rpy_to_matrix(rpy: Array) -> Array:
    """Rotation matrix Rz(yaw) Ry(pitch) Rx(roll) of angles [..., 3] in radians -> [..., 3, 3]."""
    roll, pitch, yaw = np.moveaxis(np.asarray(rpy, dtype=np.float64), -1, 0)
    cr, sr, cp, sp, cy, sy = (
        np.cos(roll),
        np.sin(roll),
        np.cos(pitch),
        np.sin(pitch),
        np.cos(yaw),
        np.sin(yaw),
    )
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def matrix_to_rpy(matrix: Array, near: Array) -> Array:
    """Roll, pitch, yaw [3] of a rotation matrix [3, 3], each shifted by whole turns to lie closest to `near`
    [3].
    """
    pitch = np.arcsin(np.clip(-matrix[2, 0], -1.0, 1.0))
    roll = np.arctan2(matrix[2, 1], matrix[2, 2])
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    rpy = np.array([roll, pitch, yaw])
    return rpy + 2 * np.pi * np.round((near - rpy) / (2 * np.pi))


class ArmKinematics:
    """Solves flange poses for joint angles on a private copy of the state, warm-started from the last
    solution.
    """

    def __init__(self, model: mujoco.MjModel):
        self.model = model
        self.data = mujoco.MjData(model)
        self.sites = [model.site(f"{side}_flange").id for side in ARMS]
        joints = [[model.joint(f"{side}_joint{i}") for i in range(1, 8)] for side in ARMS]
        self.qpos = np.array([[j.qposadr[0] for j in arm] for arm in joints])  # [2, 7]
        self.dofs = np.array([[j.dofadr[0] for j in arm] for arm in joints])  # [2, 7]
        self.low = np.array([[j.range[0] for j in arm] for arm in joints])
        self.high = np.array([[j.range[1] for j in arm] for arm in joints])
        self._jac = np.zeros((6, model.nv))

    def solve(self, command: Array, start: Array, iterations: int = 20, tolerance: float = 2e-4) -> Array:
        """Joint angles [2, 7] in rad whose flanges reach `command`.

        Args:
            command: [14] = [x, y, z, roll, pitch, yaw, gripper] of the left, then the right arm.
            start: joint angles [2, 7] to begin at; unreachable poses give the closest posture within limits.
            iterations: upper bound; the loop ends early once both arms are within `tolerance` (m and rad).
        """
        q = np.array(start)
        targets = [
            (command[k * 7 : k * 7 + 3], rpy_to_matrix(command[k * 7 + 3 : k * 7 + 6])) for k in range(2)
        ]
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
