"""The strong cheap engine: a U-Net that predicts a whole chunk in one deterministic pass.

Each view is folded into channels (side views at half the detail), memory and future pose maps ride along as
channels beside drafts of the frames to come (draft.py) and spots where objects are and will be, and commands
modulate
every block. A pixel of the output is a soft choice between sources: the draft, the last frame as it is, the
last frame
moved by a predicted flow, and a drawn colour. Things that move are then copied instead of remembered by the
network,
which learns far faster than a residual does.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.conditioning import render_ray_map
from envs.precision import working_dtype
from envs.simulators.base import Simulator, WorldShape, foreground_weight, to_bytes
from envs.simulators.draft import Draft
from envs.simulators.in_view import pixel_grid, place_map
from envs.simulators.unet.folding import at_detail, fold, unfold
from envs.specs import ACTION_DIM, to_relative


@dataclass(frozen=True)
class UNetConfig:
    """Size of the U-Net.

    Args:
        shrink: how much smaller each view is looked at and drawn; 1 is full detail, which the view that
            decides should have.
        width: channels at the fine level; the coarse level has twice as many.
        blocks: residual blocks per fine half, and in the bottleneck.
        foreground: extra loss weight of what differs from the median colour.
        emphasis: loss weight of each view.
    """

    shrink: tuple[int, ...] = (1, 2, 2)
    width: int = 32
    blocks: tuple[int, int] = (1, 3)
    foreground: float = 8.0
    emphasis: tuple[float, ...] = (1.0, 0.4, 0.4)


_FOLD = 4  # pixels folded into channels, both ways
_SOURCES = 4  # draft, still, flow, drawn colour
_REACH = 8.0  # pixels one unit of flow moves


class _Block(nn.Module):
    """Residual block of two 3x3 convolutions whose middle is scaled and shifted by the actions."""

    def __init__(self, width: int, cond: int):
        super().__init__()
        self.norm1, self.norm2 = nn.GroupNorm(8, width), nn.GroupNorm(8, width)
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        self.film = nn.Linear(cond, 2 * width)
        nn.init.zeros_(self.conv2.weight)
        nn.init.zeros_(self.film.weight)
        nn.init.zeros_(self.film.bias)

    def forward(self, x: Tensor, cond: Tensor) -> Tensor:
        h = self.conv1(F.silu(self.norm1(x)))
        scale, shift = self.film(cond)[..., None, None].chunk(2, 1)
        h = self.conv2(F.silu(self.norm2(h) * (1 + scale) + shift))
        return x + h


class _Embed(nn.Module):
    """Looks at one view, square by square.

    Args:
        pictures, maps: channels that are bytes, and those that are floats.
        width: of what comes out.
        shrink: how much larger the bytes' pictures are than the maps; of each of their pixels only the mean
            counts.
    """

    def __init__(self, pictures: int, maps: int, width: int, shrink: int):
        super().__init__()
        self.shrink = shrink
        bound = (pictures + maps) ** -0.5 / _FOLD
        self.pictures = nn.Parameter(torch.empty(width, pictures, _FOLD, _FOLD).uniform_(-bound, bound))
        self.maps = nn.Parameter(torch.empty(width, maps * _FOLD**2).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(width).uniform_(-bound, bound))

    def forward(self, pictures: Tensor, maps: Tensor) -> Tensor:
        """[B, width, h / 4, w / 4] from pictures uint8 [B, C, shrink h, shrink w] and maps in -1..1 [B, D, h,
        w].
        """
        dtype = working_dtype(pictures.device, self.maps.dtype)
        weight: Tensor = self.pictures
        if self.shrink > 1:
            weight = (
                weight.repeat_interleave(self.shrink, 2).repeat_interleave(self.shrink, 3) / self.shrink**2
            )
        # Bytes stay what they are; that they are meant as -1..1 is left to the weights.
        weight = weight.flatten(1)
        x = F.linear(fold(pictures, _FOLD * self.shrink).to(dtype), weight / 127.5, self.bias - weight.sum(1))
        return (x + F.linear(fold(maps, _FOLD).to(dtype), self.maps)).permute(0, 3, 1, 2)


def _head(width: int, chunk: int, channels: int) -> nn.Sequential:
    """Output layer of one view; it starts from the draft, for random output takes hundreds of steps to
    unlearn.
    """
    last = nn.Conv2d(width, channels * chunk * _FOLD**2, 1)
    bias = torch.zeros(chunk, channels, _FOLD**2)
    bias[:, 0] = 3.0
    nn.init.zeros_(last.weight)
    last.bias = nn.Parameter(bias.flatten())
    return nn.Sequential(nn.GroupNorm(8, width), nn.SiLU(), last)


def _compose(drawn: Tensor, draft: Tensor, last: Tensor) -> Tensor:
    """Frames [B, K, 3, H, W] of a chunk in one view, from output maps [B, K, 9, H, W], drafts [B, K, 3, H, W]
    and the last frame [B, 3, H, W].
    """
    _, chunk, _, height, width = drawn.shape
    # Split, not sliced: the gradient of a slice is a full map of zeros.
    logits, flow, colour = drawn.split((_SOURCES, 2, 3), 2)
    drafted, still, moves, fresh = logits.softmax(2).split(1, 2)
    step = 2 * _REACH / torch.tensor([width, height], device=drawn.device)
    grid = torch.addcmul(pixel_grid(height, width, drawn.device), flow.permute(0, 1, 3, 4, 2), step)
    # All frames of a chunk are sampled from one picture: stack them as rows of one tall grid.
    moved = (
        F.grid_sample(last, grid.flatten(1, 2), padding_mode="border", align_corners=False)
        .unflatten(2, (chunk, height))
        .transpose(1, 2)
    )
    out = torch.addcmul(drafted * draft, still, last[:, None])
    return torch.addcmul(torch.addcmul(out, moves, moved), fresh, 0.5 + 0.5 * colour)


class UNetSimulator(Simulator):
    """One-pass deterministic video predictor over all views; see UNetConfig.

    Args:
        shape: what it shows.
        config: its size.
    """

    def __init__(self, shape: WorldShape, config: UNetConfig | None = None):
        super().__init__(shape)
        self.config = config = config or UNetConfig()
        if len(config.shrink) != shape.views or len(config.emphasis) != shape.views:
            raise ValueError(
                f"simulator.shrink and simulator.emphasis need one entry per view; there are {shape.views} views"
            )
        if not set(config.shrink) <= {1, 2}:
            raise ValueError(
                f"simulator.shrink={list(config.shrink)} may hold 1 (full detail) and 2 (half) only"
            )
        wide = 2 * config.width
        pictures = 3 * (2 * shape.memory + shape.chunk)  # memory frames and pose maps, future pose maps
        # drafts, and spots of the objects now and in future
        maps = 3 * shape.chunk + shape.objects * (1 + shape.chunk)
        self.draft = Draft(shape.views, shape.size, config.shrink)
        cond = 256
        self.feature_shape = (wide + cond,)
        self.actions = nn.Sequential(
            nn.Linear((shape.chunk + 1) * ACTION_DIM, cond), nn.SiLU(), nn.Linear(cond, cond)
        )
        self.embed = nn.ModuleList(
            _Embed(pictures, maps, config.width if s == 1 else wide, s) for s in config.shrink
        )
        self.rays = nn.Conv2d(12 * shape.views, wide, 1)
        self.down = nn.Conv2d(config.width, wide, 2, stride=2)
        self.up = nn.Conv2d(wide, config.width * 4, 1)
        self.fuse = nn.Conv2d(2 * config.width, config.width, 1)
        fine, deep = config.blocks
        self.fine_in = nn.ModuleList(_Block(config.width, cond) for _ in range(fine))
        self.deep = nn.ModuleList(_Block(wide, cond) for _ in range(deep))
        self.fine_out = nn.ModuleList(_Block(config.width, cond) for _ in range(fine))
        self.heads = nn.ModuleList(
            _head(config.width if s == 1 else wide, shape.chunk, _SOURCES + 2 + 3) for s in config.shrink
        )

    def glance(self, frames: Tensor, c2w: Tensor) -> None:
        """See Simulator.glance."""
        self.draft.learn(frames, c2w)

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator.predict; features are the pooled bottleneck beside the action embedding."""
        views, features = self.views(inputs)
        return self._enlarge(views), features

    def prepare(self, frames: Tensor, places: Tensor, intrinsic: Tensor, c2w: Tensor) -> TensorDict:
        """See Simulator.prepare."""
        return self.draft.prepare(frames, places, intrinsic, c2w)

    def _enlarge(self, views: list[Tensor]) -> Tensor:
        """Frames uint8 [B, K, V, 3, H, W] of all views at full size."""
        full = [
            view
            if s == 1
            else F.interpolate(
                view.flatten(0, 1), scale_factor=s, mode="bilinear", align_corners=False
            ).unflatten(0, view.shape[:2])
            for s, view in zip(self.config.shrink, views, strict=True)
        ]
        return torch.stack([to_bytes(view) for view in full], 2)

    def features(self, inputs: TensorDict) -> Tensor:
        """See Simulator.features; nothing is drawn."""
        _, z, cond, _ = self._encode(inputs)
        return torch.cat([z.float().mean((-2, -1)), cond.float()], 1)

    def _encode(self, inputs: TensorDict) -> tuple[Tensor, Tensor, Tensor, list[tuple[Tensor, Tensor]]]:
        """Fine and coarse maps, the action embedding, and each view's drafts [B, K, 3, h, w] and last frame
        as it is looked at.
        """
        memory, future = inputs["memory"], inputs["future"]
        relative = to_relative(future["commands"], inputs["now", "command"]) * 10.0  # decimetres
        cond = self.actions(torch.cat([relative.flatten(1), inputs["now", "command"]], 1))
        fine: list[Tensor] = []
        deep = [self.rays(self._rays(inputs))]
        ends: list[tuple[Tensor, Tensor]] = []
        seen = self.draft.look(inputs)
        drafts = self.draft(
            inputs["begin"], seen.at(slice(None), slice(1, None)), future["c2w"], inputs["intrinsic"]
        )
        for view, (shrink, embed, draft) in enumerate(
            zip(self.config.shrink, self.embed, drafts, strict=True)
        ):
            pictures = torch.cat(
                [
                    part[:, :, view].flatten(1, 2)
                    for part in (memory["frames"], memory["pose_map"], future["pose_map"])
                ],
                1,
            )
            spots = place_map(seen.at(view, slice(None)), *draft.shape[-2:])
            (fine if shrink == 1 else deep).append(
                embed(pictures, torch.cat((draft.flatten(1, 2) * 2 - 1, spots.flatten(1, 2)), 1))
            )
            ends.append((draft, at_detail(memory["frames"][:, -1, view], shrink)))
        x = torch.stack(fine).sum(0)
        for block in self.fine_in:
            x = block(x, cond)
        z = self.down(x) + torch.stack(deep).sum(0)
        for block in self.deep:
            z = block(z, cond)
        return x, z, cond, ends

    def views(self, inputs: TensorDict) -> tuple[list[Tensor], Tensor]:
        """Frames of each view [B, K, 3, H / shrink, W / shrink], not yet enlarged, and the features."""
        x, z, cond, ends = self._encode(inputs)
        x = self.fuse(torch.cat([x, F.pixel_shuffle(self.up(z), 2)], 1))
        for block in self.fine_out:
            x = block(x, cond)
        views: list[Tensor] = []
        for shrink, head, (draft, last) in zip(self.config.shrink, self.heads, ends, strict=True):
            drawn = unfold(head(x if shrink == 1 else z).permute(0, 2, 3, 1).float(), _FOLD).unflatten(
                1, (self.shape.chunk, -1)
            )
            views.append(_compose(drawn, draft, last))
        return views, torch.cat([z.float().mean((-2, -1)), cond.float()], 1)

    def _rays(self, inputs: TensorDict) -> Tensor:
        """Ray maps [B, V * 12, h, w] of the last remembered and the last future frame at the bottleneck's
        resolution.
        """
        # [B, V, 2, 4, 4]
        c2w = torch.stack([inputs["memory", "c2w"][:, -1], inputs["future", "c2w"][:, -1]], 2)
        rays = render_ray_map(inputs["intrinsic"], c2w, self.shape.size, stride=2 * _FOLD)
        return rays.flatten(1, 3)

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Weighted error over all chunks of the clip, each predicted from the model's own earlier chunks.

        Gradients stay within a chunk; predictions are rounded to bytes in between, as they are in rollouts.
        """
        chunk, chunks = self.shape.chunk, clip["memory", "index"].shape[1]
        drawn: Tensor | None = None
        begin: TensorDict | None = None
        losses = []
        for number in range(chunks):
            part = slice(number * chunk, (number + 1) * chunk)
            inputs = self.build_inputs(clip, number, drawn, begin=begin)
            begin = inputs["begin"]
            views, _ = self.views(inputs)
            valid = clip["future", "valid"][:, part, None, None, None]
            error, norm = torch.zeros(()), torch.zeros(())
            for view, (frames, shrink, emphasis) in enumerate(
                zip(views, self.config.shrink, self.config.emphasis, strict=True)
            ):
                truth = at_detail(clip["future", "frames"][:, part, view].flatten(0, 1), shrink).unflatten(
                    0, (-1, chunk)
                )
                weight = foreground_weight(truth, self.config.foreground) * valid * emphasis
                # An absolute error alone never leaves "nothing moves", the median of sparse change; squares
                # do.
                gap = frames - truth
                error = error + ((gap.abs() + 50 * gap.square()) * weight).sum()
                norm = norm + 3 * weight.sum()
            losses.append(error / norm.clamp(min=1))
            if number + 1 < chunks:
                with torch.no_grad():
                    pictures = self._enlarge(views)
                drawn = pictures if drawn is None else torch.cat([drawn, pictures], 1)
        return torch.stack(losses).mean(), {
            "first_chunk": losses[0].detach(),
            "last_chunk": losses[-1].detach(),
        }
