"""The strong cheap engine: a U-Net that predicts a whole chunk in one deterministic pass.

Each view is folded into channels (side views at half the detail), memory and future pose maps ride along as
channels beside spots where objects are and will be, and commands modulate every block. A pixel of the output is a
soft choice between sources: the last frame as it is, the last frame moved by a predicted flow, the first frame, the
median colour, a drawn colour, and, for every object, the last frame moved as that object moves. Things that move are
then copied instead of remembered by the network, which learns far faster than a residual does.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.conditioning import render_ray_map
from envs.schema import ACTION_DIM, to_relative
from envs.simulators.base import Simulator, WorldShape, foreground_weight
from envs.simulators.places import InView, in_view, place_map


@dataclass(frozen=True)
class UNetConfig:
    """Size of the U-Net.

    Args:
        shrink: how much smaller each view is looked at and drawn; 1 is full detail, which the view that decides should have.
        width: channels at the fine level; the coarse level has twice as many.
        blocks: residual blocks per fine half, and in the bottleneck.
        foreground: extra loss weight of what differs from the median colour.
        emphasis: loss weight of each view.
        jitter: metres by which objects are misplaced in training, as the places of a rollout are.
    """

    shrink: tuple[int, ...] = (1, 2, 2)
    width: int = 32
    blocks: tuple[int, int] = (1, 3)
    foreground: float = 8.0
    emphasis: tuple[float, ...] = (1.0, 0.4, 0.4)
    jitter: float = 0.003


_FOLD = 4  # pixels folded into channels, both ways
_SOURCES = 5  # still, flow, first frame, median colour, drawn colour; and then the objects
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


def _head(width: int, chunk: int, channels: int) -> nn.Sequential:
    """Output layer of one view; it starts from "nothing moves", for random output takes hundreds of steps to unlearn."""
    last = nn.Conv2d(width, channels * chunk * _FOLD**2, 1)
    bias = torch.zeros(chunk, channels, _FOLD**2)
    bias[:, 0] = 3.0
    nn.init.zeros_(last.weight)
    last.bias = nn.Parameter(bias.flatten())
    return nn.Sequential(nn.GroupNorm(8, width), nn.SiLU(), last)


def _compose(drawn: Tensor, last: Tensor, first: Tensor, seen: InView, spots: Tensor) -> Tensor:
    """Frames of a chunk in one view.

    Args:
        drawn: [B, K, 5 + S + 2 + 3, H, W] output maps; last, first: [B, 3, H, W] frames.
        seen: the objects in this view now and at every frame, each [B, 1 + K, S]; spots: [B, K, S, H, W] maps of the latter.

    Returns:
        [B, K, 3, H, W].
    """
    _, chunk, _, height, width = drawn.shape
    objects = spots.shape[2]
    # Split, not sliced: the gradient of a slice is a full map of zeros.
    logits, carried, flow, colour = drawn.split((_SOURCES, objects, 2, 3), 2)
    # From the start an object is likely to lie where it is said to.
    chosen = torch.cat((logits, carried - 3 + 8 * spots), 2).softmax(2)
    still, moves, past, middle, fresh, *lifted = chosen.split(1, 2)
    v, u = torch.meshgrid(
        torch.linspace(-1 + 1 / height, 1 - 1 / height, height, device=drawn.device),
        torch.linspace(-1 + 1 / width, 1 - 1 / width, width, device=drawn.device),
        indexing="ij",
    )
    flow_u, flow_v = (flow * (2 * _REACH)).unbind(2)
    grids = [torch.stack((u + flow_u / width, v + flow_v / height), -1)]
    place, known = torch.stack((u, v), -1), seen.visible[:, :1] & seen.visible[:, 1:]
    for number in range(objects):
        now, then = seen.where[:, :1, number, None, None], seen.where[:, 1:, number, None, None]
        growth = (seen.span[:, 1:, number] / seen.span[:, :1, number]).clamp(0.5, 2.0)[..., None, None, None]
        grids.append(torch.where(known[:, :, number, None, None, None], now + (place - then) / growth, place))
    # All frames of a chunk are sampled from one picture: stack them as rows of one tall grid.
    grid = torch.stack(grids, 1).flatten(1, 3)
    median = first.flatten(2).median(-1).values[..., None, None]
    moved = F.grid_sample(last, grid, padding_mode="border", align_corners=False)
    moved = moved.unflatten(2, (1 + objects, chunk, height)).permute(2, 0, 3, 1, 4, 5)  # [1 + S, B, K, 3, H, W]
    out = still * last[:, None] + moves * moved[0] + past * first[:, None] + middle * median[:, None] + fresh * (0.5 + 0.5 * colour)
    for weight, picture in zip(lifted, moved[1:], strict=True):
        out = out + weight * picture
    return out


def _fold(pictures: Tensor) -> Tensor:
    """[B, C, H, W] -> [B, C * 16, H / 4, W / 4] with squares of 4x4 pixels as channels; copies bytes faster than torch's pixel_unshuffle."""
    batch, channels, height, width = pictures.shape
    squares = pictures.view(batch, channels, height // _FOLD, _FOLD, width // _FOLD, _FOLD)
    return squares.permute(0, 1, 3, 5, 2, 4).reshape(batch, channels * _FOLD**2, height // _FOLD, width // _FOLD)


def _unfold(maps: Tensor) -> Tensor:
    """The reverse of _fold; its gradient is one copy, where that of torch's pixel_shuffle is slow."""
    batch, channels, height, width = maps.shape
    squares = maps.view(batch, channels // _FOLD**2, _FOLD, _FOLD, height, width)
    return squares.permute(0, 1, 4, 2, 5, 3).reshape(batch, channels // _FOLD**2, height * _FOLD, width * _FOLD)


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
            raise ValueError(f"simulator.shrink and simulator.emphasis need one entry per view; there are {shape.views} views")
        if not set(config.shrink) <= {1, 2}:
            raise ValueError(f"simulator.shrink={list(config.shrink)} may hold 1 (full detail) and 2 (half) only")
        wide = 2 * config.width
        # Memory frames and pose maps, future pose maps, and spots of the objects now and in future.
        pictures = 3 * (2 * shape.memory + shape.chunk) + shape.objects * (1 + shape.chunk)
        self.channels = _SOURCES + shape.objects + 2 + 3
        cond = 256
        self.feature_shape = (wide + cond,)
        self.actions = nn.Sequential(nn.Linear((shape.chunk + 1) * ACTION_DIM, cond), nn.SiLU(), nn.Linear(cond, cond))
        self.embed = nn.ModuleList(nn.Conv2d(pictures * _FOLD**2, config.width if s == 1 else wide, 1) for s in config.shrink)
        self.rays = nn.Conv2d(12 * shape.views, wide, 1)
        self.down = nn.Conv2d(config.width, wide, 2, stride=2)
        self.up = nn.Conv2d(wide, config.width * 4, 1)
        self.fuse = nn.Conv2d(2 * config.width, config.width, 1)
        fine, deep = config.blocks
        self.fine_in = nn.ModuleList(_Block(config.width, cond) for _ in range(fine))
        self.deep = nn.ModuleList(_Block(wide, cond) for _ in range(deep))
        self.fine_out = nn.ModuleList(_Block(config.width, cond) for _ in range(fine))
        self.heads = nn.ModuleList(_head(config.width if s == 1 else wide, shape.chunk, self.channels) for s in config.shrink)

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator.predict; features are the pooled bottleneck beside the action embedding."""
        views, features = self.views(inputs)
        return self._enlarge(views), features

    def _enlarge(self, views: list[Tensor]) -> Tensor:
        full = [
            view if s == 1 else F.interpolate(view.flatten(0, 1), scale_factor=s, mode="bilinear", align_corners=False).unflatten(0, view.shape[:2])
            for s, view in zip(self.config.shrink, views, strict=True)
        ]
        return torch.stack(full, 2)

    def features(self, inputs: TensorDict) -> Tensor:
        """See Simulator.features; nothing is drawn."""
        _, z, cond, *_ = self._encode(inputs)
        return torch.cat([z.float().mean((-2, -1)), cond.float()], 1)

    def _encode(self, inputs: TensorDict) -> tuple[Tensor, Tensor, Tensor, list[tuple[Tensor, Tensor, Tensor]], InView]:
        """Fine and coarse maps, the action embedding, each view's first and last frame and spots [B, 1 + K, S, h, w] as it is looked at, and the objects in view."""
        memory, future = inputs["memory"], inputs["future"]
        stack = torch.cat([memory["frames"], memory["pose_map"], future["pose_map"]], 1)  # uint8 [B, 2M+K, V, 3, H, W]
        relative = to_relative(future["commands"], inputs["now", "command"]) * 10.0  # decimetres
        cond = self.actions(torch.cat([relative.flatten(1), inputs["now", "command"]], 1))
        fine: list[Tensor] = []
        deep = [self.rays(self._rays(inputs))]
        ends: list[tuple[Tensor, Tensor, Tensor]] = []
        places = torch.cat((inputs["now", "places"][:, None], inputs["future", "places"]), 1)
        cameras = torch.cat((memory["c2w"][:, -1:], future["c2w"]), 1)
        seen = in_view(places, inputs["intrinsic"], cameras, self.shape.size)
        for view, (shrink, embed) in enumerate(zip(self.config.shrink, self.embed, strict=True)):
            pictures = stack[:, :, view].flatten(1, 2).float().div_(255.0)
            if shrink > 1:
                pictures = F.avg_pool2d(pictures, shrink)
            latest = 3 * (self.shape.memory - 1)
            spots = place_map(InView(*(value[:, view : view + 1] for value in seen)), *pictures.shape[-2:])[:, 0]
            ends.append((pictures[:, :3], pictures[:, latest : latest + 3], spots))
            folded = _fold(torch.cat((pictures * 2 - 1, spots.flatten(1, 2)), 1)).contiguous(memory_format=torch.channels_last)
            (fine if shrink == 1 else deep).append(embed(folded))
        x = torch.stack(fine).sum(0)
        for block in self.fine_in:
            x = block(x, cond)
        z = self.down(x) + torch.stack(deep).sum(0)
        for block in self.deep:
            z = block(z, cond)
        return x, z, cond, ends, seen

    def views(self, inputs: TensorDict) -> tuple[list[Tensor], Tensor]:
        """Frames of each view [B, K, 3, H / shrink, W / shrink], not yet enlarged, and the features."""
        x, z, cond, ends, seen = self._encode(inputs)
        x = self.fuse(torch.cat([x, F.pixel_shuffle(self.up(z), 2)], 1))
        for block in self.fine_out:
            x = block(x, cond)
        views: list[Tensor] = []
        for view, (shrink, head, (first, last, spots)) in enumerate(zip(self.config.shrink, self.heads, ends, strict=True)):
            drawn = _unfold(head(x if shrink == 1 else z).float().contiguous()).unflatten(1, (self.shape.chunk, self.channels))
            views.append(_compose(drawn, last, first, InView(*(value[:, view] for value in seen)), spots[:, 1:]))
        return views, torch.cat([z.float().mean((-2, -1)), cond.float()], 1)

    def _rays(self, inputs: TensorDict) -> Tensor:
        """Ray maps [B, V * 12, h, w] of the last remembered and the last future frame at the bottleneck's resolution."""
        c2w = torch.stack([inputs["memory", "c2w"][:, -1], inputs["future", "c2w"][:, -1]], 2)  # [B, V, 2, 4, 4]
        rays = render_ray_map(inputs["intrinsic"], c2w, self.shape.size, stride=2 * _FOLD)
        return rays.flatten(1, 3)

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Weighted error over all chunks of the clip, each predicted from the model's own earlier chunks.

        Gradients stay within a chunk; predictions are rounded to bytes in between, as they are in rollouts.
        """
        chunk, chunks = self.shape.chunk, clip["memory", "index"].shape[1]
        misplaced = self.config.jitter * torch.randn((*clip.shape, 1, 1, 3), generator=generator).to(clip.device)
        drawn: Tensor | None = None
        losses = []
        for number in range(chunks):
            part = slice(number * chunk, (number + 1) * chunk)
            inputs = self.asked(clip, number, drawn)
            inputs["now", "places"] = inputs["now", "places"] + misplaced[:, 0]
            inputs["future", "places"] = inputs["future", "places"] + misplaced
            views, _ = self.views(inputs)
            valid = clip["future", "valid"][:, part, None, None, None]
            error, norm = torch.zeros(()), torch.zeros(())
            for view, (frames, shrink, emphasis) in enumerate(zip(views, self.config.shrink, self.config.emphasis, strict=True)):
                truth = clip["future", "frames"][:, part, view].float() / 255
                if shrink > 1:
                    truth = F.avg_pool2d(truth.flatten(0, 1), shrink).unflatten(0, truth.shape[:2])
                weight = foreground_weight(truth, self.config.foreground) * valid * emphasis
                # An absolute error alone never leaves "nothing moves", the median of sparse change; squares do.
                gap = frames - truth
                error = error + ((gap.abs() + 50 * gap.square()) * weight).sum()
                norm = norm + 3 * weight.sum()
            losses.append(error / norm.clamp(min=1))
            if number + 1 < chunks:
                with torch.no_grad():
                    pictures = (self._enlarge(views).clamp(0, 1) * 255).round().to(torch.uint8)
                drawn = pictures if drawn is None else torch.cat([drawn, pictures], 1)
        return torch.stack(losses).mean(), {"first_chunk": losses[0].detach(), "last_chunk": losses[-1].detach()}
