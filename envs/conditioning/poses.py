"""End-effector poses of commands: read off the command, or by the robot's kinematics."""

from __future__ import annotations

import torch
from torch import Tensor

from envs.embodiment import ActionKind, Embodiment, EmbodimentError
from envs.geometry.kinematics import Kinematics


def end_effector_poses(
    embodiment: Embodiment, commands: Tensor, kinematics: Kinematics | None = None
) -> Tensor:
    """Flange poses of absolute commands.

    Args:
        commands: [..., A].
        kinematics: of the robot, for joint commands.

    Returns:
        float32 [..., arms, 7] = [x, y, z, roll, pitch, yaw, gripper]; metres, radians, gripper 0 open .. 1
        closed (beyond, where the data go beyond); 0 for an arm without a gripper.

    Raises:
        EmbodimentError: if the robot's commands do not say where its flanges will be.
    """
    if not embodiment.commands_poses and kinematics is None:
        raise EmbodimentError(
            f"commands of {embodiment.robot} ({embodiment.action_kind.value}, delta={embodiment.delta}) do"
            " not say where flanges will be; set simulator.pose_map=false, or simulator.kinematics for joints"
        )
    numbers = [commands[..., list(arm.numbers)] for arm in embodiment.arms]
    if embodiment.action_kind is ActionKind.JOINTS:
        assert kinematics is not None
        poses = kinematics.flanges(numbers)
    else:
        poses = torch.stack(numbers, -2)
    grips = []
    for arm in embodiment.arms:
        if arm.gripper is None:
            grips.append(torch.zeros_like(commands[..., 0]))
            continue
        opened, closed = arm.gripper_range
        grips.append((commands[..., arm.gripper] - opened) / (closed - opened))
    return torch.cat((poses.float(), torch.stack(grips, -1)[..., None].float()), -1)
