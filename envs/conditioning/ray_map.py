"""Ray maps: for every pixel the camera centre and the direction it looks along, as in GE-Sim 2.0."""

from __future__ import annotations

import torch
from torch import Tensor


def render_ray_map(intrinsic: Tensor, c2w: Tensor, size: tuple[int, int], stride: int = 1) -> Tensor:
    """Origin (metres, world) and unit direction of every pixel's ray.

    Args:
        intrinsic: [..., V, 3, 3] in pixels of `size`; zeros of a camera that is not calibrated.
        c2w: [..., V, T, 4, 4] camera to world, OpenCV convention; zeros alike, of which all rays are zeros.
        size: (height, width) in pixels.
        stride: keep every stride-th pixel in both directions.

    Returns:
        float32 [..., V, T, 6, ceil(H / stride), ceil(W / stride)]: channels 0-2 origin, 3-5 direction; pixel
        centres lie at +0.5.
    """
    height, width = size
    v, u = torch.meshgrid(
        torch.arange(0, height, stride, device=c2w.device, dtype=torch.float32) + 0.5,
        torch.arange(0, width, stride, device=c2w.device, dtype=torch.float32) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack((u, v, torch.ones_like(u)))  # [3, h, w]
    known = intrinsic[..., 2:, 2:] != 0
    regular = torch.where(known, intrinsic.float(), torch.eye(3, device=intrinsic.device))
    # [..., V, 3, h, w]
    local = torch.einsum("...ij,jhw->...ihw", torch.linalg.inv(regular), pixels)
    local = local / local.norm(dim=-3, keepdim=True)
    direction = torch.einsum("...vtij,...vjhw->...vtihw", c2w[..., :3, :3].float(), local)
    origin = c2w[..., :3, 3, None, None].float().expand_as(direction)
    return torch.cat((origin, direction), -3)
