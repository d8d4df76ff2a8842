"""The strong cheap engine: a U-Net that predicts a whole chunk in one deterministic pass.

Each view is folded by its own stride (the head keeps more detail), memory and future pose maps ride along as
channels, commands modulate every block, and the output is added to the last remembered frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.conditioning import render_ray_map
from envs.schema import ACTION_DIM, to_relative
from envs.simulators.base import Simulator, WorldShape, foreground_weight


@dataclass(frozen=True)
class UNetConfig:
    """Size of the U-Net.

    Args:
        strides: fold of each view; views of the finest stride are refined at that resolution, the others come from the bottleneck.
        width: channels at the fine level; the coarse level has twice as many.
        blocks: residual blocks per fine half, and in the bottleneck.
        foreground: extra loss weight of what differs from the median colour.
    """

    strides: tuple[int, ...] = (4, 8, 8)
    width: int = 96
    blocks: tuple[int, int] = (2, 4)
    foreground: float = 8.0


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


class UNetSimulator(Simulator):
    """One-pass deterministic video predictor over all views; see UNetConfig.

    Args:
        shape: what it shows.
        config: its size.
    """

    def __init__(self, shape: WorldShape, config: UNetConfig | None = None):
        super().__init__(shape)
        self.config = config = config or UNetConfig()
        if len(config.strides) != shape.views:
            raise ValueError(f"simulator.strides has {len(config.strides)} entries for {shape.views} views; give one per view")
        self.fine, self.coarse = min(config.strides), 2 * min(config.strides)
        wide = 2 * config.width
        pictures = 3 * (2 * shape.memory + shape.chunk)  # memory frames and pose maps, future pose maps
        cond = 256
        self.feature_shape = (wide + cond,)
        self.actions = nn.Sequential(nn.Linear((shape.chunk + 1) * ACTION_DIM, cond), nn.SiLU(), nn.Linear(cond, cond))
        self.embed = nn.ModuleList(nn.Conv2d(pictures * s * s, config.width if s == self.fine else wide, 1) for s in config.strides)
        self.rays = nn.Conv2d(12 * shape.views, wide, 1)
        self.down = nn.Conv2d(config.width, wide, 2, stride=2)
        self.up = nn.Conv2d(wide, config.width * 4, 1)
        self.fuse = nn.Conv2d(2 * config.width, config.width, 1)
        fine, deep = config.blocks
        self.fine_in = nn.ModuleList(_Block(config.width, cond) for _ in range(fine))
        self.deep = nn.ModuleList(_Block(wide, cond) for _ in range(deep))
        self.fine_out = nn.ModuleList(_Block(config.width, cond) for _ in range(fine))
        self.heads = nn.ModuleList(
            nn.Sequential(nn.GroupNorm(8, w), nn.SiLU(), nn.Conv2d(w, 3 * shape.chunk * s * s, 1))
            for s, w in ((s, config.width if s == self.fine else wide) for s in config.strides)
        )
        for head in self.heads:  # start from "nothing moves"; random output takes hundreds of steps to unlearn
            nn.init.zeros_(head[-1].weight)
            nn.init.zeros_(head[-1].bias)

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator.predict; features are the pooled bottleneck beside the action embedding."""
        memory, future = inputs["memory"], inputs["future"]
        batch, chunk = inputs.shape[0], self.shape.chunk
        last = memory["frames"][:, -1].float() / 255
        stack = torch.cat([memory["frames"], memory["pose_map"], future["pose_map"]], 1)  # uint8 [B, 2M+K, V, 3, H, W]
        relative = to_relative(future["commands"], inputs["now", "command"]) * 10.0  # decimetres
        cond = self.actions(torch.cat([relative.flatten(1), inputs["now", "command"]], 1))
        fine: list[Tensor] = []
        deep = [self.rays(self._rays(inputs))]
        for view, (stride, embed) in enumerate(zip(self.config.strides, self.embed, strict=True)):
            pictures = stack[:, :, view].flatten(1, 2).float().div_(127.5).sub_(1.0)
            folded = F.pixel_unshuffle(pictures, stride).contiguous(memory_format=torch.channels_last)
            (fine if stride == self.fine else deep).append(embed(folded))
        x = torch.stack(fine).sum(0)
        for block in self.fine_in:
            x = block(x, cond)
        z = self.down(x) + torch.stack(deep).sum(0)
        for block in self.deep:
            z = block(z, cond)
        x = self.fuse(torch.cat([x, F.pixel_shuffle(self.up(z), 2)], 1))
        for block in self.fine_out:
            x = block(x, cond)
        views = []
        for view, (stride, head) in enumerate(zip(self.config.strides, self.heads, strict=True)):
            change = F.pixel_shuffle(head(x if stride == self.fine else z), stride).float()
            views.append(last[:, None, view] + change.unflatten(1, (chunk, 3)))
        features = torch.cat([z.float().mean((-2, -1)), cond.float()], 1)
        return torch.stack(views, 2), features

    def _rays(self, inputs: TensorDict) -> Tensor:
        """Ray maps [B, V * 12, h, w] of the last remembered and the last future frame at the bottleneck's resolution."""
        c2w = torch.stack([inputs["memory", "c2w"][:, -1], inputs["future", "c2w"][:, -1]], 2)  # [B, V, 2, 4, 4]
        rays = render_ray_map(inputs["intrinsic"], c2w, self.shape.size, stride=self.coarse)
        return rays.flatten(1, 3)

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Weighted error over all chunks of the clip, each predicted from the model's own earlier chunks.

        Gradients stay within a chunk; predictions are rounded to bytes in between, as they are in rollouts.
        """
        chunk, chunks = self.shape.chunk, clip["memory", "index"].shape[1]
        rows = torch.arange(clip.shape[0], device=clip.device)
        drawn: Tensor | None = None
        losses = []
        command, state = clip["now", "command"], clip["now", "state"]
        for number in range(chunks):
            part = slice(number * chunk, (number + 1) * chunk)
            memory = TensorDict({k: clip["memory", k][:, number] for k in ("frames", "pose_map", "c2w")}, clip.shape)
            if drawn is not None:
                ahead = clip["memory", "index"][:, number] - clip["begin"][:, None] - 1
                own = ahead >= 0
                imagined = drawn[rows[:, None], ahead.clamp(min=0)]
                memory["frames"] = torch.where(own[..., None, None, None, None], imagined, memory["frames"])
            future = TensorDict({k: clip["future", k][:, part] for k in ("pose_map", "c2w", "commands")}, clip.shape)
            now = TensorDict({"command": command, "state": state}, clip.shape)
            inputs = TensorDict({"memory": memory, "future": future, "now": now, "intrinsic": clip["intrinsic"]}, clip.shape)
            frames, _ = self.predict(inputs)
            truth = clip["future", "frames"][:, part].float() / 255
            weight = foreground_weight(truth, self.config.foreground)
            weight = weight * clip["future", "valid"][:, part, None, None, None, None]
            # An absolute error alone never leaves "nothing moves", the median of sparse change; squares do.
            gap = frames - truth
            error = gap.abs() + 50 * gap.square()
            losses.append((error * weight).sum() / weight.sum().clamp(min=1) / 3)
            pictures = (frames.detach().clamp(0, 1) * 255).round().to(torch.uint8)
            drawn = pictures if drawn is None else torch.cat([drawn, pictures], 1)
            command = clip["future", "commands"][:, part.stop - 1]
        total = torch.stack(losses).mean()
        return total, {"vision/first": losses[0].detach(), "vision/last": losses[-1].detach()}
