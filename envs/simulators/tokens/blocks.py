"""A spatio-temporal block (Genie, Bruce et al. 2024) over two streams: frames that are known, and frames
asked for.

Known frames see themselves and the past. A frame that is asked for sees what is given of itself, and the
known frames before it. In training both streams run side by side, so that every frame of a clip is asked for
at once
under just the conditions of a rollout: its past is clean, whatever of it is masked.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from envs.simulators.tokens.conditioning import PARTS, Conditioning
from envs.simulators.tokens.layers import FeedForward, Keys, TokenAttention, joined, newest, time_rope

_SPACE, _TIME, _FORWARD = range(PARTS)


@dataclass
class FrameCache:
    """What a block keeps of known frames, and of the places already known of the frame asked for.

    Args:
        time: keys and values [B, P, heads, frames, head_dim], the last window - 1 frames.
        space: keys and values [B, 1, heads, places, head_dim], where places are asked for one by one.
    """

    time: Keys | None = None
    space: Keys | None = None


@dataclass
class Memory:
    """Known frames, as the blocks of a transformer remember them.

    Args:
        blocks: a cache for each.
        frames: known so far, those beyond the window included.
        last: tokens [B, P, F] of the last of them.
    """

    blocks: list[FrameCache]
    frames: int = 0
    last: Tensor | None = None

    def newest(self) -> Tensor:
        """Tokens [B, P, F] of the last known frame."""
        assert self.last is not None, "a frame is asked for before any is known"
        return self.last


class STBlock(nn.Module):
    """Attention over the places of a frame, over the frames at a place, its conditioning, and feed-forward.

    Args:
        width, heads, ratio: of its layers.
        window: frames that a frame sees, itself included.
        conditioning: how it is told.
    """

    def __init__(self, width: int, heads: int, ratio: int, window: int, conditioning: Conditioning):
        super().__init__()
        self.window, self.size = window, width // heads
        self.reader = conditioning.reader(width, heads)
        self.space, self.time = TokenAttention(width, heads), TokenAttention(width, heads)
        self.ff = FeedForward(width, ratio)

    def forward(self, x: Tensor, y: Tensor, cond: Tensor, causal: bool) -> tuple[Tensor, Tensor]:
        """Both streams of a clip after the block: its T known frames [B, T, P, width], and those asked for
        [B, T - 1, P, width]; see observe and predict.
        """
        x, known = self.observe(x, cond, FrameCache(), 0)
        return x, self.predict(y, cond[:, 1:], known, causal)

    def observe(self, x: Tensor, cond: Tensor, cache: FrameCache, first: int) -> tuple[Tensor, Keys]:
        """Known frames [B, T, P, width], the first of which has number `first`, after the block; and the keys
        and values of time [B, P, heads, n, head_dim] of those in the cache and of these, which go into it.
        """
        x, count = self._look_around(x, cond, None), x.shape[1]
        rope = time_rope(first, count, self.size, x.device)
        h = self.reader.norm(_TIME, x, cond).transpose(1, 2)
        known = joined(cache.time, self.time.keys_of(h, rope))
        mask = self._before(known[0].shape[-2] - count, count, count, x.device, itself=True)
        x = x + self.reader.gate(_TIME, self.time(h, known, mask, rope).transpose(1, 2), cond)
        cache.time = newest(known, self.window - 1)
        return self._finish(x, cond), known

    def predict(self, y: Tensor, cond: Tensor, known: Keys, causal: bool) -> Tensor:
        """Frames asked for [B, T - 1, P, width], after the block: all but the first of T frames that are
        known.

        Args:
            known: keys and values of time, of all T.
            causal: whether a place sees only those before it, and itself.
        """
        places = y.shape[2]
        order = torch.ones(places, places, dtype=torch.bool, device=y.device).tril() if causal else None
        return self._finish(self._look_back(self._look_around(y, cond, order), cond, known, 1, 1), cond)

    def predict_next(self, y: Tensor, cond: Tensor, cache: FrameCache, number: int) -> Tensor:
        """Frame `number` [B, 1, P, width], the one after those in the cache, after the block."""
        y = self._look_around(y, cond, None)
        return self._finish(self._look_back(y, cond, cache.time, number, _frames(cache.time)), cond)

    def predict_place(self, y: Tensor, cond: Tensor, cache: FrameCache, place: int, number: int) -> Tensor:
        """One place [B, 1, 1, width] of that frame; the cache holds those before it, and takes it in."""
        h = self.reader.norm(_SPACE, y, cond)
        cache.space = joined(cache.space, self.space.keys_of(h))
        y = y + self.reader.gate(_SPACE, self.space(h, cache.space), cond)
        known = cache.time
        here = None if known is None else (known[0][:, place : place + 1], known[1][:, place : place + 1])
        return self._finish(self._look_back(y, cond, here, number, _frames(here)), cond)

    def _look_around(self, y: Tensor, cond: Tensor, mask: Tensor | None) -> Tensor:
        """Attention over space."""
        h = self.reader.norm(_SPACE, y, cond)
        return y + self.reader.gate(_SPACE, self.space(h, self.space.keys_of(h), mask), cond)

    def _look_back(self, y: Tensor, cond: Tensor, known: Keys | None, number: int, past: int) -> Tensor:
        """Attention over time of frames asked for: each to the known ones before it, and to itself.

        Args:
            number: of the first of them, which `past` of the known ones come before.
        """
        count, more = y.shape[1], _frames(known) - past
        rope = time_rope(number, count, self.size, y.device)
        h = self.reader.norm(_TIME, y, cond).transpose(1, 2)
        keys = joined(known, self.time.keys_of(h, rope))
        itself = torch.eye(count, dtype=torch.bool, device=y.device)
        mask = torch.cat((self._before(past, count, more, y.device, itself=False), itself), 1)
        return y + self.reader.gate(_TIME, self.time(h, keys, mask, rope).transpose(1, 2), cond)

    def _before(self, past: int, count: int, more: int, device: torch.device, itself: bool) -> Tensor:
        """Which of `past` + `more` frames those from number `past` on see, bool [count, past + more]."""
        number = past + torch.arange(count, device=device)[:, None]
        other = torch.arange(past + more, device=device)
        latest = number if itself else number - 1
        return (other <= latest) & (other > number - self.window)

    def _finish(self, x: Tensor, cond: Tensor) -> Tensor:
        x = self.reader.read(x, cond)
        return x + self.reader.gate(_FORWARD, self.ff(self.reader.norm(_FORWARD, x, cond)), cond)


def _frames(known: Keys | None) -> int:
    return 0 if known is None else known[0].shape[-2]
