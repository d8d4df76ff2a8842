"""A gripper detector: a small U-Net that says for each arm where in a picture its end effector is, or that it
is nowhere to be seen.

All cameras share its weights, with an embedding each. Each arm has a heat map and one more cell, "nowhere"
(DeTone et al. 2018, SuperPoint), in one softmax; the place is the centre of mass around the largest cell.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.encoders.images import ResidualBlock, bells, pixel_centres, to_signed

_NEAR = 2  # cells around the largest within which the centre of mass is taken
_AT_ONCE = 64  # pictures


class GripperDetector(nn.Module):
    """Finds the end effectors of all arms in single pictures of any camera.

    Args:
        views: cameras.
        arms: end effectors.
        width: channels at half resolution, a multiple of 8.
        side: pixels of a picture's shorter side at most; larger pictures are brought down to it.

    Forward takes pictures uint8, or float in -1..1, [B, 3, H, W] and the camera of each, int64 [B]; it
    returns logits float32 [B, arms, h * w + 1], the last cell being "nowhere", and (h, w).
    """

    def __init__(self, views: int, arms: int, width: int, side: int):
        super().__init__()
        self.side = side
        self.stem = nn.Conv2d(5, width, 5, stride=2, padding=2)  # colours, and where in the picture
        self.view = nn.Parameter(0.02 * torch.randn(views, width))
        self.down = nn.ModuleList([_Down(width, 2 * width), _Down(2 * width, 4 * width)])
        self.up = nn.ModuleList([_Up(4 * width, 2 * width), _Up(2 * width, width)])
        self.heat = nn.Conv2d(width, arms, 1)
        self.nowhere = nn.Linear(4 * width, arms)

    def forward(self, pictures: Tensor, views: Tensor) -> tuple[Tensor, tuple[int, int]]:
        x = to_signed(pictures)
        x = F.interpolate(x, self.seen(x.shape[-2:]), mode="area") if min(x.shape[-2:]) > self.side else x
        x = self.stem(torch.cat((x, _places(x)), 1)) + self.view[views][:, :, None, None]
        levels = [x]
        for down in self.down:
            levels.append(down(levels[-1]))
        x = levels[-1]
        nowhere = self.nowhere(x.mean((2, 3)))
        for up, beside in zip(self.up, reversed(levels[:-1]), strict=True):
            x = up(x, beside)
        heat = self.heat(x)
        return torch.cat((heat.flatten(2), nowhere[..., None]), -1).float(), (heat.shape[2], heat.shape[3])

    def seen(self, size: tuple[int, ...]) -> tuple[int, int]:
        """(height, width) at which pictures of a size are looked at."""
        scale = min(1.0, self.side / min(size))
        return round(size[0] * scale), round(size[1] * scale)

    def loss(self, pictures: Tensor, views: Tensor, pixels: Tensor) -> Tensor:
        """Cross-entropy of the cells with a Gaussian around the true one, or with "nowhere".

        Args:
            pixels: float32 [B, arms, 2] (u, v) in the pictures given, NaN where there is nothing to be found.
        """
        logits, cells = self(pictures, views)
        there = torch.isfinite(pixels).all(-1)  # [B, arms]
        shown = pixels.new_tensor((pictures.shape[-1], pictures.shape[-2]))
        near = bells(cells, torch.nan_to_num(pixels) / shown, 1.0).flatten(-2)
        wanted = torch.cat((near * there[..., None], (~there)[..., None].float()), -1)
        return -(wanted * logits.log_softmax(-1)).sum(-1).mean()

    @torch.no_grad()
    def detect(self, frames: Tensor, views: Tensor) -> Tensor:
        """Pixels float32 [N, V, arms, 2] in frames uint8 [N, V, 3, H, W] of cameras int64 [V], the first
        pixel from 0 to 1; NaN where an arm is nowhere to be seen.
        """
        device, (height, width) = self.view.device, frames.shape[-2:]
        flat, seen = frames.flatten(0, 1), views.expand(len(frames), -1).flatten()
        parts = []
        for pictures, of in zip(flat.split(_AT_ONCE), seen.split(_AT_ONCE), strict=True):
            logits, cells = self(pictures.to(device), of.to(device))
            parts.append(_centres(logits, cells).cpu())
        found = torch.cat(parts) * torch.tensor([width, height], dtype=torch.float32)
        return found.unflatten(0, frames.shape[:2])


def _centres(logits: Tensor, cells: tuple[int, int]) -> Tensor:
    """(u, v) [B, arms, 2] in shares of the picture, NaN where "nowhere" is likelier than all cells."""
    height, width = cells
    share = logits.softmax(-1)
    lost = share[..., -1] > 0.5
    heat = share[..., :-1].unflatten(-1, cells)
    best = heat.flatten(-2).argmax(-1)
    row, column = best // width, best % width
    along, across = torch.arange(height, device=share.device), torch.arange(width, device=share.device)
    near = ((along - row[..., None]).abs() <= _NEAR)[..., :, None] & (
        (across - column[..., None]).abs() <= _NEAR
    )[..., None, :]
    mass = heat * near
    mass = mass / mass.sum((-2, -1), keepdim=True).clamp(min=1e-12)
    u = (mass.sum(-2) * (across + 0.5)).sum(-1) / width
    v = (mass.sum(-1) * (along + 0.5)).sum(-1) / height
    return torch.where(lost[..., None], torch.nan, torch.stack((u, v), -1))


def _places(x: Tensor) -> Tensor:
    """Where each pixel is, [B, 2, H, W] in half-pictures from the middle."""
    height, width = x.shape[-2:]
    v = pixel_centres(height, x.device)[:, None].expand(height, width)
    u = pixel_centres(width, x.device)[None].expand(height, width)
    return torch.stack((u, v)).to(x.dtype).expand(len(x), -1, -1, -1)


class _Down(nn.Module):
    """Half the resolution, with a residual block."""

    def __init__(self, before: int, after: int):
        super().__init__()
        self.norm = nn.GroupNorm(8, before)
        self.conv = nn.Conv2d(before, after, 3, stride=2, padding=1)
        self.block = ResidualBlock(after)

    def forward(self, x: Tensor) -> Tensor:
        found: Tensor = self.block(self.conv(F.silu(self.norm(x))))
        return found


class _Up(nn.Module):
    """The resolution of the level beside, with a residual block."""

    def __init__(self, before: int, after: int):
        super().__init__()
        self.lift = nn.Conv2d(before, after, 1)
        self.block = ResidualBlock(after)

    def forward(self, x: Tensor, beside: Tensor) -> Tensor:
        found: Tensor = self.block(beside + F.interpolate(self.lift(x), size=beside.shape[-2:]))
        return found
