"""In which order the tokens of a frame are decided: all at once in a few steps, or place after place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from envs.ranges import Count, NonNegative
from envs.simulators.tokens.transformer import MASKED


class Draws:
    """Uniform numbers for a batch, row by row from generators of their own: the same in any batch.

    Args:
        generators: one a row.
        device: of the numbers.
    """

    def __init__(self, generators: Sequence[torch.Generator], device: torch.device):
        self.generators, self.device = generators, device

    def __call__(self, *shape: int) -> Tensor:
        """float32 [B, *shape] in 0..1."""
        return torch.stack([torch.rand(shape, generator=each) for each in self.generators]).to(self.device)


class NextFrame(Protocol):
    """A frame whose tokens are to be predicted."""

    def all(self, shown: Tensor) -> Tensor:
        """Logits [B, P, F, codes] of all places, of which `shown` [B, P, F] is given, elsewhere MASKED."""

    def place(self, number: int, shown: Tensor) -> Tensor:
        """Logits [B, F, codes] of one place where `shown` [B, F] is given; places are asked for in order."""


class Decoding(Protocol):
    """An order of decisions; a config names its class."""

    @property
    def causal(self) -> bool:
        """Whether places see only those before them, and themselves."""

    def shown(self, tokens: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """What training gives of frames int64 [B, T, P, F], and where answers count, bool [B, T, P]."""

    def decide(self, frame: NextFrame, places: int, factors: int, draws: Draws) -> Tensor:
        """Tokens int64 [B, P, F] of a frame."""


@dataclass(frozen=True)
class MaskGIT:
    """All places at once, in steps: of the sampled ones the surest stays, by a cosine schedule (Chang et
    al. 2022).

    Args:
        steps: passes per frame.
        temperature: of the draws; 0 takes the likeliest tokens.
    """

    steps: Count
    temperature: NonNegative
    causal = False

    def shown(self, tokens: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """See Decoding: of every frame a random set of places is masked, by the same cosine."""
        batch, frames, places, _ = tokens.shape
        share = torch.cos(math.pi / 2 * torch.rand(batch, frames, 1, generator=generator))
        rank = torch.rand(batch, frames, places, generator=generator).argsort(-1).argsort(-1)
        masked = (rank < (share * places).ceil().clamp(min=1)).to(tokens.device)
        return torch.where(masked[..., None], MASKED, tokens), masked

    def decide(self, frame: NextFrame, places: int, factors: int, draws: Draws) -> Tensor:
        """See Decoding."""
        batch = len(draws.generators)
        tokens = torch.full((batch, places, factors), MASKED, device=draws.device)
        for step in range(1, self.steps + 1):
            sampled, sure = sample(frame.all(tokens), self.temperature, draws)
            open_still = (tokens == MASKED).any(-1)
            known = places - math.floor(places * math.cos(math.pi / 2 * step / self.steps) + 1e-6)
            sure = torch.where(open_still, sure.sum(-1), torch.inf)  # what stays, stays
            rank = sure.argsort(dim=-1, descending=True, stable=True).argsort(dim=-1)
            take = open_still & (rank < known)
            tokens = torch.where(take[..., None], sampled, tokens)
        return tokens


@dataclass(frozen=True)
class Raster:
    """One place after another, row by row and view by view, each seeing those before it.

    Args:
        temperature: of the draws; 0 takes the likeliest tokens.
    """

    temperature: NonNegative
    causal = True

    def shown(self, tokens: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """See Decoding: every place is shown the tokens of the one before it."""
        shifted = torch.cat((torch.full_like(tokens[:, :, :1], MASKED), tokens[:, :, :-1]), 2)
        return shifted, torch.ones_like(tokens[..., 0], dtype=torch.bool)

    def decide(self, frame: NextFrame, places: int, factors: int, draws: Draws) -> Tensor:
        """See Decoding."""
        last = torch.full((len(draws.generators), factors), MASKED, device=draws.device)
        decided = []
        for place in range(places):
            last, _ = sample(frame.place(place, last), self.temperature, draws)
            decided.append(last)
        return torch.stack(decided, 1)


def sample(logits: Tensor, temperature: float, draws: Draws) -> tuple[Tensor, Tensor]:
    """Tokens int64 [...] drawn from logits [..., codes], and their log probabilities."""
    logits = logits.float()
    if temperature:
        below = (logits / temperature).softmax(-1).cumsum(-1)
        chance = draws(*logits.shape[1:-1])[..., None] * below[..., -1:]
        tokens = (below <= chance).sum(-1).clamp(max=logits.shape[-1] - 1)
    else:
        tokens = logits.argmax(-1)
    return tokens, logits.log_softmax(-1).gather(-1, tokens[..., None])[..., 0]
