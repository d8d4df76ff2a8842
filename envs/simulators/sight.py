"""Finds objects in an episode's first picture: where they stand, how high, and which way they are turned."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.encoders import CloseUp, Gaze, centres, to_signed
from envs.geometry import on_plane
from envs.simulators.in_view import in_view

_GLANCED = 4  # pictures for each of which one is looked at as a whole in training; a close look costs a tenth of that, and precision hangs on it
_BIGGER = 0.01  # m by which one thing's middle may well be higher than another's of its kind


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
        self.closer = CloseUp(count, out=3, cells=24, width=24)
        self.heights = nn.Parameter(torch.zeros(count))  # metres above the world's ground; objects stand on something

    @torch.autocast("cpu", enabled=False)
    @torch.autocast("cuda", enabled=False)  # positions need more than the eight bits of bfloat16
    def find(self, frames: Tensor, intrinsic: Tensor, c2w: Tensor) -> Tensor:
        """Places [B, S, 4] (schema.OBJECT_DIM), headings within one side.

        Args:
            frames: uint8 [B, 3, H, W] of one camera, intrinsic [B, 3, 3] in pixels, c2w [B, 4, 4].
        """
        pictures = to_signed(frames)
        place, turned = self._look(pictures, self._glimpse(pictures), intrinsic, c2w)
        sides = torch.tensor(self.sides, device=place.device)
        heading = torch.atan2(turned[..., 1], turned[..., 0]) / sides.clamp(min=1)
        return torch.cat((place, torch.where(sides > 0, heading, torch.nan)[..., None]), -1)

    def _glimpse(self, pictures: Tensor) -> Tensor:
        """Where objects seem to be in pictures float [B, 3, H, W]: [B, S, 2] in half-pictures from the middle."""
        heat = self.finder(pictures)
        return centres(heat.flatten(2).mul(4.0).softmax(-1).unflatten(-1, heat.shape[-2:]))

    def _look(self, pictures: Tensor, where: Tensor, intrinsic: Tensor, c2w: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Places [B, S, 3] in metres, and directions [B, S, 2], (cos, sin) of the heading times the sides, of what is seen about `where` [B, S, 2] in half-pictures."""
        close, said = self.closer(pictures, where, generator)
        half = torch.tensor(pictures.shape[:-3:-1], device=pictures.device) / 2
        # Bigger things have their middle higher, and are pushed sooner.
        place = on_plane((close + 1) * half, (self.heights + _BIGGER * said[..., 2])[..., None], intrinsic, c2w)
        count = len(self.sides)
        return place[:, :count], said[:, :count, :2]

    def loss(self, shown: TensorDict, objects: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """Pixels and centimetres by which objects [B, S, 4] are missed in the pictures of ClipStore.shots at a first and a close look, and how wrongly they are seen turned; `generator` see CloseUp."""
        pictures = to_signed(shown["frames"])
        half = torch.tensor(pictures.shape[:-3:-1], device=pictures.device) / 2
        seen = in_view(objects[:, None], shown["intrinsic"][:, None], shown["c2w"][:, None, None], (pictures.shape[-2], pictures.shape[-1])).at(0, 0)
        where, inside = seen.where, seen.visible[..., None] & (seen.where.abs() < 1).all(-1, keepdim=True)
        where, objects = torch.where(inside, where, torch.nan), torch.where(inside, objects, torch.nan)
        some = -(-len(pictures) // _GLANCED)
        guessed = Gaze.missed(self._glimpse(pictures[:some])[:, None, : len(self.sides)], where[:some])[0]
        place, turned = self._look(pictures, torch.nan_to_num(where), shown["intrinsic"], shown["c2w"], generator)
        found = mean_gap(place - objects[..., :3])
        angle = objects[..., 3] * torch.tensor(self.sides, device=objects.device)
        wrong = turned - torch.nan_to_num(torch.stack((angle.cos(), angle.sin()), -1))
        known = torch.isfinite(angle) & (torch.tensor(self.sides, device=objects.device) > 0)
        askew = (wrong.square().sum(-1) * known).sum() / known.sum().clamp(min=1)
        return half.mean() * guessed + found + 8 * askew, {"found_cm": found.detach(), "askew": askew.detach()}


def mean_gap(gap: Tensor) -> Tensor:
    """Mean length (sum of absolute values) in centimetres of those gaps [..., 3] in metres that are known."""
    known = torch.isfinite(gap).all(-1)
    length = torch.nan_to_num(gap).abs().sum(-1) * 100
    return (length * known).sum() / known.sum().clamp(min=1)


def turn(angle: Tensor, sides: Tensor) -> Tensor:
    """Angles brought to within half a side of zero; of round things, whose sides are 0, zero."""
    side = 2 * math.pi / sides.clamp(min=1)
    return torch.where(sides > 0, angle - side * (angle / side).round(), 0.0)
