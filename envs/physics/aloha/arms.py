"""Kinematics of both ViperX arms: where fingertips are, and joints that bring them somewhere by damped least
squares.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
SIDES = ("left", "right")  # in the order of actions and states
JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
REACH = 0.142  # m from a gripper's body ahead to the point between its fingertips
_HEADING = (0.0, np.pi)  # rad about the vertical at which each hand looks over the table at the other
_DAMPING = 1e-3
_STEP_LIMIT = 0.35  # rad per iteration and joint


@dataclass(frozen=True)
class Hand:
    """Where a hand is, or should be.

    Args:
        position: [3] of the point between the fingertips, in metres.
        rotation: [3, 3], columns are ahead, the line along which the fingers close, and their product.
        opening: of the gripper, 0 closed to 1 open.
    """

    position: Array
    rotation: Array
    opening: float


Hands = tuple[Hand, Hand]  # the left and the right one


def facing(side: int, pitch: float, yaw: float = 0.0, roll: float = 0.0) -> Array:
    """Rotation [3, 3] of a hand that looks towards the other arm.

    Args:
        side: 0 is the left hand, 1 the right one.
        pitch: rad by which it looks down; at pi / 2 it looks at the table.
        yaw: rad about the vertical.
        roll: rad about the line ahead; at 0 the fingers close horizontally.
    """
    matrix: Array = Rotation.from_euler("ZYX", [_HEADING[side] + yaw, pitch, roll]).as_matrix()
    return matrix


class ArmKinematics:
    """Forward and inverse kinematics on a private copy of the state.

    Args:
        model: a model that holds gym-aloha's arms.
    """

    def __init__(self, model: mujoco.MjModel):
        self.model, self.data = model, mujoco.MjData(model)
        self.bodies = [model.body(f"vx300s_{side}/gripper_link").id for side in SIDES]
        joints = [[model.joint(f"vx300s_{side}/{name}") for name in JOINTS] for side in SIDES]
        self.qpos = np.array([[joint.qposadr[0] for joint in arm] for arm in joints])
        self.dofs = np.array([[joint.dofadr[0] for joint in arm] for arm in joints])
        self.low = np.array([[joint.range[0] for joint in arm] for arm in joints])
        self.high = np.array([[joint.range[1] for joint in arm] for arm in joints])
        self._jac = np.zeros((6, model.nv))

    def read(self, data: mujoco.MjData, openings: Iterable[float]) -> Hands:
        """Both hands as a state has them, with the openings that are given."""
        hands = []
        for body, opening in zip(self.bodies, openings, strict=True):
            rotation = data.xmat[body].reshape(3, 3).copy()
            hands.append(Hand(data.xpos[body] + REACH * rotation[:, 0], rotation, float(opening)))
        return hands[0], hands[1]

    def forward(self, joints: Array, openings: Iterable[float]) -> Hands:
        """Both hands at joint angles [2, 6] in radians."""
        self.data.qpos[self.qpos] = joints
        mujoco.mj_kinematics(self.model, self.data)
        return self.read(self.data, openings)

    def solve(
        self, hands: Sequence[Hand], start: Array, reach: float, iterations: int = 15, tolerance: float = 5e-4
    ) -> Array:
        """Joint angles [2, 6] in radians at which both hands stand as they should.

        Args:
            hands: the left and the right one; where none can be, the joints of the nearest place within
                limits are returned.
            start: joint angles [2, 6] to begin at.
            reach: rad that each joint may be moved from there.
            iterations: upper bound.
            tolerance: in metres and radians, at which the search ends.
        """
        joints = np.array(start)
        low, high = np.maximum(self.low, start - reach), np.minimum(self.high, start + reach)
        for _ in range(iterations):
            self.data.qpos[self.qpos] = joints
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            worst = 0.0
            for k, (hand, now) in enumerate(zip(hands, self.read(self.data, (0.0, 0.0)), strict=True)):
                turn = Rotation.from_matrix(hand.rotation @ now.rotation.T).as_rotvec()
                error = np.concatenate((hand.position - now.position, turn))
                worst = max(worst, float(np.abs(error).max()))
                point = now.position[:, None]
                mujoco.mj_jac(self.model, self.data, self._jac[:3], self._jac[3:], point, self.bodies[k])
                jac = self._jac[:, self.dofs[k]]
                step = jac.T @ np.linalg.solve(jac @ jac.T + _DAMPING * np.eye(6), error)
                step = np.clip(step, -_STEP_LIMIT, _STEP_LIMIT)
                joints[k] = np.clip(joints[k] + step, low[k], high[k])
            if worst < tolerance:
                break
        return joints
