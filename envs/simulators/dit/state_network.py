"""The state expert's network of GE-Sim 2.0: tokens of commands and states, denoised along the trunk's
features.

Parameter names are those of the public checkpoint, in which both networks share one file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.simulators.dit.layers import Attention, FeedForward, TimestepMLP, rms, sinusoid
from envs.simulators.dit.shape import DiTShape

_ROPE_LENGTH = 57.0


class _StateTime(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.emb = nn.ModuleDict({"timestep_embedder": TimestepMLP(256, width, width, bias=True)})
        self.linear = nn.Linear(width, 6 * width)

    def forward(self, timestep: Tensor) -> tuple[Tensor, Tensor]:
        embedded = self.emb["timestep_embedder"](sinusoid(timestep, 256).to(self.linear.weight.dtype))
        return self.linear(F.silu(embedded)), embedded


class StateBlock(nn.Module):
    """Self-attention over time, attention to the trunk's features, feed-forward."""

    def __init__(self, width: int, heads: int, size: int, context: int):
        super().__init__()
        self.attn1 = Attention(width, heads, size, bias=True)
        self.attn2 = Attention(width, heads, size, context, bias=True)
        self.ff = FeedForward(width, 4.0, bias=True, approximate="tanh")
        self.scale_shift_table = nn.Parameter(torch.randn(6, width) / width**0.5)

    def feature_keys(self, context: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values of features [B, L, width]."""
        return self.attn2.keys_of(context)

    def forward(
        self, x: Tensor, context: tuple[Tensor, Tensor], temb: Tensor, rope: tuple[Tensor, Tensor]
    ) -> Tensor:
        """Tokens [B, N, width], and keys and values of the features."""
        shift1, scale1, gate1, shift2, scale2, gate2 = (
            self.scale_shift_table + temb.unflatten(-1, (6, -1))
        ).unbind(-2)
        x = x + gate1 * self.attn1(rms(x) * (1 + scale1) + shift1, rope=rope)
        x = x + self.attn2(x, known=context)
        return x + gate2 * self.ff(rms(x) * (1 + scale2) + shift2)


class StateDiT(nn.Module):
    """The state expert's network, and the mix of the trunk's blocks that it reads.

    Args:
        shape: sizes of both networks.
    """

    def __init__(self, shape: DiTShape):
        super().__init__()
        self.shape = shape
        heads, size = shape.pose_num_attention_heads, shape.pose_attention_head_dim
        width, tokens = heads * size, shape.pose_in_channels
        self.video_buffer_weights = nn.Parameter(torch.ones(shape.num_layers))
        self.video_buffer_norm = nn.LayerNorm(shape.width, eps=1e-6)
        self.pose_proj_in = nn.Linear(tokens, width)
        self.pose_time_embed = _StateTime(width)
        self.pose_blocks = nn.ModuleList(
            StateBlock(width, heads, size, shape.width) for _ in range(shape.pose_layers or shape.num_layers)
        )
        self.pose_scale_shift_table = nn.Parameter(torch.randn(2, width) / width**0.5)
        self.pose_proj_out = nn.Linear(width, shape.pose_out_channels or tokens)

    def fuse(self, layers: Sequence[Tensor]) -> Tensor:
        """Features [..., width] from the outputs of all blocks of the trunk, each [..., width]."""
        return self.video_buffer_norm(
            sum(weight * x for weight, x in zip(self.video_buffer_weights, layers, strict=True))
        )

    def feature_keys(self, features: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Keys and values of features [B, V, L, width] for every block, the same at all steps."""
        context = features.flatten(1, 2)
        return [cast(StateBlock, block).feature_keys(context) for block in self.pose_blocks]

    def forward(
        self,
        states: Tensor,
        timestep: Tensor,
        keys: Sequence[tuple[Tensor, Tensor]],
        mask: Tensor | None = None,
    ) -> Tensor:
        """One denoising step of the states.

        Args:
            states: [B, N, pose_in_channels] history and future tokens.
            timestep: [B, N] noise level of each.
            keys: of the features, from `feature_keys`.
            mask: [B, N, pose_in_channels] of the numbers that the robot has, 1, and has not, 0; the latter
                are neither seen nor moved.

        Returns:
            velocity [B, N, numbers of a state].
        """
        batch, count = states.shape[:2]
        x = self.pose_proj_in(states if mask is None else states * mask)
        temb, embedded = (
            part.unflatten(0, (batch, count)) for part in self.pose_time_embed(timestep.reshape(-1))
        )
        rope = _rope(count, self.shape.pose_attention_head_dim, states.device)
        for block, context in zip(self.pose_blocks, keys, strict=True):
            x = block(x, context, temb, rope)
        shift, scale = (self.pose_scale_shift_table + embedded[:, :, None]).unbind(2)
        x = F.layer_norm(x, (x.shape[-1],), eps=1e-6) * (1 + scale) + shift
        out = self.pose_proj_out(x)
        return out if mask is None else out * mask


def _rope(count: int, size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Cosines and sines [count, size] of one-axis rotary positions over a base length of 57 tokens.

    Angles are laid out for neighbouring channels, while `rotate` pairs halves; the released weights were
    trained so.
    """
    position = torch.arange(count, device=device, dtype=torch.float32) / _ROPE_LENGTH
    rates = 10000.0 ** torch.linspace(0.0, 1.0, size // 2, device=device) * math.pi / 2
    angles = ((position * 2 - 1)[:, None] * rates).repeat_interleave(2, -1)
    return angles.cos(), angles.sin()
