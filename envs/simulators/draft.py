"""Frames drafted from geometry alone, for a network to correct: the first picture, as it would look if nothing had happened but what is known to.

What a camera sees of the ground moves with the camera by a plane's homography, things are carried and turned to where
they will be, and what is mounted on a moving camera stays where it is in its picture. Arms stay as they were; they,
and whatever the first picture did not show, are what is left for the network.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.encoders import middles
from envs.geometry import invert
from envs.simulators.folding import at_detail
from envs.simulators.in_view import InView, in_view, on_thing, pixel_grid, regular

_HALF = 0.058  # m around a thing's middle within which its pixels lie
_SOFT = 0.006  # m over which that window ends
_LIKE = 9.0  # how sharply pixels are told apart by colour: a thing's, or what it lies on
_STILL = 0.02  # largest deviation, over episodes, of the colours (0..1) of what is mounted on a camera


class Draft(nn.Module):
    """Drafts of frames to come. What the first picture gives is prepared once for all of an episode's chunks.

    Args:
        views: cameras, V.
        size: (height, width) of their pictures.
        shrink: how much smaller each view is drafted, 1 or 2; 1 is full detail, and the default.

    Attributes:
        mounted: float32 [V, 1, H, W], 1 where a moving camera always sees the same: what it is mounted on.
        moving: bool [V], which cameras move; the others see the same ground in every frame.
    """

    mounted: Tensor
    moving: Tensor

    def __init__(self, views: int, size: tuple[int, int], shrink: Sequence[int] | None = None):
        super().__init__()
        self.size, self.shrink = size, tuple(shrink or (1,) * views)
        self.register_buffer("mounted", torch.zeros(views, 1, *size))
        self.register_buffer("moving", torch.zeros(views, dtype=torch.bool))

    @torch.no_grad()
    def learn(self, frames: Tensor, c2w: Tensor) -> None:
        """Find what is mounted on cameras, from frames uint8 [N, V, 3, H, W] of different episodes and c2w [N, V, 4, 4]."""
        frames, c2w = frames.to(self.mounted.device), c2w.to(self.mounted.device)
        self.moving.copy_((c2w - c2w[:1]).abs().amax((0, 2, 3)) > 1e-3)
        same = (frames.float() / 255).std(0).amax(1, keepdim=True) < _STILL
        self.mounted.copy_(same * self.moving[:, None, None, None])

    @torch.no_grad()
    def prepare(self, frames: Tensor, places: Tensor, intrinsic: Tensor, c2w: Tensor) -> TensorDict:
        """What drafts are made of: first pictures, cut into ground and things.

        Args:
            frames: uint8 [B, V, 3, H, W]; places: [B, S, 4] of things in them.
            intrinsic: [B, V, 3, 3] pixels; c2w: [B, V, 4, 4].

        Returns:
            TensorDict [B] of one for each view ("0", "1", ...): the camera `c2w`, the ground's colour `bare` [B, 3, 1, 1], the `ground`
            without things and what is `mounted` [B, 3, h, w], and the things' pictures with a fourth channel that covers
            them [B, S, 4, h, w], `where` [B, S, 2] and with which `axes` [B, S, 2, 2] they are in them (InView), and whether, `visible`.
        """
        seen = in_view(places[:, None], intrinsic, c2w[:, None], self.size).at(slice(None), 0)
        # What a camera does not see the whole of at first, the first camera may.
        other = {shrink: _things(at_detail(frames[:, 0], shrink), _of(seen, 0)) for shrink in sorted(set(self.shrink))}
        out = {}
        for view, shrink in enumerate(self.shrink):
            picture, begin = at_detail(frames[:, view], shrink), _of(seen, view)
            things = _things(picture, begin) if view else other[shrink]
            mounted = F.interpolate(self.mounted[view][None], size=picture.shape[-2:], mode="area")
            mine = F.max_pool2d(mounted, 5, stride=1, padding=2)  # the edge is neither and goes too
            bare = _bare(picture)
            ground = torch.lerp(picture, bare, 1 - (1 - mine) * (1 - things["things"][:, :, 3:]).prod(1))
            if view:
                whole = begin.visible & (begin.where.abs() + _HALF * begin.axes.abs().sum(-1) < 1).all(-1) | ~other[shrink]["visible"]
                things = {name: torch.where(whole.view(*whole.shape, *[1] * (value.ndim - 2)), value, other[shrink][name]) for name, value in things.items()}
            out[str(view)] = TensorDict({"c2w": c2w[:, view], "bare": bare, "ground": ground, "mounted": picture * mounted, **things}, frames.shape[:1])
        return TensorDict(out, frames.shape[:1])

    def look(self, inputs: TensorDict) -> InView:
        """Objects in all views [B, V, 1 + K, S], at the last remembered frame and at the K to come; `inputs` are those of Simulator.predict."""
        places = torch.cat((inputs["now", "places"][:, None], inputs["future", "places"]), 1)
        cameras = torch.cat((inputs["memory", "c2w"][:, -1:], inputs["future", "c2w"]), 1)
        return in_view(places, inputs["intrinsic"], cameras, self.size)

    @torch.no_grad()
    def forward(self, begin: TensorDict, seen: InView, c2w: Tensor, intrinsic: Tensor) -> list[Tensor]:
        """The frames to come.

        Args:
            begin: as prepared.
            seen: objects at the frames to come, [B, V, K, S].
            c2w: [B, K, V, 4, 4] cameras then; intrinsic: [B, V, 3, 3] in pixels of full size.

        Returns:
            float [B, K, 3, h, w] in 0..1 for each view.
        """
        moving = self.moving.tolist()
        return [self._view(view, moving[view], begin, seen.at(view, slice(None)), c2w[:, :, view], intrinsic[:, view]) for view in range(len(moving))]

    def _view(self, view: int, moving: bool, begin: TensorDict, then: InView, c2w: Tensor, intrinsic: Tensor) -> Tensor:
        """The frames [B, K, 3, h, w] of one view from its own first picture, and the first camera's."""
        mine = begin[str(view)]
        out = self._ground(mine, intrinsic, c2w) if moving else mine["ground"][:, None].repeat(1, c2w.shape[1], 1, 1, 1)
        # What stands higher lies over what it stands on; the data's order has movable things first.
        for number in reversed(range(then.where.shape[2])):
            _paste(out, mine.select("things", "where", "axes", "visible").apply(partial(torch.select, dim=1, index=number)), then.where[:, :, number], then.axes[:, :, number], then.visible[:, :, number])
        if not moving:
            return out
        mounted = F.interpolate(self.mounted[view][None], size=out.shape[-2:], mode="area")
        return torch.addcmul(mine["mounted"][:, None], out, 1 - mounted)

    def _ground(self, first: TensorDict, intrinsic: Tensor, c2w: Tensor) -> Tensor:
        """The plane z = 0 as a first picture has it, from the cameras to come [B, K, 4, 4]: [B, K, 3, h, w]."""
        picture, bare = first["ground"], first["bare"]
        half = torch.tensor([[2 / self.size[1], 0, -1], [0, 2 / self.size[0], -1], [0, 0, 1]], device=picture.device)
        # From the plane's (x, y, 1) to half-pictures, for every camera; of a camera in the plane the first picture stays.
        onto = (half @ intrinsic)[:, None] @ invert(torch.cat((first["c2w"][:, None], c2w), 1))[..., :3, :][..., [0, 1, 3]]
        back, failed = torch.linalg.inv_ex(onto[:, 1:])
        through = torch.where(failed[..., None, None] > 0, torch.eye(3, device=back.device), onto[:, :1] @ back)
        height, width = picture.shape[-2:]
        across, down = middles(width, picture.device), middles(height, picture.device)[:, None]
        u, v, depth = ((row[..., :1, None] * across + (row[..., 1:2, None] * down + row[..., 2:, None])) for row in through.unbind(2))
        where = torch.stack((u, v), -1) / depth.clamp(min=1e-6)[..., None]
        where = where.masked_fill_((depth <= 1e-6)[..., None], 3.0)
        # Beyond the first picture the ground has its usual colour.
        out = F.grid_sample(picture - bare, where.flatten(1, 2), align_corners=False).unflatten(2, (-1, height)).transpose(1, 2)
        return (out + bare[:, None]).contiguous()


