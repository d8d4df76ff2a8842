"""Joint commands for a robot whose actions are end-effector poses: what joint-speaking policies and clients
need.
"""

from __future__ import annotations

import torch
from torch import Tensor

from envs.embodiment import ActionKind, Embodiment, EmbodimentError
from envs.geometry.kinematics import Kinematics


class JointCommands:
    """Turns [joints..., gripper] of one arm after the other into end-effector commands.

    Joints that `kinematics.held` names, such as head and waist, keep the value given there; where a recording
    moves them, wrist cameras and flanges are off by as much as they moved.

    Args:
        embodiment: whose actions are absolute end-effector poses.
        kinematics: of the robot.

    Attributes:
        size: numbers of a joint command.

    Raises:
        EmbodimentError: if its actions are something else, or its arms are not those of the kinematics.
    """

    def __init__(self, embodiment: Embodiment, kinematics: Kinematics):
        if embodiment.action_kind is not ActionKind.END_EFFECTOR or not embodiment.commands_poses:
            raise EmbodimentError(
                f"joint commands are for robots of absolute end-effector actions, {embodiment.robot} takes"
                f" {embodiment.action_kind.value}, delta={embodiment.delta}"
            )
        counts = [len(arm) for arm in kinematics.robot.joints]
        if len(counts) != len(embodiment.arms):
            raise EmbodimentError(
                f"kinematics.joints names {len(counts)} arms, {embodiment.robot} has {len(embodiment.arms)}"
            )
        self.embodiment, self.kinematics = embodiment, kinematics
        self.widths = [
            count + (arm.gripper is not None) for count, arm in zip(counts, embodiment.arms, strict=True)
        ]
        self.size = sum(self.widths)

    @property
    def grippers(self) -> tuple[int, ...]:
        """Positions of the grippers in a joint command."""
        ends = torch.tensor(self.widths).cumsum(0) - 1
        return tuple(
            int(end) for end, arm in zip(ends, self.embodiment.arms, strict=True) if arm.gripper is not None
        )

    def __call__(self, values: Tensor) -> Tensor:
        """Commands float32 [..., A] of joint commands [..., size]; grippers pass as they are."""
        parts, arms = values.split(self.widths, -1), self.embodiment.arms
        joints = [
            part if arm.gripper is None else part[..., :-1] for part, arm in zip(parts, arms, strict=True)
        ]
        poses = self.kinematics.flanges(joints)
        out = values.new_zeros(*values.shape[:-1], self.embodiment.action_dim, dtype=torch.float32)
        for number, (part, arm) in enumerate(zip(parts, arms, strict=True)):
            out[..., list(arm.numbers)] = poses[..., number, :]
            if arm.gripper is not None:
                out[..., arm.gripper] = part[..., -1].float()
        return out
