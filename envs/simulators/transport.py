"""Things that move as a whole: masks on the last frame, each carried to where it will be (Finn et al. 2016, STP).

A block that is pushed keeps its shape. Drawing it anew in every chunk blurs it away over a rollout; lifting it out of
the last frame and setting it down elsewhere does not. What carries it is a small network that sees no pixels, only
where the mask is and where the fingertips are and will be in the picture: contact is then a matter of few numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.geometry import fingertips, project
from envs.simulators.base import hue_gap

_SPAN = 3.0  # half-pictures beyond which a fingertip counts as out of sight


def in_view(points: Tensor, intrinsic: Tensor, c2w: Tensor, size: tuple[int, int]) -> InView:
    """Where points [B, T, N, 3] are in the pictures of every view.

    Args:
        intrinsic: [B, V, 3, 3] pixels of `size` = (height, width); c2w: [B, T, V, 4, 4].

    Returns:
        Where they are, with leading dimensions [B, V].
    """
    steps, views = c2w.shape[1:3]
    pixels, depth = project(points[:, :, None].expand(-1, -1, views, -1, -1), intrinsic[:, None].expand(-1, steps, -1, -1, -1), c2w)
    where = pixels / (torch.tensor([size[1], size[0]], device=points.device) / 2) - 1
    visible = (depth > 1e-3) & (where.abs() < 1).all(-1)  # false for NaN, an object nobody knows the place of
    area = (0.05 * intrinsic[:, None, :, 0, 0, None] / depth.clamp(min=1e-3) / size[1]).square()
    return InView(where.transpose(1, 2), visible.transpose(1, 2), area.transpose(1, 2))


def track_loss(carried: Carried, now: InView, ahead: InView, valid: Tensor) -> Tensor:
    """How far the first parts are from known objects, and how far from their size.

    Object positions are known where episodes carry them: in physics, or on real video by a tracker. They teach which
    parts there are; without them (NaN) the picture alone does.

    Args:
        now: in_view of the objects at the last frame, each [B, 1, N]; ahead: at the frames to come, each [B, K, N].
        valid: bool [B, K], frames that exist.
    """
    count = min(carried.middle.shape[1], now[0].shape[2])
    (here, seen, area), (there, later, _) = now, ahead
    here, seen, area = here[:, 0, :count], seen[:, 0, :count].float(), area[:, 0, :count]
    there, later = there[:, :, :count].transpose(1, 2), (later[:, :, :count] & valid[:, :, None]).transpose(1, 2).float() * seen[..., None]
    gap = torch.nan_to_num(carried.middle[:, :count] - here).abs().sum(-1)
    path = torch.nan_to_num(here[:, :, None] + carried.shift[:, :count] - there).abs().sum(-1)
    share = area * carried.masks.shape[-1] ** 2  # pixels of a picture of this size
    mass = carried.masks[:, :count].sum((-2, -1)) / torch.nan_to_num(share, nan=1.0).clamp(min=1.0)
    size = (0.8 - mass).clamp(min=0) + 0.2 * (mass - 3.0).clamp(min=0)
    return ((gap + size) * seen).sum() / seen.sum().clamp(min=1) + (path * later).sum() / later.sum().clamp(min=1)


def tip_tracks(now: Tensor, commands: Tensor, intrinsic: Tensor, c2w_now: Tensor, c2w: Tensor, size: tuple[int, int]) -> Tensor:
    """Fingertips in the pictures of every view, in half-pictures from the middle.

    Args:
        now: [B, 14] command in force; commands: [B, K, 14] to come.
        intrinsic: [B, V, 3, 3] pixels of `size` = (height, width).
        c2w_now: [B, V, 4, 4]; c2w: [B, K, V, 4, 4] as they will be.

    Returns:
        [B, V, 1 + 2 K, 2, 2]: both tips now; both tips at each step; and where both present tips will appear at each
        step, which says how the camera itself moves.
    """
    scale = torch.tensor([size[1], size[0]], device=now.device) / 2

    def see(points: Tensor, camera: Tensor) -> Tensor:  # [B, T, 2, 3], [B, T, V, 4, 4] -> [B, V, T, 2, 2]
        pixels, depth = project(points[:, :, None].expand(-1, -1, camera.shape[2], -1, -1), intrinsic[:, None].expand(-1, camera.shape[1], -1, -1, -1), camera)
        where = torch.where(depth[..., None] > 1e-3, pixels / scale - 1, torch.full_like(pixels, _SPAN))
        return where.clamp(-_SPAN, _SPAN).transpose(1, 2)

    here, ahead = fingertips(now)[:, None], fingertips(commands)
    return torch.cat((see(here, c2w_now[:, None]), see(ahead, c2w), see(here.expand_as(ahead), c2w)), 2)


class InView(NamedTuple):
    """Points in pictures: where [..., T, N, 2] in half-pictures from the middle, visible bool [..., T, N], and area
    [..., T, N], which a square of 5 cm covers there, in widths squared."""

    where: Tensor
    visible: Tensor
    area: Tensor

    def of(self, view: int) -> InView:
        """Those in one view [B, T, N] of all [B, V, T, N]."""
        return InView(*(value[:, view] for value in self))


class Carried(NamedTuple):
    """Parts of one view and where they go; positions in half-pictures from the middle.

    masks [B, S, H, W] in 0..1 on the last frame, colours [B, S, K, 3, H, W] and cover [B, S, K, 1, H, W] in 0..1 after
    the move, middle [B, S, 2] of each mask and shift [B, S, K, 2] since the last frame.
    """

    masks: Tensor
    colours: Tensor
    cover: Tensor
    middle: Tensor
    shift: Tensor


class Parts(nn.Module):
    """Masks of the things in one view's frame, from their looks alone.

    They must not know the actions: a mask that does fades where it is in doubt about the outcome, and things that are
    in doubt would vanish from a rollout.

    Args:
        slots: masks, S.
        width: channels.
    """

    def __init__(self, slots: int, width: int = 12):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(10, width, 3, padding=1), nn.SiLU(), nn.Conv2d(width, width, 3, padding=2, dilation=2), nn.SiLU(), nn.Conv2d(width, width, 3, padding=4, dilation=4), nn.SiLU(), nn.Conv2d(width, slots, 1)
        )

    def forward(self, frame: Tensor, first: Tensor, pose_map: Tensor) -> Tensor:
        """[B, S, H, W] in 0..1 on `frame`, given the episode's first frame and the frame's pose map, all float [B, 3, H, W] in 0..1."""
        # What is coloured unlike the rest is likelier to be a thing; which of them is one is to be learned.
        hue = hue_gap(frame)
        return (2 * self.layers(torch.cat((frame, first, pose_map, hue), 1)) + 8 * hue - 5).sigmoid()


class Transport(nn.Module):
    """Carries masked parts of one view's last frame through the frames of a chunk.

    Args:
        chunk: frames per chunk, K.
        slots: masks, S.
        width: hidden size of the network that carries them.
    """

    def __init__(self, chunk: int, slots: int, width: int = 128):
        super().__init__()
        self.chunk, self.slots = chunk, slots
        tracks = 4 * (1 + 2 * chunk)
        self.moves = nn.Sequential(nn.Linear(6 + 2 * tracks + slots, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 4 * chunk))
        last = self.moves[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    @torch.autocast("cpu", enabled=False)
    @torch.autocast("cuda", enabled=False)  # positions need more than the eight bits of bfloat16
    def forward(self, masks: Tensor, picture: Tensor, tracks: Tensor) -> Carried:
        """Pictures and masks after the move.

        Args:
            masks: [B, S, H, W] in 0..1 on `picture` [B, 3, H, W], the last frame.
            tracks: [B, 1 + 2 K, 2, 2] of this view (tip_tracks).

        Returns:
            What is where; see Carried.
        """
        batch, slots, height, width = masks.shape
        v, u = torch.meshgrid(torch.arange(height, device=masks.device), torch.arange(width, device=masks.device), indexing="ij")
        place = torch.stack(((2 * u + 1) / width - 1, (2 * v + 1) / height - 1), -1)  # [H, W, 2]
        mass = masks.sum((-2, -1))[..., None] + 1e-3
        middle = torch.einsum("bshw,hwc->bsc", masks, place) / mass
        second = torch.einsum("bshw,hwc->bsc", masks, torch.cat((place.square(), place.prod(-1, keepdim=True)), -1)) / mass
        spread = second - torch.cat((middle.square(), middle.prod(-1, keepdim=True)), -1)
        absolute = tracks.flatten(1)[:, None].expand(-1, slots, -1)
        relative = (tracks[:, None] - middle[:, :, None, None]).flatten(2)
        which = torch.eye(slots, device=masks.device).expand(batch, -1, -1)
        seen = torch.cat((middle, 30 * spread, (mass / (height * width)).log() / 4, absolute, 4 * relative.clamp(-1, 1), which), -1)
        # Each frame goes on from the one before; increments of a frame are small.
        moves = (0.2 * self.moves(seen)).unflatten(-1, (self.chunk, 4)).cumsum(2)  # [B, S, K, 4]
        shift, turn, growth = moves[..., :2], moves[..., 2], moves[..., 3].clamp(-1, 1).exp()
        centre = middle[:, :, None, None, None]
        offset = (place - centre - shift[:, :, :, None, None]) / growth[..., None, None, None]
        aspect = torch.tensor([width / height, height / width], device=masks.device)
        cos, sin = turn.cos()[..., None, None], turn.sin()[..., None, None]
        turned = torch.stack((cos * offset[..., 0] + sin * offset[..., 1] * aspect[1], cos * offset[..., 1] - sin * offset[..., 0] * aspect[0]), -1)
        grid = (centre + turned).flatten(0, 1).flatten(1, 2)  # [B S, K H, W, 2]
        source = torch.cat((picture[:, None].expand(-1, slots, -1, -1, -1), masks[:, :, None]), 2).flatten(0, 1)
        carried = F.grid_sample(source, grid, padding_mode="zeros", align_corners=False)
        carried = carried.unflatten(2, (self.chunk, height)).unflatten(0, (batch, slots)).transpose(2, 3)  # [B, S, K, 4, H, W]
        return Carried(masks, carried[:, :, :, :3], carried[:, :, :, 3:], middle, shift)
