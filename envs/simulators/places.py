"""Where things are, and where commands will push them: contact learned from a few numbers, not from pixels.

A pushed block is a matter of centimetres. A video network learns that slowly, from every pixel at once, and shows its
doubt as fading; a small network that is given object and fingertips in metres learns it from all frames of a data set
in seconds. So every engine is told where the objects of its view will be, as it is told where the hands will be, and
is left to draw them. Episodes without object positions (NaN) teach nothing here, and a world without them does without.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.geometry import fingertips, on_plane, project

_SIZE = 0.05  # m, the nominal size of a thing; how large one is drawn follows from it and its distance


class InView(NamedTuple):
    """Places in the pictures of all views: where [B, V, T, S, 2] in half-pictures from the middle, visible bool [B, V, T, S],
    and span [B, V, T, S], half-pictures (widths) that the nominal size covers there."""

    where: Tensor
    visible: Tensor
    span: Tensor


def in_view(places: Tensor, intrinsic: Tensor, c2w: Tensor, size: tuple[int, int]) -> InView:
    """Project places [B, T, S, 3] into every view.

    Args:
        intrinsic: [B, V, 3, 3] pixels of `size` = (height, width); c2w: [B, T, V, 4, 4].
    """
    steps, views = c2w.shape[1:3]
    pixels, depth = project(places[:, :, None].expand(-1, -1, views, -1, -1), intrinsic[:, None].expand(-1, steps, -1, -1, -1), c2w)
    near = depth.clamp(min=0.02)
    where = pixels / (torch.tensor([size[1], size[0]], device=places.device) / 2) - 1
    visible = (depth > 0.02) & (where.abs() < 1.2).all(-1)  # false for NaN, an object nobody knows the place of
    span = 2 * _SIZE * intrinsic[:, None, :, 0, 0, None] / near / size[1]
    where = torch.where(visible[..., None], where, torch.zeros_like(where))
    return InView(where.transpose(1, 2), visible.transpose(1, 2), torch.where(visible, span, torch.ones_like(span)).transpose(1, 2))


def place_map(seen: InView, height: int, width: int) -> Tensor:
    """A soft spot for every place: float32 [B, V, T, S, height, width] in 0..1, nothing where it is not visible."""
    device = seen.where.device
    v = (torch.arange(height, device=device) * 2 + 1) / height - 1
    u = (torch.arange(width, device=device) * 2 + 1) / width - 1
    aspect = height / width  # of a picture with square pixels: spans are counted in widths
    radius = 0.5 * seen.span[..., None]
    # Never narrower than a pixel, or coarse maps would miss what lies between two of them.
    spread_u, spread_v = radius.clamp(min=1.4 / width), (radius / aspect).clamp(min=1.4 / height)
    across = torch.exp(-0.5 * ((u - seen.where[..., :1]) / spread_u).square())
    down = torch.exp(-0.5 * ((v - seen.where[..., 1:]) / spread_v).square())
    return down[..., :, None] * across[..., None, :] * seen.visible[..., None, None]


class Places(nn.Module):
    """Finds objects in the first view and foresees their way under commands.

    Args:
        objects: how many are followed, S.
        chunk: frames per step, K.
        width: hidden size of the network that moves them.

    Attributes:
        taught: whether it was ever shown object positions; until then all places are NaN.
        spread: what doubt is multiplied with, so that it fits episodes that were not learned from.
    """

    taught: Tensor
    spread: Tensor

    def __init__(self, objects: int, chunk: int, width: int = 256):
        super().__init__()
        self.objects, self.chunk = objects, chunk
        self.register_buffer("taught", torch.zeros((), dtype=torch.bool))
        self.register_buffer("spread", torch.ones(()))
        self.finder = nn.Sequential(
            nn.Conv2d(3, 24, 5, stride=2, padding=2),
            nn.SiLU(),
            nn.Conv2d(24, 32, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(32, 32, 3, padding=2, dilation=2),
            nn.SiLU(),
            nn.Conv2d(32, max(1, objects), 3, padding=1),
        )
        self.heights = nn.Parameter(torch.zeros(max(1, objects)))  # metres above the world's ground; objects stand on something
        seen = 2 * 6 * (1 + 2 * chunk) + objects
        self.ways = nn.Sequential(nn.Linear(seen, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 4 * chunk))

    def of(self, objects: Tensor) -> Tensor:
        """The followed ones [..., S, 3] of recorded objects [..., N, 3], NaN where there are fewer."""
        kept = objects[..., : self.objects, :]
        return F.pad(kept, (0, 0, 0, self.objects - kept.shape[-2]), value=torch.nan)

    @torch.autocast("cpu", enabled=False)
    @torch.autocast("cuda", enabled=False)  # positions need more than the eight bits of bfloat16
    def find(self, frames: Tensor, intrinsic: Tensor, c2w: Tensor) -> Tensor:
        """Places [B, S, 3] in metres in pictures uint8 [B, 3, H, W] of one camera, intrinsic [B, 3, 3] in pixels and c2w [B, 4, 4]."""
        height, width = frames.shape[-2:]
        heat = self.finder(frames.float() / 127.5 - 1)[:, : self.objects]
        rows, columns = heat.shape[-2:]
        share = heat.flatten(2).mul(4.0).softmax(-1).unflatten(-1, (rows, columns))
        u = (share.sum(-2) * (torch.arange(columns, device=heat.device) + 0.5)).sum(-1) * width / columns
        v = (share.sum(-1) * (torch.arange(rows, device=heat.device) + 0.5)).sum(-1) * height / rows
        pixels = torch.stack((u, v), -1)
        return on_plane(pixels, self.heights[: self.objects, None], intrinsic, c2w)

    def push(self, places: Tensor, recent: Tensor, commands: Tensor, luck: Tensor) -> Tensor:
        """Where objects at `places` [B, S, 3] will be [B, K, S, 3] under `commands` [B, K, 14].

        Args:
            recent: [B, 1 + K, 14] commands before these, the one in force last: arms lag behind what they are told.
            luck: [B, S, 3] how far, in standard deviations, each object strays from its likeliest way. What decides a
                push (a block's angle, its friction) is not all seen; a world in which every push goes the likeliest
                way is one that a policy learns to exploit.
        """
        way, doubt = self.foresee(places, recent, commands)
        return way + self.spread * doubt * luck[:, None]

    @torch.autocast("cpu", enabled=False)
    @torch.autocast("cuda", enabled=False)
    def foresee(self, places: Tensor, recent: Tensor, commands: Tensor) -> tuple[Tensor, Tensor]:
        """The likeliest way [B, K, S, 3] and its standard deviation [B, K, S, 1], both in metres; arguments as those of push."""
        tips = fingertips(torch.cat((recent, commands), 1))  # [B, 1 + 2 K, 2, 3]
        gap = (tips[:, None] - places[:, :, None, None]).flatten(2)
        which = torch.eye(self.objects, device=gap.device).expand(len(gap), -1, -1)
        # Near the object millimetres count, far from it only the direction does.
        out = self.ways(torch.cat((10 * gap, (40 * gap).clamp(-3, 3), which), -1)).unflatten(-1, (self.chunk, 4)).transpose(1, 2)
        return places[:, None] + 0.05 * out[..., :3].cumsum(1), 0.02 * (out[..., 3:] - 2).exp().clamp(max=5.0)

    @torch.no_grad()
    def calibrate(self, motion: TensorDict) -> None:
        """Set `spread` by motions that were not learned from (ClipStore.motions): errors there are larger than in training."""
        begin, ahead = self.of(motion["now", "objects"]), self.of(motion["future", "objects"])
        way, doubt = self.foresee(torch.nan_to_num(begin), motion["recent"], motion["future", "commands"])
        strayed = ((way - ahead)[:, -1, :, :2] / doubt[:, -1]).square()
        # Only where something is in doubt: what lies still is foreseen to a hair either way.
        strayed = strayed[(doubt[:, -1].expand_as(strayed) > 1e-3) & torch.isfinite(strayed)]
        self.spread.fill_(float(strayed.mean().sqrt().clamp(0.5, 3.0)) if len(strayed) else 1.0)

    def loss(self, shown: TensorDict, motion: TensorDict) -> tuple[Tensor, dict[str, Tensor]]:
        """Centimetres by which objects are missed, in pictures and on their way, and how badly that was foreseen.

        Args:
            shown: ClipStore.shots, pictures with object positions; motion: ClipStore.motions, commands with them.
        """
        found = _mean(self.find(shown["frames"], shown["intrinsic"], shown["c2w"]) - self.of(shown["objects"]))
        begin = self.of(motion["now", "objects"])
        ahead = torch.where(torch.isfinite(begin)[:, None], self.of(motion["future", "objects"]), torch.nan)
        way, doubt = self.foresee(torch.nan_to_num(begin), motion["recent"], motion["future", "commands"])
        moved = _mean(way - ahead)
        # The doubt is fitted to the error as it is; the other way round, doubt would excuse errors.
        known = torch.isfinite(ahead).all(-1, keepdim=True)
        error = torch.nan_to_num(way.detach() - ahead)[..., :2].square().sum(-1, keepdim=True) / 2
        surprise = (error / (doubt.square() + 1e-8) / 2 + (doubt + 1e-4).log()) * known
        likely = surprise.sum() / known.sum().clamp(min=1)
        return found + moved + 0.1 * likely, {"found_cm": found.detach(), "way_cm": moved.detach(), "surprise": likely.detach()}


def _mean(gap: Tensor) -> Tensor:
    """Mean length in centimetres of those gaps [..., 3] that are known."""
    known = torch.isfinite(gap).all(-1)
    length = torch.nan_to_num(gap).abs().sum(-1) * 100
    return (length * known).sum() / known.sum().clamp(min=1)
