"""The strong cheap engine: a U-Net that predicts a whole chunk of all views in one deterministic pass.

Each view is folded into channels (all but the main one at half the detail); memory frames, and pose maps
where there are any, ride along as channels, and actions modulate every block. A pixel of the output is one of
its sources (compose.py): a remembered frame as it is, the last one moved by a predicted flow (warp, mask and
residual, as in Finn et al. 2016), or a drawn colour; half the detail is the choice's, and not that of what is
remembered. What moves is then copied instead of repainted, which is learned far faster than a residual.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.conditioning import render_ray_map
from envs.precision import working_dtype
from envs.ranges import Count, Natural, NonNegative
from envs.simulators.base import Simulator
from envs.simulators.inputs import build_inputs
from envs.simulators.unet.blocks import (
    ActionEncoder,
    Embed,
    FilmBlock,
    at_detail,
    flow_head,
    output_head,
)
from envs.simulators.unet.compose import DRAWN, Sources, changed, choose, compose, enlarge, surprise
from envs.simulators.unet.folding import unfold
from envs.specs import WorldSpec

_COND = 256  # numbers of the action embedding


class UNetSimulator(Simulator):
    """One-pass deterministic video predictor over all views.

    Args:
        spec: what it shows; sizes must be multiples of 8 * fold.
        memory_frames: memory frames, M.
        newest_frames: of them, those that are the newest (see Simulator); two or more tell speeds.
        fold: pixels of the main view, each way, that lie in one place of the finest level, 2 or 4. Four cost
            little more than two of a picture half as large, and see twice as finely.
        width: channels of the finest level, a multiple of 8; twice as many of the middle one, at half its
            resolution, and again of the deep one, at a quarter.
        blocks: residual blocks of these levels, of the first two on the way down, and on the way up.
        motion: extra loss weight of pixels that change, or look unusual for their place.
        side_weight: loss weight of every view but the main one.
    """

    mean: Tensor
    spread: Tensor
    hidden = ("embed", "conv1", "conv2", "down", "flows")  # slow for what is wide, worse for heads

    def __init__(
        self,
        spec: WorldSpec,
        memory_frames: Count,
        newest_frames: Count,
        fold: Count,
        width: Count,
        blocks: tuple[Natural, Natural, Natural],
        motion: NonNegative,
        side_weight: NonNegative,
    ):
        super().__init__(spec, memory_frames, newest_frames)
        if newest_frames > memory_frames:
            raise ValueError(
                f"simulator.newest_frames={newest_frames} is more than"
                f" simulator.memory_frames={memory_frames}"
            )
        if fold not in (2, 4):
            raise ValueError(f"simulator.fold={fold} must be 2 or 4")
        if any(side % (8 * fold) for side in spec.size):
            raise ValueError(
                f"task.size={list(spec.size)} must be multiples of {8 * fold} for simulator.fold={fold}"
            )
        main = spec.embodiment.main_view
        self.motion = motion
        self.shrink = tuple(1 if view == main else 2 for view in range(spec.views))
        self.emphasis = tuple(1.0 if view == main else side_weight for view in range(spec.views))
        self.edges = tuple(fold * s for s in self.shrink)  # of the squares that a place of each view says
        self.deep_edge = 4 * fold
        half, wide = 2 * width, 4 * width
        cells = (spec.size[0] // self.deep_edge, spec.size[1] // self.deep_edge)
        self.feature_shape = (wide + _COND,)
        self.actions = ActionEncoder(spec, _COND, wide, cells)
        pictures = 3 * (memory_frames + (memory_frames + spec.chunk if spec.pose_map else 0))
        self.embed = nn.ModuleList(
            Embed(pictures, width if s == 1 else wide, s, edge)
            for s, edge in zip(self.shrink, self.edges, strict=True)
        )
        self.where = nn.Parameter(0.02 * torch.randn(1, half, 2 * cells[0], 2 * cells[1]))
        self.rays = nn.Conv2d(12 * spec.views, wide, 1) if spec.ray_map else None
        self.down = nn.ModuleList((nn.Conv2d(width, half, 2, stride=2), nn.Conv2d(half, wide, 2, stride=2)))
        self.up = nn.ModuleList((nn.Conv2d(half, width * 4, 1), nn.Conv2d(wide, half * 4, 1)))
        self.fuse = nn.ModuleList((nn.Conv2d(2 * width, width, 1), nn.Conv2d(2 * half, half, 1)))
        self.fine_in = nn.ModuleList(FilmBlock(width, _COND) for _ in range(blocks[0]))
        self.mid_in = nn.ModuleList(FilmBlock(half, _COND) for _ in range(blocks[1]))
        self.deep = nn.ModuleList(FilmBlock(wide, _COND) for _ in range(blocks[2]))
        self.mid_out = nn.ModuleList(FilmBlock(half, _COND) for _ in range(blocks[1]))
        self.fine_out = nn.ModuleList(FilmBlock(width, _COND) for _ in range(blocks[0]))
        self.maps = memory_frames + 1 + DRAWN  # logits of the sources, and drawn colour
        self.heads = nn.ModuleList(
            output_head(width if s == 1 else wide, spec.chunk, self.maps, memory_frames, edge)
            for s, edge in zip(self.shrink, self.edges, strict=True)
        )
        self.flows = nn.ModuleList(flow_head(half if s == 1 else wide, spec.chunk) for s in self.shrink)
        self.register_buffer("mean", torch.zeros(spec.views, 3, *spec.size))
        self.register_buffer("spread", torch.ones(spec.views, 3, *spec.size))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def normalise(self, commands: Tensor, moves: Tensor, states: Tensor) -> None:
        """See Simulator.normalise."""
        self.actions.normalise(commands, moves, states)

    def fit_camera_statistics(self, frames: Tensor) -> None:
        """See Simulator.fit_camera_statistics."""
        spread, mean = torch.std_mean(frames.to(self.mean.device).float() / 255, 0, correction=0)
        self.mean.copy_(mean)
        self.spread.copy_(spread)

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator.predict; features are the pooled bottleneck beside the action embedding."""
        views, features = self.views(inputs)
        return self._frames(views, inputs["memory", "frames"]).round().to(torch.uint8), features

    def features(self, inputs: TensorDict) -> Tensor:
        """See Simulator.features; nothing is drawn."""
        *_, deep, cond = self._encode(inputs)
        return torch.cat([deep.float().mean((-2, -1)), cond.float()], 1)

    def _frames(self, views: list[Sources], memory: Tensor) -> Tensor:
        """Frames float [B, K, V, 3, H, W] of all views at full size, whole numbers in 0..255, of the sources
        of each view and the remembered frames, bytes [B, M, V, 3, H, W]; gradients pass the rounding.
        """
        full = []
        for number, (shrink, sources) in enumerate(zip(self.shrink, views, strict=True)):
            view, chosen = choose(sources)
            if shrink > 1:
                view = enlarge(view, chosen, sources.flow, memory[:, :, number])
            exact = view.clamp(0, 1) * 255
            full.append(exact + (exact.round() - exact).detach())
        return torch.stack(full, 2)

    def _encode(self, inputs: TensorDict) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Maps at a half, a quarter and an eighth of the resolution, and the action embedding."""
        memory, future, now = inputs["memory"], inputs["future"], inputs["now"]
        cond, action_map = self.actions(future["commands"], now["command"], now["state"], inputs["stride"])
        parts = [memory["frames"], *([memory["pose_map"], future["pose_map"]] if self.spec.pose_map else [])]
        deep = [action_map]
        if self.rays is not None:
            deep.append(self.rays(self._rays(inputs)))
        for view, (shrink, embed) in enumerate(zip(self.shrink, self.embed, strict=True)):
            seen = embed([part[:, :, view].flatten(1, 2) for part in parts])
            if shrink == 1:
                x = seen.contiguous(memory_format=torch.channels_last)
            else:
                deep.append(seen)
        for block in self.fine_in:
            x = block(x, cond)
        y = (self.down[0](x) + self.where).contiguous(memory_format=torch.channels_last)
        for block in self.mid_in:
            y = block(y, cond)
        z = (self.down[1](y) + torch.stack(deep).sum(0)).contiguous(memory_format=torch.channels_last)
        for block in self.deep:
            z = block(z, cond)
        return x, y, z, cond

    def views(self, inputs: TensorDict) -> tuple[list[Sources], Tensor]:
        """The sources of each view, at the size it is predicted in, and the features."""
        x, y, z, cond = self._encode(inputs)
        y = self.fuse[1](torch.cat([y, F.pixel_shuffle(self.up[1](z), 2)], 1))
        for block in self.mid_out:
            y = block(y, cond)
        x = self.fuse[0](torch.cat([x, F.pixel_shuffle(self.up[0](y), 2)], 1))
        for block in self.fine_out:
            x = block(x, cond)
        views: list[Sources] = []
        chunk, frames = self.spec.chunk, inputs["memory", "frames"]
        for view, (shrink, edge, head, flow) in enumerate(
            zip(self.shrink, self.edges, self.heads, self.flows, strict=True)
        ):
            head_input, flow_input = (x, y) if shrink == 1 else (z, z)
            drawn = unfold(head(head_input).permute(0, 2, 3, 1).float(), edge).unflatten(
                1, (chunk, self.maps)
            )
            moves = F.interpolate(flow(flow_input).float(), scale_factor=self.deep_edge // 2, mode="bilinear")
            moves = moves.unflatten(1, (chunk, 2))
            known = at_detail(frames[:, :, view].flatten(0, 1), shrink).unflatten(0, frames.shape[:2])
            views.append(compose(drawn, moves, known))
        return views, torch.cat([z.float().mean((-2, -1)), cond.float()], 1)

    def _rays(self, inputs: TensorDict) -> Tensor:
        """Ray maps [B, V * 12, h, w] of the last remembered and the last future frame, at the bottleneck's
        size.
        """
        # [B, V, 2, 4, 4]
        c2w = torch.stack([inputs["memory", "c2w"][:, -1], inputs["future", "c2w"][:, -1]], 2)
        rays = render_ray_map(inputs["intrinsic"], c2w, self.spec.size, stride=self.deep_edge)
        return rays.flatten(1, 3).to(working_dtype(rays.device, rays.dtype))

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Weighted error over all chunks of the clip, each predicted from the model's own earlier chunks.

        Predictions are rounded to bytes in between, as they are in rollouts. Gradients pass through them: a
        chunk is also taught to leave what the next ones need, or things fade away that matter only later.
        """
        chunk, chunks = self.spec.chunk, clip["memory", "index"].shape[1]
        drawn: Tensor | None = None
        losses = []
        for number in range(chunks):
            part = slice(number * chunk, (number + 1) * chunk)
            inputs = build_inputs(self.spec, clip, number, drawn)
            views, _ = self.views(inputs)
            truth, valid = clip["future", "frames"][:, part], clip["future", "valid"][:, part]
            losses.append(self._error(views, truth, clip["memory", "frames"][:, number, -1], valid))
            if number + 1 < chunks:
                pictures = self._frames(views, inputs["memory", "frames"])
                drawn = pictures if drawn is None else torch.cat([drawn, pictures], 1)
        return torch.stack(losses).mean(), {
            "first_chunk": losses[0].detach(),
            "last_chunk": losses[-1].detach(),
        }

    def _error(self, views: list[Sources], truth: Tensor, last: Tensor, valid: Tensor) -> Tensor:
        """Mean weighted surprise at a chunk's true views, per channel.

        Args:
            truth: uint8 [B, K, V, 3, H, W]; last: uint8 [B, V, 3, H, W], the frame before; valid: [B, K].
        """
        error, norm = torch.zeros((), device=truth.device), torch.zeros((), device=truth.device)
        for view, (sources, shrink, emphasis) in enumerate(
            zip(views, self.shrink, self.emphasis, strict=True)
        ):
            wanted = at_detail(truth[:, :, view].flatten(0, 1), shrink).unflatten(0, truth.shape[:2])
            moved = changed(wanted, at_detail(last[:, view], shrink))
            weight = 1 + self.motion * torch.maximum(moved, self._unusual(wanted, view))
            weight = weight * valid[:, :, None, None, None] * emphasis
            error = error + (surprise(sources, wanted) * weight).sum()
            norm = norm + 3 * weight.sum()
        return error / norm.clamp(min=1)

    def _unusual(self, frames: Tensor, view: int) -> Tensor:
        """How unusual pixels of frames [B, K, 3, h, w] look for their place, 0..1, [B, K, 1, h, w].

        Small things are so more than large ones, and a blurred small thing costs little else.
        """
        shrink = self.shrink[view]
        mean, spread = (F.avg_pool2d(value[view], shrink) for value in (self.mean, self.spread))
        odd = ((frames - mean).abs() / (spread + 0.03)).amax(2, keepdim=True)
        return ((odd - 1.5) / 3).clamp(0, 1)
