"""The spatio-temporal transformer of RoboScape-R: from tokens so far, and what is told, to the next frame's.

The action world and the text world are this one class, each with weights of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn

from envs.ranges import Count
from envs.simulators.row_linear import RowLinear
from envs.simulators.tokens.blocks import FrameCache, Memory, STBlock
from envs.simulators.tokens.conditioning import Conditioning

MASKED = -1  # stands for a token that is not known

_SMALL = 0.02


@dataclass(frozen=True)
class Trunk:
    """Sizes of the transformer.

    Args:
        layers: blocks.
        width: numbers of a token.
        heads: of every attention; a divisor of the width.
        ratio: of the feed-forward's width to the tokens'.

    Raises:
        ValueError: if the width is no multiple of the heads with an even number of channels each.
    """

    layers: Count
    width: Count
    heads: Count
    ratio: Count

    def __post_init__(self) -> None:
        if self.width % (2 * self.heads):
            raise ValueError(f"net.width={self.width} must be a multiple of 2 * net.heads={2 * self.heads}")


@dataclass(frozen=True)
class Vocabulary:
    """The tokens of a frame.

    Args:
        views, rows, columns: of the places of a frame.
        factors: tokens of a place.
        codes: different tokens of a factor.
    """

    views: int
    rows: int
    columns: int
    factors: int
    codes: int

    @property
    def places(self) -> int:
        """Of a frame, view by view and row by row, P."""
        return self.views * self.rows * self.columns


class SpatioTemporalTransformer(nn.Module):
    """See the module's docstring. P are places, F factors; `told` are tokens [B, T, N, width], and `beside`
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
        self.vocabulary, width, v = vocabulary, trunk.width, vocabulary
        self.embed = nn.Embedding(v.factors * v.codes, width)
        self.register_buffer("offset", v.codes * torch.arange(v.factors), persistent=False)
        self.view, self.row, self.column = (
            nn.Parameter(_SMALL * torch.randn(count, width)) for count in (v.views, v.rows, v.columns)
        )
        self.asked = nn.Parameter(_SMALL * torch.randn(width))
        self.blocks = nn.ModuleList(
            STBlock(width, trunk.heads, trunk.ratio, window, conditioning) for _ in range(trunk.layers)
        )
        self.norm_seen, self.norm_asked = nn.LayerNorm(width), nn.LayerNorm(width)
        self.head = RowLinear(width, v.factors * v.codes)

    def forward(
        self, tokens: Tensor, shown: Tensor, told: Tensor, beside: Tensor | None, causal: bool
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
        y = self._input(shown, None if beside is None else beside[:, 1:]) + self.asked
        for block, cache in self._each(self.memory()):
            x, known = block.observe(x, told, cache, 0)
            y = block.ask(y, told[:, 1:], known, causal)
        return self._logits(y), self.norm_seen(x)

    # -- rollouts, frame by frame
    def memory(self) -> Memory:
        """Of no frame so far."""
        return Memory([FrameCache() for _ in self.blocks])

    def observe(self, tokens: Tensor, told: Tensor, beside: Tensor | None, memory: Memory) -> Tensor:
        """Features [B, T, P, width] of frames that go on from a memory, which takes them in."""
        x = self._input(tokens, beside)
        for block, cache in self._each(memory):
            x, _ = block.observe(x, told, cache, memory.frames)
            cache.space = None
        memory.frames += tokens.shape[1]
        return self.norm_seen(x)

    def ask(self, shown: Tensor, told: Tensor, beside: Tensor | None, memory: Memory) -> Tensor:
        """Logits [B, P, F, codes] of the frame after those of a memory; `shown` [B, P, F] is given of it."""
        y = self._input(shown[:, None], beside) + self.asked
        for block, cache in self._each(memory):
            y = block.ask_next(y, told, cache, memory.frames)
        return self._logits(y)[:, 0]

    def ask_place(
        self, place: int, shown: Tensor, told: Tensor, beside: Tensor | None, memory: Memory
    ) -> Tensor:
        """Logits [B, F, codes] of one place of that frame, where `shown` [B, F] is given there. Places are
        asked for in order, from 0 on.
        """
        here = self._places()[place : place + 1]
        y = self._embed(shown[:, None, None]) + here + self.asked
        if beside is not None:
            y = y + beside[:, :, place : place + 1]
        for block, cache in self._each(memory):
            y = block.ask_place(y, told, cache, place, memory.frames)
        return self._logits(y)[:, 0, 0]

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

    def _logits(self, y: Tensor) -> Tensor:
        v = self.vocabulary
        return self.head(self.norm_asked(y)).unflatten(-1, (v.factors, v.codes))
