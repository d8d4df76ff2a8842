"""Layers that the video trunk and the state expert share: attention, feed-forward, norms, embeddings of
levels.

Parameter names are those of the public GE-Sim 2.0 checkpoint.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def sinusoid(values: Tensor, size: int) -> Tensor:
    """Sinusoidal embedding [N, size] of values [N], cosines first."""
    half = size // 2
    rates = torch.exp(
        -math.log(10000.0) * torch.arange(half, device=values.device, dtype=torch.float32) / half
    )
    angles = values.float()[:, None] * rates
    return torch.cat((angles.cos(), angles.sin()), -1)


def rotate(x: Tensor, rope: tuple[Tensor, Tensor]) -> Tensor:
    """Apply rotary positions to x [..., L, head_dim], pairing the two halves of the channels."""
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
        q = self.queries_of(x)
        k, v = known if known is not None else self.keys_of(x if context is None else context)
        if rope is not None:
            q, k = rotate(q, rope), rotate(k, rope)
        out = F.scaled_dot_product_attention(
            q.to(v.dtype), k.to(v.dtype).expand(len(q), -1, -1, -1), v.expand(len(q), -1, -1, -1)
        )
        return self.to_out[0](out.transpose(1, 2).flatten(2))

    def of_one_token(self, value: Tensor) -> Tensor:
        """What everybody is told by a context of one token, from its value [B, heads, 1, head_dim]: the
        softmax over one key is 1, whoever asks. [B, 1, width].
        """
        return self.to_out[0](value.transpose(1, 2).flatten(2))

    def queries_of(self, x: Tensor) -> Tensor:
        """Queries [B, heads, L, head_dim] of tokens [B, L, width]."""
        return self.norm_q(self._heads(self.to_q(x)))

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


class AdaLN(nn.Module):
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


class TimestepMLP(nn.Module):
    def __init__(self, size: int, width: int, out: int, bias: bool):
        super().__init__()
        self.linear_1, self.linear_2 = nn.Linear(size, width, bias=bias), nn.Linear(width, out, bias=bias)

    def forward(self, x: Tensor) -> Tensor:
        return self.linear_2(F.silu(self.linear_1(x)))
