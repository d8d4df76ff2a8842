"""How the bench is commanded: by absolute flange poses, or by absolute joints. One class each.

Inside, a command is always kept as `Target`: joint angles and grippers of both arms.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from envs.embodiment import ActionKind, Arm, Robot
from envs.physics.tabletop.arms import ArmKinematics, rpy_to_matrix
from envs.physics.tabletop.scene import (
    ARMS,
    BASE,
    JOINTS,
    REACH,
    SHOULDER,
    TIP_HEIGHT,
    TOOL_OFFSET,
    WRIST,
    kinematic_description,
)

Array = NDArray[np.float64]
# box of the fingertips, metres; of it each arm reaches a part
LOW = np.array([-0.04, -0.42, TIP_HEIGHT - 0.012])
HIGH = np.array([0.46, 0.42, 0.35])
MAX_SPEED = 0.6  # m/s a command may move a flange; faster commands are slowed down, not refused
MAX_JOINT_SPEED = 2.0  # rad/s a command may move a joint


@dataclass
class Target:
    """What the arms are to do: joint angles [2, 7] in radians and grippers [2], 1 closed."""

    joints: Array
    grippers: Array


class ActionInterface(ABC):
    """The meaning of the bench's actions, which are absolute.

    Args:
        arms: kinematics of both arms.
        control_hz: actions per second.

    Attributes:
        names: of the A numbers of an action.
        command: [A], the action in force after limits.
        poses: [2, 7], the flange poses and grippers that it asks for.
    """

    kind: ClassVar[ActionKind]
    names: ClassVar[tuple[str, ...]]
    layout: ClassVar[tuple[Arm, ...]]
    command: Array

    def __init__(self, arms: ArmKinematics, control_hz: float):
        self.arms, self.control_hz = arms, control_hz

    @abstractmethod
    def begin(self, target: Target, poses: Array) -> None:
        """Take over at rest, with the arms at `target`, whose flanges and grippers are `poses` [2, 7]."""

    @abstractmethod
    def advance(self, action: Array, before: Target) -> Target:
        """Limit an action [A], remember it as the command in force, and say what the arms are to do."""

    @abstractmethod
    def encode(self, poses: Array, before: Target) -> Array:
        """The action [A] that asks for flange poses and grippers [2, 7]."""

    @property
    @abstractmethod
    def poses(self) -> Array:
        """[2, 7] that the command in force asks for."""

    @classmethod
    @abstractmethod
    def kinematics(cls) -> Robot | None:
        """Description by which commands become flange poses, None if they say them."""


class EndEffectorActions(ActionInterface):
    """[x, y, z, roll, pitch, yaw, gripper] of the left, then the right flange; metres, radians, 1 closed."""

    kind = ActionKind.END_EFFECTOR
    names = tuple(
        f"{arm}_{name}" for arm in ARMS for name in ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
    )
    layout = tuple(Arm(arm, tuple(range(7 * k, 7 * k + 6)), 7 * k + 6) for k, arm in enumerate(ARMS))

    def begin(self, target: Target, poses: Array) -> None:
        """The poses are the command."""
        self.command = poses.flatten()

    def advance(self, action: Array, before: Target) -> Target:
        """Keep fingertips in their box, slow and within reach, then solve for joints."""
        poses = action.reshape(2, 7).copy()
        stride = MAX_SPEED / self.control_hz
        offset = np.array([0.0, 0.0, TOOL_OFFSET])
        for k, (pose, last) in enumerate(zip(poses, self.poses, strict=True)):
            move = pose[:3] - last[:3]
            xyz = last[:3] + move * min(1.0, stride / max(float(np.linalg.norm(move)), 1e-9))
            xyz = np.clip(xyz, LOW + offset, HIGH + offset)
            # What lies too far away is reached for as far as the arm goes, at the height that was asked for.
            wrist = xyz - WRIST * rpy_to_matrix(pose[3:6])[:, 2] - (*BASE[ARMS[k]], SHOULDER)
            away = float(np.linalg.norm(wrist[:2]))
            furthest = float(np.sqrt(max(REACH**2 - wrist[2] ** 2, 0.0)))
            xyz[:2] -= wrist[:2] * max(0.0, 1 - furthest / max(away, 1e-9))
            pose[:3] = xyz
            pose[6] = np.clip(pose[6], 0.0, 1.0)
        self.command = poses.flatten()
        return Target(self.arms.solve(poses[:, :6], before.joints), poses[:, 6])

    def encode(self, poses: Array, before: Target) -> Array:
        """The poses themselves."""
        return poses.flatten()

    @property
    def poses(self) -> Array:
        """The command, an arm a row."""
        return self.command.reshape(2, 7)

    @classmethod
    def kinematics(cls) -> Robot | None:
        """Not needed."""
        return None


class JointActions(ActionInterface):
    """[seven joints, gripper] of the left, then the right arm: GE-Sim 2.0's order; radians, 1 closed."""

    kind = ActionKind.JOINTS
    names = tuple(
        name for arm, joints in zip(ARMS, JOINTS, strict=True) for name in (*joints, f"{arm}_gripper")
    )
    layout = tuple(Arm(arm, tuple(range(8 * k, 8 * k + 7)), 8 * k + 7) for k, arm in enumerate(ARMS))

    def begin(self, target: Target, poses: Array) -> None:
        """The joints are the command."""
        self.command = np.concatenate((target.joints, target.grippers[:, None]), 1).flatten()

    def advance(self, action: Array, before: Target) -> Target:
        """Keep joints in their ranges and slow: each arm's step is shortened as a whole."""
        rows = action.reshape(2, 8)
        move = np.clip(rows[:, :7], self.arms.low, self.arms.high) - before.joints
        fastest = np.abs(move).max(1, keepdims=True)
        joints = before.joints + move * np.minimum(
            1.0, MAX_JOINT_SPEED / self.control_hz / np.maximum(fastest, 1e-9)
        )
        grippers = np.clip(rows[:, 7], 0.0, 1.0)
        self.command = np.concatenate((joints, grippers[:, None]), 1).flatten()
        return Target(joints, grippers)

    def encode(self, poses: Array, before: Target) -> Array:
        """Joints by inverse kinematics from where they are."""
        joints = self.arms.solve(poses[:, :6], before.joints)
        return np.concatenate((joints, poses[:, 6:]), 1).flatten()

    @property
    def poses(self) -> Array:
        """By forward kinematics of the command."""
        rows = self.command.reshape(2, 8)
        return np.concatenate((self.arms.flanges(rows[:, :7]), rows[:, 7:]), 1)

    @classmethod
    def kinematics(cls) -> Robot | None:
        """The bench's own file."""
        return kinematic_description()


ACTIONS: dict[str, type[ActionInterface]] = {"end_effector": EndEffectorActions, "joints": JointActions}
