"""The GE-Sim 2.0 network at any size: a multi-view Cosmos-style diffusion transformer and its state expert.

Parameter names are those of the public checkpoint, so that its weights load strictly. The trunk denoises
video
latents of all views; attention stays within a view, except in every third block where it spans all views. Its
block
outputs, mixed by learned scalars, are what the state expert attends to when it denoises joint states.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

_BASE_FPS = 24.0
_STATE_ROPE_LENGTH = 57.0


@dataclass(frozen=True)
class DiTShape:
    """Size of the network; names follow the public configuration.

    Args:
        in_channels: latent + pose map + ray map + memory mask; the padding mask is added inside.
        out_channels: latent channels.
        num_attention_heads, attention_head_dim, num_layers: of the trunk; their product is its width.
        mlp_ratio, text_embed_dim, adaln_lora_dim: of the trunk.
        patch_size: latent frames, rows and columns per token.
        rope_scale: extrapolation of the three position axes.
        max_size: largest positions of the three axes, before patching.
        views: number of view embeddings.
        concat_padding_mask: whether the network adds its own channel of zeros.
        pose_in_channels, pose_num_attention_heads, pose_attention_head_dim: of the state expert.
        pose_expert: whether there is one; GE-Sim 1 has none.
        pose_layers: of the state expert; 0 is as many as the trunk, as released.
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
    pose_num_attention_heads: int = 16
    pose_attention_head_dim: int = 32
    pose_expert: bool = True
    pose_layers: int = 0

    @property
    def width(self) -> int:
        """Channels of a token."""
        return self.num_attention_heads * self.attention_head_dim


def sinusoid(values: Tensor, size: int) -> Tensor:
    """Sinusoidal embedding [N, size] of values [N], cosines first."""
    half = size // 2
    rates = torch.exp(
        -math.log(10000.0) * torch.arange(half, device=values.device, dtype=torch.float32) / half
    )
    angles = values.float()[:, None] * rates
    return torch.cat((angles.cos(), angles.sin()), -1)


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
        place = torch.arange(count, device=device, dtype=torch.float32)
        if axis == 0:
            place = place / fps * _BASE_FPS
        view = [1, 1, 1, -1]
        view[axis] = count
        parts.append(torch.outer(place, rates).reshape(view).expand(frames, height, width, -1))
    angles = torch.cat(parts * 2, -1).flatten(0, 2)
    return angles.cos(), angles.sin()


def rotate(x: Tensor, rope: tuple[Tensor, Tensor]) -> Tensor:
    """Apply rotary positions to x [..., L, head_dim], pairing the first half of the channels with the second."""
    first, second = x.float().chunk(2, -1)
    (cos, other_cos), (sin, other_sin) = (part.chunk(2, -1) for part in rope)
    return torch.cat((first * cos - second * sin, second * other_cos + first * other_sin), -1).to(x.dtype)


class RMSNorm(nn.Module):
    """Root-mean-square norm with a weight (Zhang & Sennrich 2019), computed in float32."""

    def __init__(self, size: int, eps: float = 1e-6):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(size))
        self.eps = eps

    def forward(self, x: Tensor) -> Tensor:
        return rms(x, self.eps) * self.weight


def rms(x: Tensor, eps: float = 1e-6) -> Tensor:
    """Root-mean-square norm without a weight."""
    precise = x.float()
    return (precise * torch.rsqrt(precise.square().mean(-1, keepdim=True) + eps)).to(x.dtype)


