"""The transformer of diffusion forcing: attention within a frame over all cameras by turns with causal
attention over time, every frame modulated by its own noise level and action (WPE; Oasis).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from envs.ranges import Count, Natural, Positive
from envs.simulators.dit.layers import Attention, FeedForward, TimestepMLP, rotate, sinusoid
from envs.simulators.dit.network import Stem
from envs.simulators.row_linear import RowLinear

_TIME_SCALE, _WAVES = 1000.0, 256  # levels are multiplied with, and embedded in so many numbers
_ROWS = 16  # see row_linear.py

Known = tuple[Tensor, Tensor]  # keys and values [B * N, heads, T, head_dim] of earlier frames


@dataclass(frozen=True)
class Trunk:
    """Sizes of the transformer.

    Args:
        layers: pairs of a block over space and a block over time.
        heads, head_dim: of attention; their product is the width.
        mlp_ratio: hidden units of feed-forward layers by the width.
        patch: latent rows and columns per token.
        stem: channels of the convolutional stem; 0 is without.
        checkpointing: compute blocks anew in the backward pass instead of keeping what they computed.

    Raises:
        ValueError: if rotary positions of rows and columns do not fit in a head.
    """

    layers: Count
    heads: Count
    head_dim: Count
    mlp_ratio: Positive
    patch: Count
    stem: Natural
    checkpointing: bool

    def __post_init__(self) -> None:
        if self.head_dim % 4:
            raise ValueError(f"net.head_dim={self.head_dim} must be a multiple of 4")

    @property
    def width(self) -> int:
        """Channels of a token."""
        return self.heads * self.head_dim


class Block(nn.Module):
    """Attention and feed-forward, modulated frame by frame; the gates begin at zero (adaLN-Zero, Peebles &
    Xie 2023). A subclass says which tokens attend to which.
    """

    def __init__(self, net: Trunk):
        super().__init__()
        self.width = net.width
        self.modulation = RowLinear(net.width, 6 * net.width)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)
        self.attn = Attention(net.width, net.heads, net.head_dim)
        self.ff = FeedForward(net.width, net.mlp_ratio, bias=True, approximate="tanh")

    def forward(
        self, x: Tensor, condition: Tensor, rope: tuple[Tensor, Tensor], known: Known | None
    ) -> tuple[Tensor, Known | None]:
        """Tokens [B, T, N, width] under conditions [B * T, width]; returns what later frames need to know."""
        parts = self.modulation(F.silu(condition)).unflatten(0, x.shape[:2])[:, :, None].chunk(6, -1)
        h, kept = self._attend(self._normed(x, parts[0], parts[1]), rope, known)
        x = torch.addcmul(x, parts[2], h)
        return torch.addcmul(x, parts[5], self.ff(self._normed(x, parts[3], parts[4]))), kept

    def _normed(self, x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
        return torch.addcmul(shift, F.layer_norm(x, (self.width,), eps=1e-6), 1 + scale)

    def _attend(
        self, x: Tensor, rope: tuple[Tensor, Tensor], known: Known | None
    ) -> tuple[Tensor, Known | None]:
        raise NotImplementedError


class SpaceBlock(Block):
    """Attention within a frame, over all its cameras."""

    def _attend(
        self, x: Tensor, rope: tuple[Tensor, Tensor], known: Known | None
    ) -> tuple[Tensor, Known | None]:
        return self.attn(x.flatten(0, 1), rope=rope).unflatten(0, x.shape[:2]), None


class TimeBlock(Block):
    """Attention of each place to itself in this and earlier frames."""

    def _attend(
        self, x: Tensor, rope: tuple[Tensor, Tensor], known: Known | None
    ) -> tuple[Tensor, Known | None]:
        rows, attn = x.transpose(1, 2).flatten(0, 1), self.attn
        k, v = attn.keys_of(rows)
        q, k = rotate(attn.queries_of(rows), rope), rotate(k, rope)
        if known is not None:
            k, v = torch.cat([known[0], k], 2), torch.cat([known[1], v], 2)
        now, total = q.shape[2], k.shape[2]
        seen = torch.ones(now, total, dtype=torch.bool, device=x.device).tril(total - now)
        out = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v, attn_mask=seen)
        out = attn.to_out[0](out.transpose(1, 2).flatten(2))
        return out.unflatten(0, (len(x), -1)).transpose(1, 2), (k, v)


class ForcingDiT(nn.Module):
    """The network; see the module's docstring.

    Args:
        net: sizes.
        channels: of latents and of all that stands beside them.
        out_channels: of latents.
        views: cameras.
        action_size: numbers of an action vector.
    """

    def __init__(self, net: Trunk, channels: int, out_channels: int, views: int, action_size: int):
        super().__init__()
        self.net, width = net, net.width
        self.stem = Stem(channels, net.stem) if net.stem else nn.Identity()
        self.embed = nn.Linear((channels + net.stem) * net.patch**2, width)
        self.views = nn.Parameter(torch.randn(views, 1, width) * 0.02)
        self.level = TimestepMLP(_WAVES, width, width, bias=True)
        self.action = RowLinear(action_size, width)
        kinds = (SpaceBlock, TimeBlock) * net.layers
        self.blocks = nn.ModuleList(kind(net) for kind in kinds)
        self.last = RowLinear(width, 2 * width)
        self.out = nn.Linear(width, out_channels * net.patch**2)
        for layer in (self.last, self.out):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(
        self, z: Tensor, level: Tensor, actions: Tensor, known: Sequence[Known] | None = None
    ) -> tuple[Tensor, Tensor, list[Known]]:
        """One pass over consecutive frames.

        Args:
            z: [B, T, V, C, h, w] noisy latents and what stands beside them.
            level: [B, T] noise level of each frame.
            actions: [B, T, action_size].
            known: what earlier frames left (the third value returned), so that they need not be read again.

        Returns:
            output [B, T, V, C_out, h, w]; features [B, T, V, width], means over a view's tokens; and keys and
            values of all frames so far for each block over time.
        """
        first = 0 if known is None else known[0][0].shape[2]
        x, grid = self._tokens(z)
        condition = self._conditions(level, actions)
        across, along = self._positions(grid, z.shape[2], first, z.shape[1], z.device)
        kept: list[Known] = []
        for number, block in enumerate(self.blocks):
            over_time = number % 2 == 1
            past = known[len(kept)] if over_time and known is not None else None
            arguments = (x, condition, along if over_time else across, past)
            if self.net.checkpointing and torch.is_grad_enabled():
                x, keys = checkpoint(block, *arguments, use_reentrant=False)
            else:
                x, keys = block(*arguments)
            if over_time:
                kept.append(cast(Known, keys))
        shift, scale = self.last(F.silu(condition)).unflatten(0, x.shape[:2])[:, :, None].chunk(2, -1)
        normed = F.layer_norm(x, (self.net.width,), eps=1e-6)
        features = normed.unflatten(2, (z.shape[2], -1)).mean(3)
        patches = self.out(torch.addcmul(shift, normed, 1 + scale))
        return self._pictures(patches, z.shape[2], grid), features.float(), kept

    def _tokens(self, z: Tensor) -> tuple[Tensor, tuple[int, int]]:
        """Tokens [B, T, V * N, width] and their rows and columns in a view."""
        patch, lead = self.net.patch, z.shape[:3]
        wide = self.stem(z.flatten(1, 2).transpose(1, 2)).transpose(1, 2).unflatten(1, lead[1:])
        grid = (z.shape[-2] // patch, z.shape[-1] // patch)
        parts = wide.unflatten(-1, (grid[1], patch)).unflatten(-3, (grid[0], patch))
        flat = parts.permute(0, 1, 2, 4, 6, 3, 5, 7).flatten(5).flatten(3, 4)  # [B, T, V, N, C * patch^2]
        return (self.embed(flat) + self.views).flatten(2, 3), grid

    def _pictures(self, patches: Tensor, views: int, grid: tuple[int, int]) -> Tensor:
        patch = self.net.patch
        parts = patches.unflatten(-1, (-1, patch, patch)).unflatten(2, (views, *grid))
        return parts.permute(0, 1, 2, 5, 3, 6, 4, 7).flatten(6, 7).flatten(4, 5).float()

    def _conditions(self, level: Tensor, actions: Tensor) -> Tensor:
        """[B * T, width]; rows are padded so that none depends on the slot it is in (row_linear.py)."""
        rows = F.pad(level.flatten(), (0, -level.numel() % _ROWS))
        waves = sinusoid(_TIME_SCALE * rows, _WAVES).to(self.action.weight.dtype)
        return self.level(waves)[: level.numel()] + self.action(actions.flatten(0, 1))

    def _positions(
        self, grid: tuple[int, int], views: int, first: int, count: int, device: torch.device
    ) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Rotary positions of the tokens of a frame, and of frames; see `rotary`."""
        rows, columns = torch.meshgrid(*(torch.arange(n, device=device) for n in grid), indexing="ij")
        places = torch.stack([rows.flatten(), columns.flatten()], -1).repeat(views, 1)
        times = first + torch.arange(count, device=device)[:, None]
        return rotary(places, self.net.head_dim), rotary(times, self.net.head_dim)


def rotary(positions: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Cosines and sines [L, size] of rotary positions [L, axes], which share the channels of a head."""
    axes = positions.shape[1]
    part = size // (2 * axes)
    rates = 100.0 ** -(torch.arange(part, device=positions.device) / part)
    angles = (positions[..., None].float() * rates).flatten(1).repeat(1, 2)
    return angles.cos(), angles.sin()
