"""Action tokens (Brohan et al. 2023, RT-2): every number of a chunk is one of a few bins, said independently
of the others.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributions import Distribution, constraints, register_kl

from actors.policies.heads import Head, some_drawn
from envs.ranges import Count


class ChunkTokens(Distribution):
    """chunk[k, a] = low[a] + (bin + 1/2) / bins * (high[a] - low[a]) with bin ~ Categorical(logits[k, a]) for
    the share of chunks that are drawn; the others are the mode (heads.some_drawn).

    Dimensions with low = high are constant and count neither in the density nor in the entropy, which is that
    of drawn chunks, as is the KL divergence.

    Args:
        logits: [..., K, A, bins].
        low, high: [A] in action units.
        share: [...] of chunks that are drawn.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {"logits": constraints.real_vector}

    def __init__(
        self, logits: Tensor, low: Tensor, high: Tensor, share: Tensor, validate_args: bool | None = None
    ):
        self.log_probs, self.share = logits.log_softmax(-1), share
        # TensorDict hands shared tensors over with batch dimensions; every row is the same.
        self.low, self.high = low[(0,) * (low.ndim - 1)], high[(0,) * (high.ndim - 1)]
        self.active = self.high > self.low
        self.bins = logits.shape[-1]
        super().__init__(logits.shape[:-3], logits.shape[-3:-1], validate_args=False)

    def _decode(self, bins: Tensor) -> Tensor:
        return self.low + (bins + 0.5) / self.bins * (self.high - self.low)

    @property
    def mode(self) -> Tensor:
        return self._decode(self.log_probs.argmax(-1))

    @property
    def mean(self) -> Tensor:
        middles = torch.arange(self.bins, device=self.log_probs.device)
        return self._decode((self.log_probs.exp() * middles).sum(-1))

    deterministic_sample = mode

    def sample(self, sample_shape: Any = ()) -> Tensor:
        with torch.no_grad():
            # NaN shows in the log-probability; drawing from it would raise for all rows
            probs = self.log_probs.exp().nan_to_num(1.0)
            drawn = torch.multinomial(
                probs.flatten(0, -2), max(1, torch.Size(sample_shape).numel()), replacement=True
            )
            drawn = drawn.movedim(-1, 0).reshape(*sample_shape, *probs.shape[:-1])
            return some_drawn(self._decode(drawn), self.mode, self.share)

    def log_prob(self, value: Tensor) -> Tensor:
        bins = bins_of(value, self.low, self.high, self.bins)
        said = self.log_probs.expand(*value.shape, self.bins).gather(-1, bins.unsqueeze(-1)).squeeze(-1)
        drawn = self.share.log() + (said * self.active).sum((-2, -1))
        at_mode = ((bins == self.log_probs.argmax(-1)) | ~self.active).all(-1).all(-1)
        return torch.where(at_mode, torch.logaddexp(drawn, torch.log1p(-self.share)), drawn)

    def entropy(self) -> Tensor:
        return -((self.log_probs.exp() * self.log_probs).sum(-1) * self.active).sum((-2, -1))

    def held(self) -> ChunkTokens:
        """All of its chunks drawn; how sure tokens are cannot be told from which they are."""
        return ChunkTokens(self.log_probs, self.low, self.high, torch.ones_like(self.share))


@register_kl(ChunkTokens, ChunkTokens)
def _kl(p: ChunkTokens, q: ChunkTokens) -> Tensor:
    """KL(p || q) in nats, [...], over the dimensions that vary."""
    return ((p.log_probs.exp() * (p.log_probs - q.log_probs)).sum(-1) * p.active).sum((-2, -1))


def bins_of(chunk: Tensor, low: Tensor, high: Tensor, bins: int) -> Tensor:
    """Bin numbers int64 [..., K, A] of chunks [..., K, A]; beyond the ends, the last ones."""
    share = (chunk - low) / torch.where(high > low, high - low, torch.ones_like(low))
    return (share * bins).floor().long().clamp(0, bins - 1)


class ChunkTokenHead(Head):
    """Logits of the bins of every number of a chunk.

    Args:
        width: of the hidden vector.
        chunk: actions per chunk, K.
        actions: numbers of an action, A.
        bins: per number; they span -1..1 until `normalise` finds another range.
    """

    names = ("logits", "low", "high", "share")
    distribution = ChunkTokens
    low: Tensor
    high: Tensor

    def __init__(self, width: int, chunk: int, actions: int, bins: Count):
        super().__init__()
        self.chunk, self.bins, self.actions = chunk, bins, actions
        self.logits = nn.Linear(width, chunk * actions * bins)
        nn.init.normal_(self.logits.weight, std=1e-2)
        nn.init.zeros_(self.logits.bias)
        self.register_buffer("low", torch.full((actions,), -1.0))
        self.register_buffer("high", torch.full((actions,), 1.0))

    def forward(self, hidden: Tensor) -> tuple[Tensor, ...]:
        logits = self.logits(hidden.float()).unflatten(-1, (self.chunk, self.actions, self.bins))
        lead = hidden.shape[:-1]
        return logits, self.low.expand(*lead, -1), self.high.expand(*lead, -1), self.share.expand(lead)

    def normalise(self, chunks: Tensor, varies: Tensor) -> None:
        """See Head.normalise; the bins span the demonstrations and a tenth more on either side."""
        rows = chunks.flatten(0, 1)
        low, high, centre = rows.amin(0), rows.amax(0), rows.mean(0)
        active, margin = varies & (high > low), 0.1 * (high - low)
        self.low.copy_(torch.where(active, low - margin, centre))
        self.high.copy_(torch.where(active, high + margin, centre))

    @property
    def varies(self) -> Tensor:
        """See Head.varies."""
        return self.high > self.low

    def target(self, chunks: Tensor) -> Tensor:
        """Bin numbers [N, K, A]."""
        return bins_of(chunks, self.low, self.high, self.bins)

    def error(self, hidden: Tensor, target: Tensor) -> Tensor:
        """Cross-entropy per number that varies, in nats."""
        wrong = F.cross_entropy(self(hidden)[0].flatten(0, -2), target.flatten(), reduction="none").view(
            target.shape
        )
        active = self.varies.float()
        return (wrong * active).sum() / (active.sum().clamp(min=1) * target.shape[0] * target.shape[1])

    @torch.no_grad()
    def scale_spread(self, width: float) -> None:
        """Multiply the temperature at which tokens are drawn, by dividing the logits."""
        self.logits.weight.div_(width)
        self.logits.bias.div_(width)
