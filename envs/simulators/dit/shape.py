"""Sizes of the multi-view diffusion transformer, and the rotary positions of its tokens."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_BASE_FPS = 24.0


@dataclass(frozen=True)
class DiTShape:
    """Size of the network; names follow the public configuration.

    The defaults are constants of a format, the released GE-Sim 2.0; a checkpoint says what differs.
    DiTSimulator names every size of its own (engine.py, Trunk).

    Args:
        in_channels: latent + pose map + ray map + memory mask; the padding mask is added inside.
        out_channels: latent channels.
        num_attention_heads, attention_head_dim, num_layers: of the trunk; the first two make its width.
        mlp_ratio, adaln_lora_dim: of the trunk.
        text_embed_dim: of prompt tokens; 0 builds no attention to text.
        patch_size: latent frames, rows and columns per token.
        rope_scale: extrapolation of the three position axes.
        max_size: largest positions of the three axes, before patching.
        views: number of view embeddings.
        concat_padding_mask: whether the network adds its own channel of zeros.
        pose_in_channels: numbers of a state expert's token.
        pose_out_channels: numbers of a state; 0 is as many as a token has, as released.
        pose_num_attention_heads, pose_attention_head_dim: of the state expert.
        pose_expert: whether a released file holds one; GE-Sim 1's does not.
        pose_layers: of the state expert; 0 is as many as the trunk, as released.
        action_size: numbers of the action vector of a latent frame; 0 is without, as released.
        stem: channels of a convolutional stem before the patches; 0 is without, as released.
    """

    in_channels: int = 26
    out_channels: int = 16
    num_attention_heads: int = 16
    attention_head_dim: int = 128
    num_layers: int = 28
    mlp_ratio: float = 4.0
    text_embed_dim: int = 1024
    adaln_lora_dim: int = 256
    patch_size: tuple[int, int, int] = (1, 2, 2)
    rope_scale: tuple[float, float, float] = (1.0, 3.0, 3.0)
    max_size: tuple[int, int, int] = (128, 240, 240)
    views: int = 3
    concat_padding_mask: bool = True
    pose_in_channels: int = 16
    pose_out_channels: int = 0
    pose_num_attention_heads: int = 16
    pose_attention_head_dim: int = 32
    pose_expert: bool = True
    pose_layers: int = 0
    action_size: int = 0
    stem: int = 0

    @property
    def width(self) -> int:
        """Channels of a token."""
        return self.num_attention_heads * self.attention_head_dim


def video_rope(
    shape: DiTShape, frames: int, height: int, width: int, fps: float | Tensor, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Cosines and sines [T * H * W, head_dim] of three-axis rotary positions; time runs at fps against a base
    of 24. Of fps [B] they are [B, T * H * W, head_dim].
    """
    if isinstance(fps, Tensor):
        each = [video_rope(shape, frames, height, width, one, device) for one in fps.tolist()]
        return torch.stack([cos for cos, _ in each]), torch.stack([sin for _, sin in each])
    size = shape.attention_head_dim
    across = size // 6 * 2
    sizes = (size - 2 * across, across, across)
    parts = []
    for axis, (count, part, scale) in enumerate(
        zip((frames, height, width), sizes, shape.rope_scale, strict=True)
    ):
        theta = 10000.0 * scale ** (part / (part - 2))
        rates = 1.0 / theta ** (
            torch.arange(0, part, 2, device=device, dtype=torch.float32)[: part // 2] / part
        )
        position = torch.arange(count, device=device, dtype=torch.float32)
        if axis == 0:
            position = position / fps * _BASE_FPS
        view = [1, 1, 1, -1]
        view[axis] = count
        parts.append(torch.outer(position, rates).reshape(view).expand(frames, height, width, -1))
    angles = torch.cat(parts * 2, -1).flatten(0, 2)
    return angles.cos(), angles.sin()
