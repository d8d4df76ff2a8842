"""Places as cameras see them: where in every picture a thing lies, how large, how turned, and how its picture is carried from one place to another."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from envs.encoders import middles
from envs.geometry import project

_SIZE = 0.05  # m, the nominal size of a thing; how large one is drawn follows from it and its distance
_STEP = 0.01  # m along a thing's own axes, by which its axes in the picture are measured


class InView(NamedTuple):
    """Places in the pictures of all views, lengths in half-pictures: where [B, V, T, S, 2] from the middle, visible bool [B, V, T, S],
    span [B, V, T, S] (widths) that the nominal size covers there, and axes [B, V, T, S, 2, 2], whose columns are a metre along
    the thing's own x and y axes."""

    where: Tensor
    visible: Tensor
    span: Tensor
    axes: Tensor

    def at(self, view: int | slice, times: int | slice) -> InView:
        """Some views and times of it; a number takes its axis away."""
        return InView(*(value[:, view, times] for value in self))


def in_view(places: Tensor, intrinsic: Tensor, c2w: Tensor, size: tuple[int, int]) -> InView:
    """Project places [B, T, S, 4] (schema.OBJECT_DIM; a thing without heading counts as turned to x) into every view.

    Args:
        intrinsic: [B, V, 3, 3] pixels of `size` = (height, width); c2w: [B, T, V, 4, 4].
    """
    steps, views = c2w.shape[1:3]
    heading = torch.nan_to_num(places[..., 3])
    cos, sin, none = heading.cos(), heading.sin(), torch.zeros_like(heading)
    along = torch.stack((torch.stack((none, none, none), -1), torch.stack((cos, sin, none), -1), torch.stack((-sin, cos, none), -1)), -2)
    points = (places[..., None, :3] + _STEP * along).flatten(2, 3)  # [B, T, S * 3, 3]
    pixels, depth = project(points[:, :, None].expand(-1, -1, views, -1, -1), intrinsic[:, None].expand(-1, steps, -1, -1, -1), c2w)
    spread = (pixels / (torch.tensor([size[1], size[0]], device=places.device) / 2) - 1).unflatten(3, (-1, 3))
    where, near = spread[..., 0, :], depth.unflatten(3, (-1, 3))[..., 0]
    axes = ((spread[..., 1:, :] - where[..., None, :]) / _STEP).transpose(-1, -2)
    visible = (near > 0.02) & (where.abs() < 1.2).all(-1)  # false for NaN, an object nobody knows the place of
    span = 2 * _SIZE * intrinsic[:, None, :, 0, 0, None] / near.clamp(min=0.02) / size[1]
    shown = visible[..., None]
    parts = (torch.where(shown, where, 0.0), visible, torch.where(visible, span, 1.0), torch.where(shown[..., None], axes, torch.eye(2, device=axes.device)))
    return InView(*(part.transpose(1, 2) for part in parts))


def place_map(seen: InView, height: int, width: int) -> Tensor:
    """A soft spot for every place: float32 [..., S, height, width] in 0..1, nothing where it is not visible."""
    device = seen.where.device
    aspect = height / width  # of a picture with square pixels: spans are counted in widths
    radius = 0.5 * seen.span[..., None]
    # Never narrower than a pixel, or coarse maps would miss what lies between two of them.
    spread_u, spread_v = radius.clamp(min=1.4 / width), (radius / aspect).clamp(min=1.4 / height)
    across = torch.exp(-0.5 * ((middles(width, device) - seen.where[..., :1]) / spread_u).square())
    down = torch.exp(-0.5 * ((middles(height, device) - seen.where[..., 1:]) / spread_v).square())
    return down[..., :, None] * across[..., None, :] * seen.visible[..., None, None]


def pixel_grid(height: int, width: int, device: torch.device) -> Tensor:
    """Middles of all pixels as (u, v) in half-pictures from the middle, [height, width, 2]."""
    v, u = torch.meshgrid(middles(height, device), middles(width, device), indexing="ij")
    return torch.stack((u, v), -1)


def on_thing(where: Tensor, axes: Tensor, grid: Tensor) -> Tensor:
    """What of a thing each pixel of grid [H, W, 2] shows: metres [..., H, W, 2] along its own axes, for where [..., 2] and axes [..., 2, 2]."""
    offset = grid - where[..., None, None, :]
    return torch.einsum("...ij,...hwj->...hwi", torch.linalg.inv(regular(axes)), offset)


def regular(axes: Tensor) -> Tensor:
    """Axes [..., 2, 2] that can be inverted: a thing seen edge-on covers nothing, so that any others do."""
    flat = torch.linalg.det(axes).abs() < 1e-2
    return torch.where(flat[..., None, None], 1e3 * torch.eye(2, device=axes.device), axes)
