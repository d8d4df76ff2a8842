"""A Gaussian over whole action chunks: the randomness lives in a few knots, so that exploration is smooth in
time.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.distributions import Distribution, constraints, register_kl

from actors.policies.heads import Head, some_drawn
from envs.ranges import Count, Positive
from envs.specs import ActionMode


def knot_basis(chunk: int, knots: int, from_rest: bool) -> Tensor:
    """Linear interpolation [chunk, knots] through knots spread evenly over a chunk, the last at its end.

    Args:
        from_rest: interpolation begins at 0 just before the first action, as offsets from the command in
            force do; otherwise the first knot is the first action.
    """
    times = torch.arange(1, chunk + 1, dtype=torch.float32)
    if not from_rest and knots == 1:
        return torch.ones(chunk, 1)
    places = torch.linspace(0, chunk, knots + 1)[1:] if from_rest else torch.linspace(1, chunk, knots)
    between = chunk / knots if from_rest else (chunk - 1) / (knots - 1)
    return (1 - (times[:, None] - places).abs() / between).clamp(min=0)


class ChunkGaussian(Distribution):
    """chunk = offset + gain * basis @ knots with knots ~ Normal(loc, scale); dimensions with gain 0 are
    constant.

    The density is that of the knots; a chunk determines them exactly (the basis has full column rank), so
    likelihood ratios are those of the chunk. It is the density of chunks that are drawn; where the mode was
    taken instead (heads.some_drawn) its gradient with respect to the mean is zero as long as the mean stays;
    once it moves, a mode that did well pulls it back, which holds PPO near it (docs/results/trust.md).
    With respect to the spread it is not: every mode would tell it to shrink. So the spread learns only where
    all chunks are drawn.

    Args:
        loc: [..., n, A] mean knots in normalised units.
        scale: [..., n, A] standard deviations.
        basis: [K, n]; gain and offset: [A] in action units.
        share: [...] of chunks that are drawn.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {"loc": constraints.real, "scale": constraints.positive}
    has_rsample = True

    def __init__(
        self,
        loc: Tensor,
        scale: Tensor,
        basis: Tensor,
        gain: Tensor,
        offset: Tensor,
        share: Tensor,
        validate_args: bool | None = None,
    ):
        self.loc, self.scale, self.share = loc, scale, share
        # TensorDict hands shared tensors over with batch dimensions; every row is the same
        shared = basis.ndim - 2
        self.basis = basis[(0,) * shared]
        self.gain, self.offset = gain[(0,) * (gain.ndim - 1)], offset[(0,) * (offset.ndim - 1)]
        self.active = self.gain > 0
        super().__init__(
            loc.shape[:-2], torch.Size([self.basis.shape[0], loc.shape[-1]]), validate_args=False
        )

    def _decode(self, knots: Tensor) -> Tensor:
        return self.offset + self.gain * (self.basis @ knots)

    def _encode(self, chunk: Tensor) -> Tensor:
        safe = torch.where(self.active, self.gain, 1.0)
        return torch.linalg.pinv(self.basis) @ ((chunk - self.offset) / safe)

    @property
    def mean(self) -> Tensor:
        return self._decode(self.loc)

    @property
    def mode(self) -> Tensor:
        return self.mean

    deterministic_sample = mean

    def rsample(self, sample_shape: Any = ()) -> Tensor:
        shape = (*sample_shape, *self.loc.shape)
        knots = self.loc + self.scale * torch.randn(shape, device=self.loc.device)
        return some_drawn(self._decode(knots), self.mode, self.share)

    def sample(self, sample_shape: Any = ()) -> Tensor:
        with torch.no_grad():
            return self.rsample(sample_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        every = (self.share >= 1)[..., None, None]
        scale = torch.where(every, self.scale, self.scale.detach())
        normal = torch.distributions.Normal(self.loc, scale, validate_args=False)
        return (normal.log_prob(self._encode(value)) * self.active).sum((-2, -1))

    def entropy(self) -> Tensor:
        return (
            torch.distributions.Normal(self.loc, self.scale, validate_args=False).entropy() * self.active
        ).sum((-2, -1))

    def held(self) -> ChunkGaussian:
        """The same with a spread that does not learn."""
        return ChunkGaussian(self.loc, self.scale.detach(), self.basis, self.gain, self.offset, self.share)


@register_kl(ChunkGaussian, ChunkGaussian)
def _kl(p: ChunkGaussian, q: ChunkGaussian) -> Tensor:
    """KL(p || q) in nats, [...], over the dimensions that vary."""
    ratio = (p.scale / q.scale).square()
    shift = ((p.loc - q.loc) / q.scale).square()
    return (0.5 * (ratio + shift - 1 - ratio.log()) * p.active).sum((-2, -1))


class ChunkGaussianHead(Head):
    """Mean and spread of the knots of a chunk; spreads are learned and do not depend on the observation.

    Args:
        width: of the hidden vector.
        chunk: actions per chunk, K.
        actions: numbers of an action, A.
        knots: free points per dimension and chunk.
        std: initial spread, in units of the demonstrations' own spread.
        mode: how the chunk's numbers are meant; relative ones begin where the robot is.
    """

    names = ("loc", "scale", "basis", "gain", "offset", "share")
    distribution = ChunkGaussian
    basis: Tensor
    gain: Tensor
    offset: Tensor

    def __init__(
        self,
        width: int,
        chunk: int,
        actions: int,
        knots: Count,
        std: Positive,
        mode: Literal["relative", "absolute"],
    ):
        super().__init__()
        if not 1 <= knots <= chunk:
            raise ValueError(f"knots={knots} must be between 1 and task.chunk={chunk}")
        self.chunk, self.knots, self.actions, self.std = chunk, knots, actions, std
        self.mean = nn.Linear(width, knots * actions)
        nn.init.normal_(self.mean.weight, std=1e-2)
        nn.init.zeros_(self.mean.bias)
        self.log_std = nn.Parameter(torch.full((knots, actions), float(torch.tensor(std).log())))
        self.from_rest = ActionMode(mode) is ActionMode.RELATIVE
        self.register_buffer("basis", knot_basis(chunk, knots, self.from_rest))
        self.register_buffer("gain", torch.ones(actions))
        self.register_buffer("offset", torch.zeros(actions))

    def forward(self, hidden: Tensor) -> tuple[Tensor, ...]:
        loc = self.mean(hidden.float()).unflatten(-1, (self.knots, self.actions))
        scale = self.log_std.clamp(-4.0, 0.5).exp().expand_as(loc)
        lead = hidden.shape[:-1]
        return (
            loc,
            scale,
            self.basis.expand(*lead, *self.basis.shape),
            self.gain.expand(*lead, -1),
            self.offset.expand(*lead, -1),
            self.share.expand(lead),
        )

    def normalise(self, chunks: Tensor, varies: Tensor) -> None:
        """See Head.normalise; the knots of numbers that vary get unit spread."""
        centre = chunks.flatten(0, 1).mean(0)
        middle = torch.zeros_like(centre) if self.from_rest else centre
        spread = (torch.linalg.pinv(self.basis) @ (chunks - middle)).flatten(0, 1).std(0)
        active = varies & (spread > 0)
        self.gain.copy_(torch.where(active, spread, 0.0))
        self.offset.copy_(torch.where(active, middle, centre))

    @property
    def varies(self) -> Tensor:
        """See Head.varies."""
        return self.gain > 0

    def target(self, chunks: Tensor) -> Tensor:
        """Knots [N, knots, A] in normalised units."""
        gain = torch.where(self.gain > 0, self.gain, torch.ones_like(self.gain))
        return torch.linalg.pinv(self.basis) @ ((chunks - self.offset) / gain)

    def error(self, hidden: Tensor, target: Tensor) -> Tensor:
        """Mean absolute error of the knots that vary, in units of the demonstrations' spread."""
        active = (self.gain > 0).float()
        error = (self(hidden)[0] - target).abs() * active
        return error.sum() / (active.sum().clamp(min=1) * error.shape[0] * error.shape[1])

    @torch.no_grad()
    def scale_spread(self, width: float) -> None:
        """Multiply the standard deviations."""
        self.log_std.add_(math.log(width))

    @property
    def exploration(self) -> float:
        """See Head.exploration: the geometric mean of all spreads says it."""
        return math.exp(float(self.log_std.detach().mean())) / self.std
