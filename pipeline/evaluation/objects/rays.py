"""From pixels back into space: where the rays of several cameras meet, or what one camera alone can tell."""

from __future__ import annotations

import torch
from torch import Tensor

_NARROW = (
    2e-3  # sine squared of the angle, 2.6 degrees, under which rays do not tell how far away something is
)


def rays(pixels: Tensor, intrinsic: Tensor, c2w: Tensor) -> tuple[Tensor, Tensor]:
    """Origins and unit directions, [..., 3] each in the world frame, of pixels [..., 2] seen by cameras with
    intrinsics [..., 3, 3] and poses [..., 4, 4].
    """
    ones = torch.ones_like(pixels[..., :1])
    local = torch.linalg.inv(intrinsic) @ torch.cat((pixels, ones), -1)[..., None]
    direction = (c2w[..., :3, :3] @ local)[..., 0]
    return c2w[..., :3, 3].expand_as(direction), direction / direction.norm(dim=-1, keepdim=True)


def on_plane(pixels: Tensor, height: Tensor | float, intrinsic: Tensor, c2w: Tensor) -> Tensor:
    """World points [..., T, 3] where the rays of pixels [..., T, 2] meet the plane z = height (metres); NaN
    where that lies behind the camera.
    """
    origin, direction = rays(pixels, intrinsic.unsqueeze(-3), c2w.unsqueeze(-3))
    away = (height - origin[..., 2:]) / direction[..., 2:]
    return torch.where(away > 0, origin + away * direction, torch.nan)


def triangulate(origin: Tensor, direction: Tensor) -> Tensor:
    """Points [..., 3] nearest to the rays [..., V, 3] of cameras, by least squares; NaN in any of a ray
    leaves it out. NaN where fewer than two are left, or all that are left look the same way.
    """
    known = torch.isfinite(direction).all(-1)
    d = direction.nan_to_num().double()
    across = torch.eye(3, dtype=torch.float64) - d[..., :, None] * d[..., None, :]
    across = across * known[..., None, None]
    matrix = across.sum(-3)
    wanted = (across @ origin.nan_to_num().double()[..., None]).sum(-3)
    # Its least eigenvalue is how far rays differ in direction; without any it is 0.
    apart = torch.linalg.eigvalsh(matrix)[..., 0]
    good = (known.sum(-1) >= 2) & (apart > _NARROW)
    safe = torch.where(good[..., None, None], matrix, torch.eye(3, dtype=torch.float64))
    point = torch.linalg.solve(safe, wanted)[..., 0]
    return torch.where(good[..., None], point, torch.nan).float()


def nearest_on_ray(origin: Tensor, direction: Tensor, point: Tensor) -> Tensor:
    """The points [..., 3] of rays that are nearest to points [..., 3]: what errs across the line of sight is
    kept, what errs along it is not seen.
    """
    along = ((point - origin) * direction).sum(-1, keepdim=True)
    return origin + along * direction
