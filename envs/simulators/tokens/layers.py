"""Attention and feed-forward of the spatio-temporal transformer: the same bits for a row in any batch."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.simulators.dit.layers import rotate
from envs.simulators.row_linear import RowLinear

_BASE = 100.0  # of rotary positions: windows are tens of frames long

Keys = tuple[Tensor, Tensor]  # keys and values, each [..., heads, L, head_dim]


def time_rope(first: int, count: int, size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Cosines and sines [count, size] of the rotary positions of frames first, first + 1, ..."""
    half = size // 2
    rates = _BASE ** -(torch.arange(half, device=device, dtype=torch.float32) / half)
    frames = torch.arange(first, first + count, device=device, dtype=torch.float32)
    angles = torch.outer(frames, rates).repeat(1, 2)
    return angles.cos(), angles.sin()


class TokenAttention(nn.Module):
    """Multi-head attention with normalised queries and keys (Henry et al. 2020), without biases.

    Args:
        width: of queries, keys and values.
        heads: a divisor of the width.
    """

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.to_q, self.to_k, self.to_v = (RowLinear(width, width, bias=False) for _ in range(3))
        self.norm_q, self.norm_k = (nn.LayerNorm(width // heads, bias=False) for _ in range(2))
        self.to_out = nn.ModuleList([RowLinear(width, width, bias=False)])

    def keys_of(self, x: Tensor, rope: tuple[Tensor, Tensor] | None = None) -> Keys:
        """Keys and values [..., heads, L, head_dim] of tokens [..., L, width]."""
        keys = self.norm_k(self._split(self.to_k(x)))
        return keys if rope is None else rotate(keys, rope), self._split(self.to_v(x))

    def forward(
        self,
        x: Tensor,
        known: Keys,
        mask: Tensor | None = None,
        rope: tuple[Tensor, Tensor] | None = None,
    ) -> Tensor:
        """What tokens [..., L, width] are told by keys and values; where the mask [L, keys] is false they do
        not look.
        """
        queries = self.norm_q(self._split(self.to_q(x)))
        queries = queries if rope is None else rotate(queries, rope)
        keys, values = known
        out = _attend(queries.to(values.dtype), keys.to(values.dtype), values, mask)
        return self.to_out[0](out.transpose(-2, -3).flatten(-2))

    def _split(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (self.heads, -1)).transpose(-2, -3)


def _attend(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None) -> Tensor:
    """Attention of queries [..., L, size] to keys and values [..., N, size]; sizes before that may broadcast.

    On a CPU by two products: over so few keys they take a half to a quarter of the time of torch's fused
    kernel, most of all backwards in bfloat16 (8.8 against 35 ms for 40 queries of 88 keys in 192 heads).
    """
    if q.is_cuda:
        lead = q.shape[:-2]
        k, v = (part.expand(*lead, -1, -1).flatten(0, -4) for part in (k, v))
        return F.scaled_dot_product_attention(q.flatten(0, -4), k, v, attn_mask=mask).unflatten(0, lead[:-1])
    scores = (q * q.shape[-1] ** -0.5) @ k.mT
    if mask is not None:
        scores = scores.masked_fill(~mask, float("-inf"))
    return scores.softmax(-1) @ v


class _Gelu(nn.Module):
    def __init__(self, width: int, inner: int):
        super().__init__()
        self.proj = RowLinear(width, inner)

    def forward(self, x: Tensor) -> Tensor:
        return F.gelu(self.proj(x))


class FeedForward(nn.Module):
    """Two linear layers around a GELU; names are those that adapters look for (training/lora.py)."""

    def __init__(self, width: int, ratio: int):
        super().__init__()
        inner = ratio * width
        self.net = nn.ModuleList([_Gelu(width, inner), nn.Identity(), RowLinear(inner, width)])

    def forward(self, x: Tensor) -> Tensor:
        return self.net[2](self.net[0](x))


def joined(past: Keys | None, new: Keys) -> Keys:
    """Keys and values of the past before the new ones."""
    if past is None:
        return new
    return torch.cat((past[0], new[0]), -2), torch.cat((past[1], new[1]), -2)


def newest(known: Keys, count: int) -> Keys:
    """The last `count` keys and values."""
    begin = max(0, known[0].shape[-2] - count)
    return known[0][..., begin:, :], known[1][..., begin:, :]