def _paste(out: Tensor, thing: TensorDict, where: Tensor, axes: Tensor, visible: Tensor) -> None:
    """Lay a thing, as prepared, over frames out [B, K, 3, h, w], in place, where it is [B, K, 2] and as it is turned [B, K, 2, 2] there, if it is visible, bool [B, K]."""
    (_, steps, _, height, width), device = out.shape, out.device
    visible = visible & thing["visible"][:, None]
    # Only around the thing; a frame in which it is small is for the most part left alone.
    size = torch.tensor([width, height], device=device)
    reach = (_HALF * axes.abs().sum(-1) * visible[..., None]).amax((0, 1)) * size
    wide, high = (min(most, int(extent) + 3) for extent, most in zip(reach.tolist(), (width, height), strict=True))
    room = torch.tensor([wide, high], device=device)
    corner = torch.minimum((((where + 1) * size - room) / 2).round().long().clamp(min=0), size - room)
    columns, rows = corner[..., :1] + torch.arange(wide, device=device), corner[..., 1:] + torch.arange(high, device=device)
    u = (columns * 2 + 1) / width - 1 - where[..., :1]
    v = (rows * 2 + 1) / height - 1 - where[..., 1:]
    move = (thing["axes"][:, None] @ torch.linalg.inv(regular(axes)))[:, :, None, None]  # from this frame's half-pictures to that picture's
    at = torch.addcmul(thing["where"][:, None, None, None] + v[:, :, :, None, None] * move[..., 1], u[:, :, None, :, None], move[..., 0])
    carried = F.grid_sample(thing["things"], at.flatten(1, 2), align_corners=False).unflatten(2, (steps, high)).flatten(3).transpose(1, 2)  # [B, K, 4, n]
    index = (rows[..., None] * width + columns[:, :, None]).flatten(2)[:, :, None].expand(-1, -1, 3, -1)
    pixels = out.flatten(3)
    pixels.scatter_(3, index, torch.lerp(pixels.gather(3, index), carried[:, :, :3], carried[:, :, 3:] * visible[..., None, None]))


