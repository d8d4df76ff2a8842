"""Finds objects in an episode's first picture: where they stand, and which way they are turned."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.encoders import CloseUp, centres, to_signed
from envs.geometry import on_plane


class Sight(nn.Module):
    """A coarse look over the whole picture, then a close one at each object.

    Args:
        sides: per object, the turns of a circle that leave it looking the same: 4 for a square block, 1 for a mug with a
            handle, 0 for what is round and has no heading.
    """

    def __init__(self, sides: tuple[int, ...]):
        super().__init__()
        self.sides = sides
        count = max(1, len(sides))
        self.finder = nn.Sequential(
            nn.Conv2d(3, 24, 5, stride=2, padding=2),
            nn.SiLU(),
            nn.Conv2d(24, 32, 3, stride=2, padding=1),
            nn.SiLU(),
            nn.Conv2d(32, 32, 3, padding=2, dilation=2),
            nn.SiLU(),
            nn.Conv2d(32, count, 3, padding=1),
        )
        self.closer = CloseUp(count, out=2, cells=24, width=24)
        self.heights = nn.Parameter(torch.zeros(count))  # metres above the world's ground; objects stand on something

    def forward(self, frames: Tensor, intrinsic: Tensor, c2w: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Coarse and close places [B, S, 3] in metres, and directions [B, S, 2], (cos, sin) of the heading times the sides.

        Args:
            frames: uint8 [B, 3, H, W] of one camera, intrinsic [B, 3, 3] in pixels, c2w [B, 4, 4].
            generator: see CloseUp.
        """
        height, width = frames.shape[-2:]
        pictures = to_signed(frames)
        heat = self.finder(pictures)
        coarse = centres(heat.flatten(2).mul(4.0).softmax(-1).unflatten(-1, heat.shape[-2:]))
        close, turned = self.closer(pictures, coarse, generator)
        half = torch.tensor([width, height], device=frames.device) / 2
        count = len(self.sides)
        metres = [on_plane((where[:, :count] + 1) * half, self.heights[:count, None], intrinsic, c2w) for where in (coarse, close)]
        return metres[0], metres[1], turned[:, :count]

    @torch.autocast("cpu", enabled=False)
    @torch.autocast("cuda", enabled=False)  # positions need more than the eight bits of bfloat16
    def find(self, frames: Tensor, intrinsic: Tensor, c2w: Tensor) -> Tensor:
        """Places [B, S, 4] (schema.OBJECT_DIM), headings within one side; arguments as those of forward."""
        _, place, turned = self(frames, intrinsic, c2w)
        sides = torch.tensor(self.sides, device=place.device)
        heading = torch.atan2(turned[..., 1], turned[..., 0]) / sides.clamp(min=1)
        return torch.cat((place, torch.where(sides > 0, heading, torch.nan)[..., None]), -1)

    def loss(self, shown: TensorDict, objects: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """Centimetres by which objects [B, S, 4] are missed in the pictures of ClipStore.shots, and how wrongly they are seen turned."""
        coarse, close, turned = self(shown["frames"], shown["intrinsic"], shown["c2w"], generator)
        guessed, found = (mean_gap(place - objects[..., :3]) for place in (coarse, close))
        angle = objects[..., 3] * torch.tensor(self.sides, device=objects.device)
        wrong = turned - torch.nan_to_num(torch.stack((angle.cos(), angle.sin()), -1))
        known = torch.isfinite(angle) & (torch.tensor(self.sides, device=objects.device) > 0)
        askew = (wrong.square().sum(-1) * known).sum() / known.sum().clamp(min=1)
        return guessed + found + 8 * askew, {"found_cm": found.detach(), "askew": askew.detach()}


def mean_gap(gap: Tensor) -> Tensor:
    """Mean length (sum of absolute values) in centimetres of those gaps [..., 3] in metres that are known."""
    known = torch.isfinite(gap).all(-1)
    length = torch.nan_to_num(gap).abs().sum(-1) * 100
    return (length * known).sum() / known.sum().clamp(min=1)


def turn(angle: Tensor, sides: Tensor) -> Tensor:
    """Angles brought to within half a side of zero; of round things, whose sides are 0, zero."""
    side = 2 * math.pi / sides.clamp(min=1)
    return torch.where(sides > 0, angle - side * (angle / side).round(), 0.0)
