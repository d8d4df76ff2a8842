"""A block of the multi-view diffusion transformer."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from envs.simulators.dit.layers import AdaLN, Attention, FeedForward
from envs.simulators.dit.shape import DiTShape


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
        """Tokens [B * V, L, D]; `text` is a prompt, or its keys and values; `rope` as of video_rope; with
        `views` > 1 self-attention joins the tokens of all views.
        """
        shift, scale, gate = self.norm1.parts(embedded, temb)
        h = self.norm1(x, shift, scale)
        if views > 1:
            joined = h.unflatten(0, (-1, views)).flatten(1, 2)
            cos, sin = (_of_all_views(part, views) for part in rope)
            h = self.attn1(joined, rope=(cos, sin)).unflatten(1, (views, -1)).flatten(0, 1)
        else:
            h = self.attn1(h, rope=(_over_heads(rope[0]), _over_heads(rope[1])))
        x = _add_gated(x, gate, h)
        if text is not None:
            x = self._read_text(x, text, embedded, temb)
        shift, scale, gate = self.norm3.parts(embedded, temb)
        return _add_gated(x, gate, self.ff(self.norm3(x, shift, scale)))

    def text_keys(self, text: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values of a prompt [B, L, D]."""
        return self.attn2.keys_of(text)

    def _read_text(
        self, x: Tensor, text: Tensor | tuple[Tensor, Tensor], embedded: Tensor, temb: Tensor
    ) -> Tensor:
        shift, scale, gate = self.norm2.parts(embedded, temb)
        known = self.text_keys(text) if isinstance(text, Tensor) else text
        if known[1].shape[2] == 1:
            return _add_gated(x, gate, self.attn2.of_one_token(known[1]))
        return _add_gated(x, gate, self.attn2(self.norm2(x, shift, scale), known=known))


def _of_all_views(positions: Tensor, views: int) -> Tensor:
    """Positions of the joined tokens of all views, from one's [L, D] or each one's [B * V, L, D]."""
    if positions.ndim == 2:
        return positions.repeat(views, 1)
    return _over_heads(positions.unflatten(0, (-1, views)).flatten(1, 2))


def _over_heads(positions: Tensor) -> Tensor:
    """Positions [L, D], or [B, L, D] of each row, so that they broadcast over heads [B, heads, L, D]."""
    return positions if positions.ndim == 2 else positions[:, None]


def _add_gated(x: Tensor, gate: Tensor, update: Tensor) -> Tensor:
    """Tokens x [B, L, width] plus an update of each, or of all, [B, L or 1, width], times the gate [B, T, 1,
    width] of its frame.
    """
    frames = gate.shape[1]
    each = update[:, None] if update.shape[1] == 1 else update.unflatten(1, (frames, -1))
    return torch.addcmul(x.unflatten(1, (frames, -1)), gate, each).flatten(1, 2)
