"""The GE-Sim 2.0 network at any size: a multi-view Cosmos-style diffusion transformer over video latents.

Parameter names are those of the public checkpoint, so that its weights load strictly. Attention stays within
a view, except in every third block, where it spans all views. The blocks' outputs, mixed by learned scalars,
are the features that a state expert attends to (state_network.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from envs.simulators.dit.layers import AdaLN, Attention, FeedForward, RMSNorm, TimestepMLP, sinusoid

_BASE_FPS = 24.0


@dataclass(frozen=True)
class DiTShape:
    """Size of the network; names follow the public configuration.

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
    shape: DiTShape, frames: int, height: int, width: int, fps: float, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Cosines and sines [T * H * W, head_dim] of three-axis rotary positions; time runs at fps against a base
    of 24.
    """
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


class VisionBlock(nn.Module):
    """Self-attention, attention to a text, if any, and feed-forward, each modulated by the time step."""

    def __init__(self, shape: DiTShape):
        super().__init__()
        width, heads, size = shape.width, shape.num_attention_heads, shape.attention_head_dim
        self.norm1, self.norm3 = (AdaLN(width, shape.adaln_lora_dim, 3) for _ in range(2))
        self.attn1 = Attention(width, heads, size)
        if shape.text_embed_dim:
            self.norm2 = AdaLN(width, shape.adaln_lora_dim, 3)
            self.attn2 = Attention(width, heads, size, shape.text_embed_dim)
        self.ff = FeedForward(width, shape.mlp_ratio)

    def forward(
        self,
        x: Tensor,
        text: Tensor | tuple[Tensor, Tensor] | None,
        embedded: Tensor,
        temb: Tensor,
        rope: tuple[Tensor, Tensor],
        views: int,
    ) -> Tensor:
        """Tokens [B * V, L, D]; `text` is a prompt, or its keys and values; with `views` > 1 self-attention
        joins the tokens of all views.
        """
        shift, scale, gate = self.norm1.parts(embedded, temb)
        h = self.norm1(x, shift, scale)
        if views > 1:
            joined = h.unflatten(0, (-1, views)).flatten(1, 2)
            cos, sin = (part.repeat(views, 1) for part in rope)
            h = self.attn1(joined, rope=(cos, sin)).unflatten(1, (views, -1)).flatten(0, 1)
        else:
            h = self.attn1(h, rope=rope)
        x = _add_gated(x, gate, h)
        if text is not None:
            x = self._read_text(x, text, embedded, temb)
        shift, scale, gate = self.norm3.parts(embedded, temb)
        return _add_gated(x, gate, self.ff(self.norm3(x, shift, scale)))

    def _read_text(
        self, x: Tensor, text: Tensor | tuple[Tensor, Tensor], embedded: Tensor, temb: Tensor
    ) -> Tensor:
        shift, scale, gate = self.norm2.parts(embedded, temb)
        known = self.attn2.keys_of(text) if isinstance(text, Tensor) else text
        if known[1].shape[2] == 1:
            return _add_gated(x, gate, self.attn2.alone(known[1]))
        return _add_gated(x, gate, self.attn2(self.norm2(x, shift, scale), known=known))


def _add_gated(x: Tensor, gate: Tensor, update: Tensor) -> Tensor:
    """Tokens x [B, L, width] plus an update of each, or of all, [B, L or 1, width], times the gate [B, T, 1,
    width] of its frame.
    """
    frames = gate.shape[1]
    each = update[:, None] if update.shape[1] == 1 else update.unflatten(1, (frames, -1))
    return torch.addcmul(x.unflatten(1, (frames, -1)), gate, each).flatten(1, 2)


class _VideoTime(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.width = width
        self.t_embedder = TimestepMLP(width, width, 3 * width, bias=False)
        self.norm = RMSNorm(width)

    def forward(self, timestep: Tensor) -> tuple[Tensor, Tensor]:
        waves = sinusoid(timestep, self.width).to(self.norm.weight.dtype)
        return self.t_embedder(waves), self.norm(waves)


class _FixedLayerNorm(nn.Module):
    """Layer norm whose weight and bias somebody else learns."""

    weight: Tensor
    bias: Tensor

    def __init__(self, width: int):
        super().__init__()
        self.register_buffer("weight", torch.ones(width))
        self.register_buffer("bias", torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        return F.layer_norm(x, self.weight.shape, self.weight, self.bias, eps=1e-6)


class _Stem(nn.Module):
    """Two convolutions over each latent frame, whose channels stand beside it: transformers with large
    patches learn from few pictures more quickly with one (Xiao et al. 2021)."""

    def __init__(self, channels: int, width: int):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(channels, width, 3, padding=1), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1)
        )

    def forward(self, x: Tensor) -> Tensor:
        """[B, C, T, H, W] -> [B, C + width, T, H, W]."""
        flat = self.layers(x.transpose(1, 2).flatten(0, 1))
        return torch.cat((x, flat.unflatten(0, (len(x), -1)).transpose(1, 2)), 1)


class MultiViewDiT(nn.Module):
    """The video trunk; see the module's docstring.

    Args:
        shape: sizes.

    Attributes:
        checkpointing: compute blocks anew in the backward pass instead of keeping what they computed.
        video_buffer_weights, video_buffer_norm: the mix of the blocks that makes features. A state expert
            learns it and hands it over (StateDecoder.attach); the video does not depend on it, so here it is
            buffers.
    """

    video_buffer_weights: Tensor

    def __init__(self, shape: DiTShape):
        super().__init__()
        self.shape, self.checkpointing = shape, False
        self._text: tuple[Tensor, int, list[tuple[Tensor, Tensor]]] | None = None
        width, patch = shape.width, math.prod(shape.patch_size)
        self.stem = _Stem(shape.in_channels, shape.stem) if shape.stem else nn.Identity()
        channels = shape.in_channels + shape.stem + shape.concat_padding_mask
        self.patch_embed = nn.ModuleDict({"proj": nn.Linear(channels * patch, width, bias=False)})
        self.time_embed = _VideoTime(width)
        if shape.action_size:
            self.action_embed = nn.Linear(shape.action_size, width)
        self.view_embed = nn.Parameter(torch.randn(shape.views, width) * 0.02)
        self.view_ada = nn.Sequential(nn.SiLU(), nn.Linear(width, 3 * width))
        self.transformer_blocks = nn.ModuleList(VisionBlock(shape) for _ in range(shape.num_layers))
        self.norm_out = AdaLN(width, shape.adaln_lora_dim, 2)
        self.proj_out = nn.Linear(width, patch * shape.out_channels, bias=False)
        self.register_buffer("video_buffer_weights", torch.ones(shape.num_layers))
        self.video_buffer_norm = _FixedLayerNorm(width)

    def forward(
        self,
        latents: Tensor,
        timestep: Tensor,
        text: Tensor | None,
        fps: float,
        actions: Tensor | None = None,
        layers: list[Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """One denoising step of the video.

        Args:
            latents: [B * V, C, T, H, W] latents with their conditioning channels, views of a session side by
                side.
            timestep: [B * V, 1, T, 1, 1] or [B * V, T] noise level of every latent frame.
            text: [B, L, D] or [B * V, L, D] prompt embedding; None where the network reads no text.
            fps: of the video.
            actions: [B * V, T, action_size] action vector of every latent frame, embedded and added to the
                time step's embedding, which modulates every block (adaLN); None where there are none.
            layers: takes the output of every block, each [B * V, tokens, width], for training the mix.

        Returns:
            velocity [B * V, out_channels, T, H, W] and the fused features [B * V, tokens, width] for the
            state expert.
        """
        batch, _, frames, height, width = latents.shape
        views, (pt, ph, pw) = self.shape.views, self.shape.patch_size
        latents = self.stem(latents)
        padding = latents.new_zeros(batch, int(self.shape.concat_padding_mask), frames, height, width)
        x = torch.cat((latents, padding), 1).reshape(
            batch, -1, frames // pt, pt, height // ph, ph, width // pw, pw
        )
        grid = (frames // pt, height // ph, width // pw)
        x = self.patch_embed["proj"](x.permute(0, 2, 4, 6, 1, 3, 5, 7).flatten(4).flatten(1, 3))
        rope = video_rope(self.shape, *grid, fps, latents.device)
        embedded, temb = self._modulation(timestep.reshape(batch, -1), actions)
        known = self._known(text, batch)
        fused = torch.zeros_like(x)
        for index, block in enumerate(self.transformer_blocks):
            arguments = (x, known[index], embedded, temb, rope, views if index % 3 == 0 else 1)
            x = (
                checkpoint(block, *arguments, use_reentrant=False)
                if self.checkpointing and torch.is_grad_enabled()
                else block(*arguments)
            )
            fused = fused + self.video_buffer_weights[index] * x.detach()
            if layers is not None:
                layers.append(x)
        x = self.norm_out(x, *self.norm_out.parts(embedded, temb))
        x = self.proj_out(x).unflatten(2, (ph, pw, pt, -1)).unflatten(1, grid)
        video = x.permute(0, 7, 1, 6, 2, 4, 3, 5).flatten(6, 7).flatten(4, 5).flatten(2, 3)
        return video, self.video_buffer_norm(fused)

    def _modulation(self, steps: Tensor, actions: Tensor | None) -> tuple[Tensor, Tensor]:
        """What modulates the blocks: the embedded time step [B * V, T, width], and shift, scale and gate
        common to all of them [B * V, T, 3 * width].
        """
        batch = len(steps)
        temb, embedded = self.time_embed(steps.reshape(-1))
        temb, embedded = (part.unflatten(0, (batch, -1)) for part in (temb, embedded))
        if actions is not None:
            embedded = embedded + self.action_embed(actions)
        of_views = self.view_ada(self.view_embed).repeat(batch // self.shape.views, 1)
        return embedded, temb + of_views[:, None]

    def _known(self, text: Tensor | None, batch: int) -> Sequence[Tensor | tuple[Tensor, Tensor] | None]:
        """The text for every block. Sessions that share one prompt share its keys and values, which outside
        training are computed once.
        """
        if text is None:
            return [None] * len(self.transformer_blocks)
        if len(text) > 1 and text.stride(0):
            return [text.repeat_interleave(batch // len(text), 0)] * len(self.transformer_blocks)
        one = text[:1]
        if torch.is_grad_enabled() or self.training:
            return [one] * len(self.transformer_blocks)
        if self._text is None or self._text[0].data_ptr() != one.data_ptr() or self._text[1] != self._stamp():
            self._text = (one, self._stamp(), [attention.keys_of(one) for attention in self._to_text()])
        return self._text[2]

    def _to_text(self) -> list[Attention]:
        return [cast(VisionBlock, block).attn2 for block in self.transformer_blocks]

    def _stamp(self) -> int:
        """Changes whenever weights do that the kept keys depend on, and with the precision they are computed
        in.
        """
        precision = torch.is_autocast_enabled(self.view_embed.device.type)
        return hash(
            (
                precision,
                *(
                    (p.data_ptr(), p._version)
                    for attention in self._to_text()
                    for p in attention.parameters()
                ),
            )
        )
