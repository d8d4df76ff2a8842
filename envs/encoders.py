"""Image encoders that judges and policies share, built from what a world shows: any number of views of any
size.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.specs import WorldSpec

_SIDE_FEATURES = 32  # numbers of a view that is not the main one


class SpatialEncoder(nn.Module):
    """Pictures to key-point coordinates and a coarse grid of features (Finn et al. 2016, spatial
    soft-argmax).

    Args:
        points: number of soft key-points.
        width: channels at half resolution, a multiple of 4; twice as many at a quarter.
        pictures: how many are looked at as one, channel on channel.

    Forward takes float [B, 3 * pictures, H, W] in -1..1 and returns float32 [B, out_features]: key-points as
    (u, v) in half-pictures from the middle, then the grid.
    """

    def __init__(self, points: int, width: int, pictures: int = 1):
        super().__init__()
        self.stem = nn.Conv2d(3 * pictures, width, 5, stride=2, padding=2)
        self.mid = nn.Conv2d(width, 2 * width, 3, stride=2, padding=1)
        self.deep = nn.Conv2d(2 * width, 2 * width, 3, padding=1)
        self.norm1 = nn.GroupNorm(4, width)
        self.norm2, self.norm3 = nn.GroupNorm(8, 2 * width), nn.GroupNorm(8, 2 * width)
        self.fine = nn.Conv2d(width, width, 1)
        self.heat = nn.Conv2d(width, points, 3, padding=1)
        self.lift = nn.Conv2d(2 * width, width, 1)
        # Sharp from the start: over a near-uniform softmax, key-points sit in the middle and hardly learn.
        self.temperature = nn.Parameter(torch.full((points,), 2.3))
        self.grid = nn.Sequential(nn.AdaptiveAvgPool2d(4), nn.Conv2d(2 * width, width, 1), nn.Flatten())
        self.out_features = 2 * points + 16 * width

    def forward(self, pictures: Tensor) -> Tensor:
        x = F.silu(self.norm1(self.stem(pictures.contiguous(memory_format=torch.channels_last))))
        y = F.silu(self.norm2(self.mid(x)))
        y = y + F.silu(self.norm3(self.deep(y)))
        # Coarse features say what it is, fine ones where exactly.
        up = F.interpolate(self.lift(y), size=x.shape[-2:], mode="nearest")
        heat = self.heat(F.silu(self.fine(x) + up)).float()
        share = (heat.flatten(2) * self.temperature.exp()[None, :, None]).softmax(-1)
        keypoints = centres(share.unflatten(-1, heat.shape[-2:]))
        return torch.cat((keypoints.flatten(1), self.grid(y).float()), -1)


class PatchEncoder(nn.Module):
    """A cheap encoder: float [B, 3 * pictures, H, W] in -1..1 to float32 [B, out_features]."""

    def __init__(self, out_features: int, width: int = 16, pictures: int = 1):
        super().__init__()
        self.out_features = out_features
        self.layers = nn.Sequential(
            nn.Conv2d(3 * pictures, width, 8, stride=4, padding=2),
            nn.SiLU(),
            nn.Conv2d(width, 2 * width, 4, stride=4),
            nn.SiLU(),
            nn.AdaptiveAvgPool2d(4),
            nn.Flatten(),
            nn.Linear(32 * width, out_features),
        )

    def forward(self, pictures: Tensor) -> Tensor:
        return self.layers(pictures).float()


class MultiViewEncoder(nn.Module):
    """All views of a world to one vector: key-points and a grid of the main view, a few numbers of the
    others.

    Args:
        spec: what the world shows; its embodiment names the main view.
        points, width: of the main view's SpatialEncoder.
        pictures: of each view that are looked at as one, channel on channel.

    Forward takes uint8, or float in -1..1, [B, V, 3 * pictures, H, W] and returns float32 [B, out_features].
    """

    def __init__(self, spec: WorldSpec, points: int, width: int, pictures: int = 1):
        super().__init__()
        self.main_view = spec.embodiment.main_view
        self.others = [view for view in range(spec.views) if view != self.main_view]
        self.main = SpatialEncoder(points, width, pictures)
        self.sides = nn.ModuleList(
            PatchEncoder(_SIDE_FEATURES, pictures=pictures) for _ in range(spec.views - 1)
        )
        self.out_features = self.main.out_features + _SIDE_FEATURES * len(self.sides)

    def forward(self, pictures: Tensor) -> Tensor:
        frames = to_signed(pictures)
        sides = (side(frames[:, view]) for view, side in zip(self.others, self.sides, strict=True))
        return torch.cat((self.main(frames[:, self.main_view]), *sides), -1)


def pixel_centres(count: int, device: torch.device) -> Tensor:
    """Centres of `count` pixels in a row, in half-pictures from the middle, [count]."""
    return torch.linspace(-1, 1, count, device=device) * (1 - 1 / count)


def centres(share: Tensor) -> Tensor:
    """Centres of mass [..., 2] of maps [..., H, W] that add up to 1, as (u, v) in half-pictures from the
    middle.
    """
    v, u = pixel_centres(share.shape[-2], share.device), pixel_centres(share.shape[-1], share.device)
    return torch.stack(((share.sum(-2) * u).sum(-1), (share.sum(-1) * v).sum(-1)), -1)


def to_signed(frames: Tensor) -> Tensor:
    """uint8 pictures as float32 in -1..1; floats are taken to be so already."""
    return frames if frames.is_floating_point() else frames.float().mul_(1 / 127.5).sub_(1.0)
