"""The spatio-temporal transformer of RoboScape-R: from tokens so far, and conditioning, to the next frame's.

The action world and the text world are this one class, each with weights of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from envs.ranges import Count
from envs.simulators.row_linear import RowLinear, row_linear
from envs.simulators.tokenizers.lfq import bit_signs
from envs.simulators.tokens.blocks import FrameCache, Memory, STBlock
from envs.simulators.tokens.conditioning import Conditioning

MASKED = -1  # stands for a token that is not known

_SMALL = 0.02
_KEEP = 3.0  # nats by which a token that was there is likelier at first


@dataclass(frozen=True)
class Trunk:
    """Sizes of the transformer.

    Args:
        layers: blocks.
        width: numbers of a token.
        heads: of every attention; a divisor of the width.
        ratio: of the feed-forward's width to the tokens'.
        checkpointing: compute blocks anew in the backward pass instead of keeping what they computed.

    Raises:
        ValueError: if the width is no multiple of the heads with an even number of channels each.
    """

    layers: Count
    width: Count
    heads: Count
    ratio: Count
    checkpointing: bool

    def __post_init__(self) -> None:
        if self.width % (2 * self.heads):
            raise ValueError(f"net.width={self.width} must be a multiple of 2 * net.heads={2 * self.heads}")


@dataclass(frozen=True)
class Vocabulary:
    """The tokens of a frame.

    Args:
        views, rows, columns: of the places of a frame.
        factors: tokens of a place.
        bits: of a token.
    """

    views: int
    rows: int
    columns: int
    factors: int
    bits: int

    @property
    def codes(self) -> int:
        """Different tokens of a factor."""
        return 2**self.bits

    @property
    def places(self) -> int:
        """Of a frame, view by view and row by row, P."""
        return self.views * self.rows * self.columns


class TokenHead(nn.Module):
    """From a place's features to the logits of its tokens: a sum of what is said of each bit, of each code,
    and of keeping the token that was there in the frame before.

    Most places stay as they are, and codes that are seldom seen share bits with others: with whole codes
    alone both had to be learned for every one of them.

    Args:
        width: of the features.
        vocabulary: the tokens of a frame.
        signs: float32 [codes, bits] of the codes.
    """

    signs: Tensor

    def __init__(self, width: int, vocabulary: Vocabulary, signs: Tensor):
        super().__init__()
        v = vocabulary
        self.vocabulary = v
        self.register_buffer("signs", signs, persistent=False)
        self.bits, self.codes = (RowLinear(width, v.factors * size, bias=False) for size in (v.bits, v.codes))
        self.keep = RowLinear(width, v.factors)
        nn.init.constant_(self.keep.bias, _KEEP)

    def forward(self, features: Tensor, before: Tensor) -> Tensor:
        """Logits float32 [..., factors, codes] of features [..., width]; the frame before had the tokens
        `before` [..., factors].
        """
        v = self.vocabulary
        bits = self.bits(features).float().unflatten(-1, (v.factors, v.bits))
        codes = self.codes(features).float().unflatten(-1, (v.factors, v.codes))
        logits = row_linear(bits, self.signs) + codes
        return logits.scatter_add(-1, before[..., None], self.keep(features).float()[..., None])


class SpatioTemporalTransformer(nn.Module):
    """See the module's docstring. P are places, F factors; `cond` are tokens [B, T, N, width], and `beside`
    what else is known of every place, [B, T, P, width], or None.

    Args:
        vocabulary: the tokens of a frame.
        trunk: sizes.
        window: frames that a frame sees, itself included.
        conditioning: how it is told.
    """

    offset: Tensor

    def __init__(self, vocabulary: Vocabulary, trunk: Trunk, window: int, conditioning: Conditioning):
        super().__init__()
        self.vocabulary, self.trunk, width, v = vocabulary, trunk, trunk.width, vocabulary
        self.embed = nn.Embedding(v.factors * v.codes, width)
        signs = bit_signs(v.bits)
        with torch.no_grad():  # codes that differ in few bits mean much the same: they begin close together
            directions = torch.randn(v.factors, v.bits, width) / v.bits**0.5
            self.embed.weight.copy_((signs @ directions).flatten(0, 1))
        self.register_buffer("offset", v.codes * torch.arange(v.factors), persistent=False)
        self.view, self.row, self.column = (
            nn.Parameter(_SMALL * torch.randn(count, width)) for count in (v.views, v.rows, v.columns)
        )
        self.query = nn.Parameter(_SMALL * torch.randn(width))
        self.blocks = nn.ModuleList(
            STBlock(width, trunk.heads, trunk.ratio, window, conditioning) for _ in range(trunk.layers)
        )
        self.norm_seen, self.norm_asked = nn.LayerNorm(width), nn.LayerNorm(width)
        self.head = TokenHead(width, v, signs)

    def forward(
        self, tokens: Tensor, shown: Tensor, cond: Tensor, beside: Tensor | None, causal: bool
    ) -> tuple[Tensor, Tensor]:
        """All frames of a clip but the first, each asked for after those before it.

        Args:
            tokens: int64 [B, T, P, F], the frames as they are known later.
            shown: int64 [B, T - 1, P, F], what is given of the frames asked for, elsewhere MASKED.
            causal: whether a place sees only what is shown at those before it, and at itself.

        Returns:
            logits [B, T - 1, P, F, codes], and features [B, T, P, width] of the frames as they are known.
        """
        x = self._input(tokens, beside)
        y = self._input(shown, None if beside is None else beside[:, 1:]) + self.query
        for block in self.blocks:
            if self.trunk.checkpointing and torch.is_grad_enabled():
                x, y = checkpoint(block, x, y, cond, causal, use_reentrant=False)
            else:
                x, y = block(x, y, cond, causal)
        return self._logits(y, tokens[:, :-1]), self.norm_seen(x)

    # -- rollouts, frame by frame
    def memory(self) -> Memory:
        """Of no frame so far."""
        return Memory([FrameCache() for _ in self.blocks])

    def observe(self, tokens: Tensor, cond: Tensor, beside: Tensor | None, memory: Memory) -> Tensor:
        """Features [B, T, P, width] of frames that go on from a memory, which takes them in."""
        x = self._input(tokens, beside)
        for block, cache in self._each(memory):
            x, _ = block.observe(x, cond, cache, memory.frames)
            cache.space = None
        memory.frames += tokens.shape[1]
        memory.last = tokens[:, -1]
        return self.norm_seen(x)

    def predict(self, shown: Tensor, cond: Tensor, beside: Tensor | None, memory: Memory) -> Tensor:
        """Logits float32 [B, P, F, codes] of the frame after those of a memory; `shown` [B, P, F] is given of
        it.
        """
        y = self._input(shown[:, None], beside) + self.query
        for block, cache in self._each(memory):
            y = block.predict_next(y, cond, cache, memory.frames)
        return self._logits(y, memory.newest()[:, None])[:, 0]

    def predict_place(
        self, place: int, shown: Tensor, cond: Tensor, beside: Tensor | None, memory: Memory
    ) -> Tensor:
        """Logits [B, F, codes] of one place of that frame, where `shown` [B, F] is given there. Places are
        asked for in order, from 0 on.
        """
        here = self._places()[place : place + 1]
        y = self._embed(shown[:, None, None]) + here + self.query
        if beside is not None:
            y = y + beside[:, :, place : place + 1]
        for block, cache in self._each(memory):
            y = block.predict_place(y, cond, cache, place, memory.frames)
        return self._logits(y, memory.newest()[:, None, place : place + 1])[:, 0, 0]

    # -- parts
    def _each(self, memory: Memory) -> Iterator[tuple[STBlock, FrameCache]]:
        return zip((cast(STBlock, block) for block in self.blocks), memory.blocks, strict=True)

    def _embed(self, tokens: Tensor) -> Tensor:
        """[..., width] of tokens [..., F]; zeros where they are MASKED."""
        rows = self.embed(tokens.clamp(min=0) + self.offset)
        return (rows * (tokens != MASKED)[..., None]).sum(-2)

    def _places(self) -> Tensor:
        """Positions [P, width]."""
        grid = self.view[:, None, None] + self.row[:, None] + self.column
        return grid.flatten(0, 2)

    def _input(self, tokens: Tensor, beside: Tensor | None) -> Tensor:
        x = self._embed(tokens) + self._places()
        return x if beside is None else x + beside

    def _logits(self, y: Tensor, before: Tensor) -> Tensor:
        return self.head(self.norm_asked(y), before)