class Attention(nn.Module):
    """Multi-head attention with normalised queries and keys, to itself or to a context.

    Args:
        width: of queries; context: of keys and values.
        bias: on all projections.
    """

    def __init__(self, width: int, heads: int, head_dim: int, context: int | None = None, bias: bool = False):
        super().__init__()
        inner = heads * head_dim
        self.heads = heads
        self.to_q = nn.Linear(width, inner, bias=bias)
        self.to_k = nn.Linear(context or width, inner, bias=bias)
        self.to_v = nn.Linear(context or width, inner, bias=bias)
        self.norm_q, self.norm_k = RMSNorm(head_dim, 1e-5), RMSNorm(head_dim, 1e-5)
        self.to_out = nn.ModuleList([nn.Linear(inner, width, bias=bias)])

    def forward(
        self,
        x: Tensor,
        context: Tensor | None = None,
        rope: tuple[Tensor, Tensor] | None = None,
        known: tuple[Tensor, Tensor] | None = None,
    ) -> Tensor:
        """Tokens [B, L, width]; `known` are keys and values of a context that was met before (`keys_of`)."""
        q = self.norm_q(self._heads(self.to_q(x)))
        k, v = known if known is not None else self.keys_of(x if context is None else context)
        if rope is not None:
            q, k = rotate(q, rope), rotate(k, rope)
        out = F.scaled_dot_product_attention(
            q.to(v.dtype), k.to(v.dtype).expand(len(q), -1, -1, -1), v.expand(len(q), -1, -1, -1)
        )
        return self.to_out[0](out.transpose(1, 2).flatten(2))

    def alone(self, value: Tensor) -> Tensor:
        """What everybody is told by a context of one token, from its value [B, heads, 1, head_dim]: the
        softmax over one key is 1, whoever asks. [B, 1, width].
        """
        return self.to_out[0](value.transpose(1, 2).flatten(2))

    def keys_of(self, context: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values [B, heads, L, head_dim] of a context [B, L, width]."""
        return self.norm_k(self._heads(self.to_k(context))), self._heads(self.to_v(context))

    def _heads(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class _Gelu(nn.Module):
    def __init__(self, width: int, inner: int, bias: bool, approximate: str):
        super().__init__()
        self.proj, self.approximate = nn.Linear(width, inner, bias=bias), approximate

    def forward(self, x: Tensor) -> Tensor:
        return F.gelu(self.proj(x), approximate=self.approximate)


class FeedForward(nn.Module):
    """Two linear layers around a GELU."""

    def __init__(self, width: int, ratio: float, bias: bool = False, approximate: str = "none"):
        super().__init__()
        inner = int(width * ratio)
        self.net = nn.ModuleList(
            [_Gelu(width, inner, bias, approximate), nn.Identity(), nn.Linear(inner, width, bias=bias)]
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.net[2](self.net[0](x))


class _AdaLN(nn.Module):
    """Layer norm whose shift, scale (and gate) come from the time step through a low-rank map."""

    def __init__(self, width: int, rank: int, outputs: int):
        super().__init__()
        self.outputs, self.width = outputs, width
        self.linear_1 = nn.Linear(width, rank, bias=False)
        self.linear_2 = nn.Linear(rank, outputs * width, bias=False)

    def parts(self, embedded: Tensor, temb: Tensor) -> list[Tensor]:
        """Shift, scale (and gate), each [B, T, 1, width]: all tokens of a frame have its time step."""
        parts = self.linear_2(self.linear_1(F.silu(embedded))) + temb[..., : self.outputs * self.width]
        return list(parts[:, :, None].chunk(self.outputs, -1))

    def forward(self, x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
        """Tokens [B, L, width], normed and modulated."""
        return torch.addcmul(
            shift, F.layer_norm(x, (self.width,), eps=1e-6).unflatten(1, (shift.shape[1], -1)), 1 + scale
        ).flatten(1, 2)


class VisionBlock(nn.Module):
    """Self-attention, attention to the text, feed-forward, each modulated by the time step."""

    def __init__(self, shape: DiTShape):
        super().__init__()
        width, heads, size = shape.width, shape.num_attention_heads, shape.attention_head_dim
        self.norm1, self.norm2, self.norm3 = (_AdaLN(width, shape.adaln_lora_dim, 3) for _ in range(3))
        self.attn1 = Attention(width, heads, size)
        self.attn2 = Attention(width, heads, size, shape.text_embed_dim)
        self.ff = FeedForward(width, shape.mlp_ratio)

    def forward(
        self,
        x: Tensor,
        text: Tensor | tuple[Tensor, Tensor],
        embedded: Tensor,
        temb: Tensor,
        rope: tuple[Tensor, Tensor],
        views: int,
    ) -> Tensor:
        """Tokens [B * V, L, D], and the text or its keys and values; with `views` > 1 self-attention joins
        the tokens of all views.
        """
        shift, scale, gate = self.norm1.parts(embedded, temb)
        h = self.norm1(x, shift, scale)
        if views > 1:
            joined = h.unflatten(0, (-1, views)).flatten(1, 2)
            cos, sin = (part.repeat(views, 1) for part in rope)
            h = self.attn1(joined, rope=(cos, sin)).unflatten(1, (views, -1)).flatten(0, 1)
        else:
            h = self.attn1(h, rope=rope)
        x = _plus(x, gate, h)
        shift, scale, gate = self.norm2.parts(embedded, temb)
        known = self.attn2.keys_of(text) if isinstance(text, Tensor) else text
        said = (
            self.attn2.alone(known[1])
            if known[1].shape[2] == 1
            else self.attn2(self.norm2(x, shift, scale), known=known)
        )
        x = _plus(x, gate, said)
        shift, scale, gate = self.norm3.parts(embedded, temb)
        return _plus(x, gate, self.ff(self.norm3(x, shift, scale)))


def _plus(x: Tensor, gate: Tensor, said: Tensor) -> Tensor:
    """Tokens x [B, L, width] plus what is said to each, or to all, [B, L or 1, width], times the gate [B, T,
    1, width] of its frame.
    """
    frames = gate.shape[1]
    each = said[:, None] if said.shape[1] == 1 else said.unflatten(1, (frames, -1))
    return torch.addcmul(x.unflatten(1, (frames, -1)), gate, each).flatten(1, 2)


class _TimestepMLP(nn.Module):
    def __init__(self, size: int, width: int, out: int, bias: bool):
        super().__init__()
        self.linear_1, self.linear_2 = nn.Linear(size, width, bias=bias), nn.Linear(width, out, bias=bias)

    def forward(self, x: Tensor) -> Tensor:
        return self.linear_2(F.silu(self.linear_1(x)))


class _VideoTime(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.width = width
        self.t_embedder = _TimestepMLP(width, width, 3 * width, bias=False)
        self.norm = RMSNorm(width)

    def forward(self, timestep: Tensor) -> tuple[Tensor, Tensor]:
        waves = sinusoid(timestep, self.width).to(self.norm.weight.dtype)
        return self.t_embedder(waves), self.norm(waves)


class _StateTime(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.emb = nn.ModuleDict({"timestep_embedder": _TimestepMLP(256, width, width, bias=True)})
        self.linear = nn.Linear(width, 6 * width)

    def forward(self, timestep: Tensor) -> tuple[Tensor, Tensor]:
        embedded = self.emb["timestep_embedder"](sinusoid(timestep, 256).to(self.linear.weight.dtype))
        return self.linear(F.silu(embedded)), embedded


class StateBlock(nn.Module):
    """Block of the state expert: self-attention over time, attention to the trunk's features, feed-forward."""

    def __init__(self, width: int, heads: int, size: int, context: int):
        super().__init__()
        self.attn1 = Attention(width, heads, size, bias=True)
        self.attn2 = Attention(width, heads, size, context, bias=True)
        self.ff = FeedForward(width, 4.0, bias=True, approximate="tanh")
        self.scale_shift_table = nn.Parameter(torch.randn(6, width) / width**0.5)

    def forward(
        self, x: Tensor, context: Tensor | tuple[Tensor, Tensor], temb: Tensor, rope: tuple[Tensor, Tensor]
    ) -> Tensor:
        """Tokens [B, N, width], and the features [B, L, context] or their keys and values."""
        shift1, scale1, gate1, shift2, scale2, gate2 = (
            self.scale_shift_table + temb.unflatten(-1, (6, -1))
        ).unbind(-2)
        x = x + gate1 * self.attn1(rms(x) * (1 + scale1) + shift1, rope=rope)
        x = x + (self.attn2(x, context) if isinstance(context, Tensor) else self.attn2(x, known=context))
        return x + gate2 * self.ff(rms(x) * (1 + scale2) + shift2)


class MultiViewDiT(nn.Module):
    """Trunk and state expert; see the module's docstring.

    Args:
        shape: sizes.
        trunk, expert: build only one half, the other being somewhere else; both have the learned mix between
            them.

    Attributes:
        checkpointing: compute blocks anew in the backward pass instead of keeping what they computed.
    """

    def __init__(self, shape: DiTShape, trunk: bool = True, expert: bool = True):
        super().__init__()
        self.shape, self.checkpointing = shape, False
        self._text: tuple[Tensor, int, list[tuple[Tensor, Tensor]]] | None = None
        if trunk:
            self._build_trunk(shape)
        if shape.pose_expert:
            self._build_mix(shape)
            if expert:
                self._build_expert(shape)

    def _build_trunk(self, shape: DiTShape) -> None:
        width, patch = shape.width, math.prod(shape.patch_size)
        self.patch_embed = nn.ModuleDict(
            {"proj": nn.Linear((shape.in_channels + shape.concat_padding_mask) * patch, width, bias=False)}
        )
        self.time_embed = _VideoTime(width)
        self.view_embed = nn.Parameter(torch.randn(shape.views, width) * 0.02)
        self.view_ada = nn.Sequential(nn.SiLU(), nn.Linear(width, 3 * width))
        self.transformer_blocks = nn.ModuleList(VisionBlock(shape) for _ in range(shape.num_layers))
        self.norm_out = _AdaLN(width, shape.adaln_lora_dim, 2)
        self.proj_out = nn.Linear(width, patch * shape.out_channels, bias=False)

    def _build_mix(self, shape: DiTShape) -> None:
        self.video_buffer_weights = nn.Parameter(torch.ones(shape.num_layers))
        self.video_buffer_norm = nn.LayerNorm(shape.width, eps=1e-6)

    def add_expert(self) -> None:
        """Give a network that came without one (GE-Sim 1) an untrained state expert."""
        if not self.shape.pose_expert:
            self.shape = replace(self.shape, pose_expert=True)
            self._build_mix(self.shape)
            self._build_expert(self.shape)

    def _build_expert(self, shape: DiTShape) -> None:
        width = shape.pose_num_attention_heads * shape.pose_attention_head_dim
        self.pose_proj_in = nn.Linear(shape.pose_in_channels, width)
        self.pose_time_embed = _StateTime(width)
        self.pose_blocks = nn.ModuleList(
            StateBlock(width, shape.pose_num_attention_heads, shape.pose_attention_head_dim, shape.width)
            for _ in range(shape.pose_layers or shape.num_layers)
        )
        self.pose_scale_shift_table = nn.Parameter(torch.randn(2, width) / width**0.5)
        self.pose_proj_out = nn.Linear(width, shape.pose_in_channels)

    def forward(
        self,
        latents: Tensor,
        timestep: Tensor,
        text: Tensor,
        views: int,
        fps: float,
        layers: list[Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """One denoising step of the video.

        Args:
            latents: [B * V, C, T, H, W] latents with their conditioning channels, views of a session side by
                side.
            timestep: [B * V, 1, T, 1, 1] or [B * V, T] noise level of every latent frame.
            text: [B, L, D] or [B * V, L, D] prompt embedding.
            fps: of the video.
            layers: takes what every block says, each [B * V, tokens, width], for training the mix (`fuse`).

        Returns:
            velocity [B * V, out_channels, T, H, W] and the fused features [B * V, tokens, width] for the
            state expert.
        """
        batch, _, frames, height, width = latents.shape
        pt, ph, pw = self.shape.patch_size
        padding = latents.new_zeros(batch, int(self.shape.concat_padding_mask), frames, height, width)
        x = torch.cat((latents, padding), 1).reshape(
            batch, -1, frames // pt, pt, height // ph, ph, width // pw, pw
        )
        grid = (frames // pt, height // ph, width // pw)
        x = self.patch_embed["proj"](x.permute(0, 2, 4, 6, 1, 3, 5, 7).flatten(4).flatten(1, 3))
        rope = video_rope(self.shape, *grid, fps, latents.device)
        steps = timestep.reshape(batch, -1)
        temb, embedded = self.time_embed(steps.reshape(-1))
        temb, embedded = (part.unflatten(0, (batch, -1)) for part in (temb, embedded))
        temb = temb + self.view_ada(self.view_embed).repeat(batch // views, 1)[:, None]
        said = self._known(text, batch)
        fused = torch.zeros_like(x)
        for index, block in enumerate(self.transformer_blocks):
            arguments = (x, said[index], embedded, temb, rope, views if index % 3 == 0 else 1)
            x = (
                checkpoint(block, *arguments, use_reentrant=False)
                if self.checkpointing and torch.is_grad_enabled()
                else block(*arguments)
            )
            if self.shape.pose_expert:
                fused = fused + self.video_buffer_weights[index] * x
            if layers is not None:
                layers.append(x)
        x = self.norm_out(x, *self.norm_out.parts(embedded, temb))
        x = self.proj_out(x).unflatten(2, (ph, pw, pt, -1)).unflatten(1, grid)
        video = x.permute(0, 7, 1, 6, 2, 4, 3, 5).flatten(6, 7).flatten(4, 5).flatten(2, 3)
        return video, self.video_buffer_norm(fused) if self.shape.pose_expert else fused

    def fuse(self, layers: Sequence[Tensor]) -> Tensor:
        """The features of `forward` from what every block said."""
        return self.video_buffer_norm(
            sum(weight * x for weight, x in zip(self.video_buffer_weights, layers, strict=True))
        )

    def _known(self, text: Tensor, batch: int) -> Sequence[Tensor | tuple[Tensor, Tensor]]:
        """The text for every block. Sessions that share one prompt share its keys and values, which outside
        training are computed once.
        """
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

    def feature_keys(self, features: Tensor, views: int) -> list[tuple[Tensor, Tensor]]:
        """Keys and values of features [B * V, L, width] for every block of the state expert, the same at all
        its steps.
        """
        context = features.unflatten(0, (-1, views)).flatten(1, 2)
        return [cast(StateBlock, block).attn2.keys_of(context) for block in self.pose_blocks]

    def decode_states(
        self,
        states: Tensor,
        timestep: Tensor,
        features: Tensor | list[tuple[Tensor, Tensor]],
        views: int,
        mask: Tensor | None = None,
    ) -> Tensor:
        """One denoising step of the joint states.

        Args:
            states: [B, N, 16] history and future tokens; timestep: [B, N] noise level of each.
            features: [B * V, L, width] from `forward`, or their `feature_keys`.
            mask: [B, N, 16] of the numbers that the robot has, 1, and has not, 0; the latter are neither seen
                nor moved.

        Returns:
            velocity [B, N, 16].
        """
        batch, count = states.shape[:2]
        contexts = (
            [features.unflatten(0, (batch, views)).flatten(1, 2)] * len(self.pose_blocks)
            if isinstance(features, Tensor)
            else features
        )
        x = self.pose_proj_in(states if mask is None else states * mask)
        temb, embedded = (
            part.unflatten(0, (batch, count)) for part in self.pose_time_embed(timestep.reshape(-1))
        )
        rope = state_rope(count, self.shape.pose_attention_head_dim, states.device)
        for block, context in zip(self.pose_blocks, contexts, strict=True):
            x = block(x, context, temb, rope)
        shift, scale = (self.pose_scale_shift_table + embedded[:, :, None]).unbind(2)
        x = F.layer_norm(x, (x.shape[-1],), eps=1e-6) * (1 + scale) + shift
        out = self.pose_proj_out(x)
        return out if mask is None else out * mask


def state_rope(count: int, size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Cosines and sines [count, size] of one-axis rotary positions over a base length of 57 tokens.

    Angles are laid out for neighbouring channels, while `rotate` pairs halves; the released weights were
    trained so.
    """
    place = torch.arange(count, device=device, dtype=torch.float32) / _STATE_ROPE_LENGTH
    rates = 10000.0 ** torch.linspace(0.0, 1.0, size // 2, device=device) * math.pi / 2
    angles = ((place * 2 - 1)[:, None] * rates).repeat_interleave(2, -1)
    return angles.cos(), angles.sin()