def _of(seen: InView, view: int) -> InView:
    """One view [B, S] of places [B, V, S]."""
    return InView(*(value[:, view] for value in seen))


def _bare(picture: Tensor) -> Tensor:
    """The ground's colour [B, 3, 1, 1] in a picture [B, 3, h, w]: a look at every third row and column tells what most of it shows."""
    return picture[..., ::3, ::3].flatten(2).median(-1).values[..., None, None]


def _things(picture: Tensor, begin: InView) -> dict[str, Tensor]:
    """Things as `prepare` gives them, from the picture [B, 3, h, w] they are in."""
    covers = _covers(picture, _bare(picture), begin)
    pictures = torch.cat((picture[:, None].expand(-1, covers.shape[1], -1, -1, -1), covers), 2)
    return {"things": pictures, "where": begin.where, "axes": begin.axes, "visible": begin.visible}


def _covers(picture: Tensor, bare: Tensor, begin: InView) -> Tensor:
    """Which pixels [B, S, 1, h, w] of a picture [B, 3, h, w] are a thing's own: those near it, and more of its colour than of the ground's, in light or in shade."""
    grid = pixel_grid(picture.shape[-2], picture.shape[-1], picture.device)
    from_bare, tints = _apart(picture, bare), _tint(picture)
    tint_from_bare = _apart(tints, _tint(bare))
    covers = torch.zeros((*begin.visible.shape, 1, *picture.shape[-2:]), device=picture.device)
    for number in range(begin.where.shape[1]):
        where, axes = begin.where[:, number], begin.axes[:, number]
        u, v = on_thing(where, axes, grid).unbind(-1)
        window = ((_HALF - (u.square() + v.square()).sqrt()) / _SOFT).clamp(0, 1)
        points = where[:, None] + torch.einsum("bij,nj->bni", axes, 0.01 * torch.tensor([[0.0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], device=where.device))
        colour = F.grid_sample(picture, points[:, None], padding_mode="border", align_corners=False)[:, :, 0].median(-1).values[..., None, None]
        lit, tinted = from_bare - _apart(picture, colour), tint_from_bare - _apart(tints, _tint(colour))
        covers[:, number, 0] = window * (0.5 + _LIKE * torch.maximum(lit, 2 * tinted)).clamp(0, 1) * begin.visible[:, number, None, None]
    return covers


def _apart(one: Tensor, other: Tensor) -> Tensor:
    """How far apart colours [B, 3, h, w] are, [B, h, w]; three sums are faster than torch's over a short axis."""
    red, green, blue = (one - other).abs().unbind(1)
    return red + green + blue


def _tint(colours: Tensor) -> Tensor:
    """Colours [B, 3, h, w] as shares of their light."""
    red, green, blue = colours.unbind(1)
    return colours / (red + green + blue).clamp(min=0.1)[:, None]
