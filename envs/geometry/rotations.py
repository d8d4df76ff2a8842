"""Rotations and rigid transforms in torch, batched over leading dimensions.

Angles are extrinsic roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll), scipy's "xyz". What is not on a
rollout's path goes to scipy.spatial.transform; here stands what must run batched on the rollout's device.
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


def pose_transforms(poses: Tensor) -> Tensor:
    """Homogeneous transforms [..., 4, 4] of poses [..., 6 or more] = [x, y, z, roll, pitch, yaw, ...]."""
    out = poses.new_zeros((*poses.shape[:-1], 4, 4))
    out[..., :3, :3] = rpy_to_matrix(poses[..., 3:6])
    out[..., :3, 3] = poses[..., :3]
    out[..., 3, 3] = 1.0
    return out


def fingertips(poses: Tensor, tool_offset: float) -> Tensor:
    """Places [..., 3] of flange poses [..., 6 or more], `tool_offset` metres ahead along the flange's z."""
    flange = pose_transforms(poses)
    return flange[..., :3, 3] + tool_offset * flange[..., :3, 2]


def invert(transform: Tensor) -> Tensor:
    """Inverse [..., 4, 4] of rigid transforms [..., 4, 4]."""
    out = torch.zeros_like(transform)
    rotation = transform[..., :3, :3].transpose(-1, -2)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = -(rotation @ transform[..., :3, 3:]).squeeze(-1)
    out[..., 3, 3] = 1.0
    return out
