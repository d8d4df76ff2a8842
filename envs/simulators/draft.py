"""Frames drafted from geometry alone, for a network to correct: the first picture, as it would look if nothing had happened but what is known to.

What a camera sees of the ground moves with the camera by a plane's homography, things are carried and turned to where
they will be, and what is mounted on a moving camera stays where it is in its picture. Arms stay as they were; they,
and whatever the first picture did not show, are what is left for the network.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.geometry import invert
from envs.simulators.in_view import InView, in_view, on_thing, pixel_grid, regular

_HALF = 0.058  # m around a thing's middle within which its pixels lie
_SOFT = 0.006  # m over which that window ends
_LIKE = 9.0  # how sharply pixels are told apart by colour: a thing's, or what it lies on
_STILL = 0.02  # largest deviation, over episodes, of the colours (0..1) of what is mounted on a camera


class Draft(nn.Module):
    """Drafts of frames to come.

    Args:
        views: cameras, V.
        size: (height, width) of their pictures.

    Attributes:
        mounted: float32 [V, 1, H, W], 1 where a moving camera always sees the same: what it is mounted on.
    """

    mounted: Tensor

    def __init__(self, views: int, size: tuple[int, int]):
        super().__init__()
        self.size = size
        self.register_buffer("mounted", torch.zeros(views, 1, *size))

    @torch.no_grad()
    def learn(self, frames: Tensor, c2w: Tensor) -> None:
        """Find what is mounted on cameras, from frames uint8 [N, V, 3, H, W] of different episodes and c2w [N, V, 4, 4]."""
        frames, c2w = frames.to(self.mounted.device), c2w.to(self.mounted.device)
        moving = (c2w - c2w[:1]).abs().amax((0, 2, 3)) > 1e-3
        same = (frames.float() / 255).std(0).amax(1, keepdim=True) < _STILL
        self.mounted.copy_(same * moving[:, None, None, None])

    def look(self, inputs: TensorDict) -> tuple[InView, Tensor]:
        """Objects in all views [B, V, 2 + K, S], at the first remembered frame, at the last, and at the K to come, and the cameras [B, 2 + K, V, 4, 4] then; `inputs` are those of Simulator.predict."""
        memory, future = inputs["memory"], inputs["future"]
        places = torch.cat((memory["places"][:, :1], inputs["now", "places"][:, None], future["places"]), 1)
        cameras = torch.cat((memory["c2w"][:, :1], memory["c2w"][:, -1:], future["c2w"]), 1)
        return in_view(places, inputs["intrinsic"], cameras, self.size), cameras

    @torch.no_grad()
    def forward(self, views: Sequence[int], firsts: Tensor, seen: InView, c2w: Tensor, intrinsic: Tensor) -> list[Tensor]:
        """The frames of some views.

        Args:
            views: which.
            firsts: float [B, V, 3, h, w] in 0..1, the first pictures at the resolution that is wanted.
            seen, c2w: as `look` says them.
            intrinsic: [B, V, 3, 3] in pixels of full size.

        Returns:
            float [B, K, 3, h, w] in 0..1 for each.
        """
        height, width = firsts.shape[-2:]
        grid = pixel_grid(height, width, firsts.device)
        # What a camera did not see of a thing at first, the first camera may have.
        sources = {view: _Source(firsts[:, view], seen.at(view, 0), grid) for view in sorted({0, *views})}
        return [self._view(view, [sources[number] for number in ((view, 0) if view else (0,))], seen.at(view, slice(2, None)), c2w[:, :, view], intrinsic[:, view], grid) for view in views]

    def _view(self, view: int, sources: list[_Source], then: InView, c2w: Tensor, intrinsic: Tensor, grid: Tensor) -> Tensor:
        """The frames [B, K, 3, h, w] of one view from its own first picture, and the first camera's."""
        mine, bare = sources[0].picture, sources[0].bare
        height, width = mine.shape[-2:]
        mounted = F.interpolate(self.mounted[view][None], size=(height, width), mode="area")
        ground = torch.lerp(mine, bare, F.max_pool2d(mounted, 5, stride=1, padding=2))  # the edge is neither and goes too
        for own in sources[0].covers:
            ground = torch.lerp(ground, bare, own)
        out = self._ground(ground, bare, intrinsic, c2w, grid).permute(0, 1, 3, 4, 2).contiguous()  # the three colours side by side, as pixels are picked
        # What stands higher lies over what it stands on; the data's order has movable things first.
        for number in reversed(range(len(sources[0].covers))):
            things = [(torch.cat((source.picture, source.covers[number]), 1), source.begin.where[:, number], source.begin.axes[:, number], source.begin.visible[:, number]) for source in sources]
            _paste(out, things, then.where[:, :, number], then.axes[:, :, number], then.visible[:, :, number])
        return torch.lerp(out.permute(0, 1, 4, 2, 3), mine[:, None], mounted[:, None])

    def _ground(self, picture: Tensor, bare: Tensor, intrinsic: Tensor, c2w: Tensor, grid: Tensor) -> Tensor:
        """The plane z = 0 as it is in picture [B, 3, h, w], seen from the cameras to come: [B, K, 3, h, w]."""
        half = torch.tensor([[2 / self.size[1], 0, -1], [0, 2 / self.size[0], -1], [0, 0, 1]], device=picture.device)
        # From the plane's (x, y, 1) to half-pictures, for every camera; of a camera in the plane the first picture stays.
        onto = (half @ intrinsic)[:, None] @ invert(c2w)[..., :3, :][..., [0, 1, 3]]
        back, failed = torch.linalg.inv_ex(onto[:, 2:])
        through = torch.where(failed[..., None, None] > 0, torch.eye(3, device=back.device), onto[:, :1] @ back)
        if bool((through - torch.eye(3, device=through.device)).abs().amax() < 1e-5):
            return picture[:, None].repeat(1, through.shape[1], 1, 1, 1)  # a camera that stands still
        homogeneous = torch.cat((grid, torch.ones_like(grid[..., :1])), -1)
        at = torch.einsum("bkij,hwj->bkhwi", through, homogeneous)
        where = torch.where(at[..., 2:] <= 1e-6, 3.0, at[..., :2] / at[..., 2:].clamp(min=1e-6))
        # Beyond the first picture the ground has its usual colour.
        out = F.grid_sample(picture - bare, where.flatten(1, 2), align_corners=False).unflatten(2, (-1, grid.shape[0])).transpose(1, 2)
        return out + bare[:, None]


