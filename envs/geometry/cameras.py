"""Rigid motions and pinhole cameras in torch, batched over leading dimensions.

Camera frames follow OpenCV: x right, y down, z forward; pixel (u, v) = K (x/z, y/z, 1).
"""

from __future__ import annotations

import torch
from torch import Tensor


def rpy_to_matrix(rpy: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] = Rz(yaw) Ry(pitch) Rx(roll) of angles [..., 3] in radians."""
    roll, pitch, yaw = rpy.unbind(-1)
    cr, sr, cp, sp, cy, sy = roll.cos(), roll.sin(), pitch.cos(), pitch.sin(), yaw.cos(), yaw.sin()
    rows = (
        torch.stack((cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr), -1),
        torch.stack((sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr), -1),
        torch.stack((-sp, cp * sr, cp * cr), -1),
    )
    return torch.stack(rows, -2)


def rpy_poses(poses: Tensor) -> Tensor:
    """Homogeneous transforms [..., 4, 4] of [x, y, z, roll, pitch, yaw] poses [..., 6]."""
    out = poses.new_zeros((*poses.shape[:-1], 4, 4))
    out[..., :3, :3] = rpy_to_matrix(poses[..., 3:6])
    out[..., :3, 3] = poses[..., :3]
    out[..., 3, 3] = 1.0
    return out


def eef_transforms(commands: Tensor) -> Tensor:
    """Flange transforms [..., 2, 4, 4] of both arms from [x,y,z,roll,pitch,yaw,g]x2 [..., 14]."""
    return rpy_poses(commands.unflatten(-1, (2, 7))[..., :6])


def fingertips(commands: Tensor, tool_offset: float = 0.15) -> Tensor:
    """Points [..., 2, 3] between the fingertips of both arms, `tool_offset` metres along each flange's z
    axis, from commands [..., 14].
    """
    flange = eef_transforms(commands)
    return flange[..., :3, 3] + tool_offset * flange[..., :3, 2]


def invert(transform: Tensor) -> Tensor:
    """Inverse [..., 4, 4] of rigid transforms [..., 4, 4]."""
    out = torch.zeros_like(transform)
    rotation = transform[..., :3, :3].transpose(-1, -2)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = -(rotation @ transform[..., :3, 3:]).squeeze(-1)
    out[..., 3, 3] = 1.0
    return out


def follow_hands(c2w: Tensor, start: Tensor, commands: Tensor, hands: tuple[int | None, ...]) -> Tensor:
    """Where cameras will be when the arms follow commands: a wrist camera moves with its flange, others stay.

    Args:
        c2w: [..., V, 4, 4] camera poses at the start.
        start: [..., 14] command in force at the start.
        commands: [..., T, 14] commands to come.
        hands: per view the arm it is mounted on (0 left, 1 right) or None.

    Returns:
        [..., T, V, 4, 4], by c2w[t] = T[t] inv(T[0]) c2w[0] for wrist cameras.
    """
    moves = eef_transforms(commands) @ invert(eef_transforms(start)).unsqueeze(-4)
    views = []
    for index, arm in enumerate(hands):
        still = c2w[..., index, :, :].unsqueeze(-3)
        views.append(still.expand(*moves.shape[:-3], 4, 4) if arm is None else moves[..., arm, :, :] @ still)
    return torch.stack(views, -3)


def hands_of(views: tuple[str, ...]) -> tuple[int | None, ...]:
    """Which arm each view is mounted on, by the names hand_left and hand_right; any other view stands still."""
    return tuple({"hand_left": 0, "hand_right": 1}.get(view) for view in views)


def project(points: Tensor, intrinsic: Tensor, c2w: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels [..., N, 2] and depths [..., N] in metres of world points [..., N, 3] seen by a camera.

    Args:
        intrinsic: [..., 3, 3] in pixels.
        c2w: [..., 4, 4].
    """
    w2c = invert(c2w)
    camera = points @ w2c[..., :3, :3].transpose(-1, -2) + w2c[..., None, :3, 3]
    pixels = camera @ intrinsic.transpose(-1, -2)
    return pixels[..., :2] / pixels[..., 2:], camera[..., 2]


def on_plane(pixels: Tensor, height: Tensor | float, intrinsic: Tensor, c2w: Tensor) -> Tensor:
    """World points [..., T, 3] where the rays of pixels [..., T, 2] meet the plane z = height (metres)."""
    ones = torch.ones_like(pixels[..., :1])
    local = torch.cat((pixels, ones), -1) @ torch.linalg.inv(intrinsic).transpose(-1, -2)
    direction = local @ c2w[..., :3, :3].transpose(-1, -2)
    origin = c2w[..., None, :3, 3]
    scale = (height - origin[..., 2:]) / direction[..., 2:]
    return origin + scale * direction
