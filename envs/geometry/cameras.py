"""Pinhole cameras in torch, batched over leading dimensions.

Camera frames follow OpenCV: x right, y down, z forward; pixel (u, v) = K (x/z, y/z, 1).
"""

from __future__ import annotations

import torch
from torch import Tensor

from envs.geometry.rotations import invert, pose_transforms


def follow_wrists(c2w: Tensor, start: Tensor, poses: Tensor, wrists: tuple[int | None, ...]) -> Tensor:
    """Where cameras will be when flanges follow their commands: a wrist camera moves with its flange, others
    stay.

    Args:
        c2w: [..., V, 4, 4] camera poses at the start; zeros of uncalibrated cameras stay zeros.
        start: [..., arms, 7] flange poses at the start.
        poses: [..., T, arms, 7] flange poses to come.
        wrists: per camera the arm it is mounted on, None where it stands still (Embodiment.wrists).

    Returns:
        [..., T, V, 4, 4], by c2w[t] = T[t] inv(T[0]) c2w[0] for wrist cameras.
    """
    moves = pose_transforms(poses) @ invert(pose_transforms(start)).unsqueeze(-4)
    views = []
    for view, arm in enumerate(wrists):
        still = c2w[..., view, :, :].unsqueeze(-3)
        views.append(still.expand(*moves.shape[:-3], 4, 4) if arm is None else moves[..., arm, :, :] @ still)
    return torch.stack(views, -3)


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
