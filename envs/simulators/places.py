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
    """

    taught: Tensor

    def __init__(self, objects: int, chunk: int, width: int = 256):
        super().__init__()
        self.objects, self.chunk = objects, chunk
        self.register_buffer("taught", torch.zeros((), dtype=torch.bool))
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
        seen = 2 * 6 * (1 + chunk) + objects
        self.ways = nn.Sequential(nn.Linear(seen, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 3 * chunk))

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

    @torch.autocast("cpu", enabled=False)
    @torch.autocast("cuda", enabled=False)
    def push(self, places: Tensor, command: Tensor, commands: Tensor) -> Tensor:
        """Where objects at `places` [B, S, 3] will be [B, K, S, 3] under `commands` [B, K, 14] after `command` [B, 14]."""
        tips = fingertips(torch.cat((command[:, None], commands), 1))  # [B, 1 + K, 2, 3]
        gap = (tips[:, None] - places[:, :, None, None]).flatten(2)
        which = torch.eye(self.objects, device=gap.device).expand(len(gap), -1, -1)
        # Near the object millimetres count, far from it only the direction does.
        moves = self.ways(torch.cat((10 * gap, (40 * gap).clamp(-3, 3), which), -1)).unflatten(-1, (self.chunk, 3))
        return places[:, None] + 0.05 * moves.cumsum(2).transpose(1, 2)

    def loss(self, shown: TensorDict, motion: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Centimetres by which objects are missed, in pictures and at the end of their way.

        Args:
            shown: ClipStore.shots, pictures with object positions; motion: ClipStore.motions, commands with them.
        """
        at = self.of(shown["objects"])
        found = _mean(self.find(shown["frames"], shown["intrinsic"], shown["c2w"]) - at)
        begin, ahead = self.of(motion["now", "objects"]), self.of(motion["future", "objects"])
        # A rollout goes on from places that are a little wrong; the object then moves as it would have from there.
        wrong = 0.003 * torch.randn(begin.shape, generator=generator).to(begin.device)
        way = self.push(torch.nan_to_num(begin) + wrong, motion["now", "command"], motion["future", "commands"])
        moved = _mean(way - (begin + wrong)[:, None] - (ahead - begin[:, None]))
        return found + moved, {"found_cm": found.detach(), "way_cm": moved.detach()}


def _mean(gap: Tensor) -> Tensor:
    """Mean length in centimetres of those gaps [..., 3] that are known."""
    known = torch.isfinite(gap).all(-1)
    length = torch.nan_to_num(gap).abs().sum(-1) * 100
    return (length * known).sum() / known.sum().clamp(min=1)