def _paste(out: Tensor, things: list[tuple[Tensor, Tensor, Tensor, Tensor]], where: Tensor, axes: Tensor, visible: Tensor) -> None:
    """Lay a thing over frames out [B, K, h, w, 3], in place, where it is [B, K, 2] and as it is turned [B, K, 2, 2] there.

    Args:
        things: pictures with a fourth channel that covers it [B, 4, h, w], where [B, 2] and with which axes [B, 2, 2] it is in them,
            and whether, bool [B]; where the first picture ends, or has it not, the second is taken.
        visible: bool [B, K].
    """
    (batch, steps, height, width, _), device = out.shape, out.device
    back = torch.linalg.inv(regular(axes))
    # Only around the thing; a frame in which it is small is for the most part left alone.
    reach = (_HALF * axes.abs().sum(-1) * visible[..., None]).amax((0, 1)) * torch.tensor([width, height], device=device)
    wide, high = (min(most, int(extent) + 3) for extent, most in zip(reach.tolist(), (width, height), strict=True))
    room = torch.tensor([width - wide, height - high], device=device)
    corner = torch.minimum((((where + 1) * torch.tensor([width, height], device=device) - torch.tensor([wide, high], device=device)) / 2).round().long().clamp(min=0), room)
    columns, rows = corner[..., :1] + torch.arange(wide, device=device), corner[..., 1:] + torch.arange(high, device=device)
    grid = torch.stack(((columns[:, :, None].expand(-1, -1, high, -1) * 2 + 1) / width - 1, (rows[..., None].expand(-1, -1, -1, wide) * 2 + 1) / height - 1), -1)
    carried: Tensor | None = None
    for picture, begin, turned, shown in reversed(things):
        move = turned[:, None] @ back  # from this frame's half-pictures to that picture's
        at = begin[:, None, None, None] + torch.einsum("bkij,bkhwj->bkhwi", move, grid - where[:, :, None, None])
        there = F.grid_sample(picture, at.flatten(1, 2), align_corners=False).unflatten(2, (steps, high)).permute(0, 2, 3, 4, 1)
        inside = (at.abs().amax(-1, keepdim=True) < 1) & shown[:, None, None, None, None]
        carried = there if carried is None else torch.where(inside, there, carried)
    assert carried is not None
    index = (torch.arange(batch, device=device)[:, None, None, None], torch.arange(steps, device=device)[None, :, None, None], rows[..., None], columns[:, :, None])
    out[index] = torch.lerp(out[index], carried[..., :3], carried[..., 3:] * visible[..., None, None, None])


class _Source:
    """A first picture [B, 3, h, w] and what is in it: the ground's colour bare [B, 3, 1, 1], and for each thing in view [B, S] which pixels are its own, covers of [B, 1, h, w]."""

    def __init__(self, picture: Tensor, begin: InView, grid: Tensor):
        self.picture, self.begin = picture, begin
        # A look at every third row and column tells what most of it shows.
        self.bare = picture[..., ::3, ::3].flatten(2).median(-1).values[..., None, None]
        self._from_bare, self._tints = _apart(picture, self.bare), _tint(picture)
        self._tint_from_bare = _apart(self._tints, _tint(self.bare))
        self.covers = [self._cover(number, grid) for number in range(begin.where.shape[1])]

    def _cover(self, number: int, grid: Tensor) -> Tensor:
        """A pixel is a thing's if it is near it, and more of its colour than of the ground's, in light or in shade."""
        where, axes = self.begin.where[:, number], self.begin.axes[:, number]
        u, v = on_thing(where, axes, grid).unbind(-1)
        window = ((_HALF - (u.square() + v.square()).sqrt()) / _SOFT).clamp(0, 1)
        points = where[:, None] + torch.einsum("bij,nj->bni", axes, 0.01 * torch.tensor([[0.0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], device=where.device))
        colour = F.grid_sample(self.picture, points[:, None], padding_mode="border", align_corners=False)[:, :, 0].median(-1).values[..., None, None]
        lit, tinted = self._from_bare - _apart(self.picture, colour), self._tint_from_bare - _apart(self._tints, _tint(colour))
        return (window * (0.5 + _LIKE * torch.maximum(lit, 2 * tinted)).clamp(0, 1) * self.begin.visible[:, number, None, None])[:, None]


def _apart(one: Tensor, other: Tensor) -> Tensor:
    """How far apart colours [B, 3, h, w] are, [B, h, w]; three sums are faster than torch's over a short axis."""
    red, green, blue = (one - other).abs().unbind(1)
    return red + green + blue


def _tint(colours: Tensor) -> Tensor:
    """Colours [B, 3, h, w] as shares of their light."""
    red, green, blue = colours.unbind(1)
    return colours / (red + green + blue).clamp(min=0.1)[:, None]
