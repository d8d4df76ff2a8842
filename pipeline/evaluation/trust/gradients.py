"""How much of a policy gradient is signal, and whether two kinds of experience point the same way.

The gradient of a batch is the gradient of the expected loss plus noise that falls with the batch's size. What
independent batches share is the signal: E[g_i . g_j] = |G|^2 for i != j, while E|g_i|^2 = |G|^2 + S / n for
batches of n decisions (the gradient noise scale of McCandlish et al. 2018 is S / |G|^2, the decisions whose
gradient is half signal). Between gradients of imagined and of recorded decisions the same products tell the
cosine of the true directions, which no noise makes smaller.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from learners.rl.algorithm import Algorithm

PER = 1000  # decisions, of which signal is told
# Standard errors by which a signal must stand out before its direction is compared. The jackknife tells those
# of products of few batches a quarter too large or more, so 1.5 are rather 2.
_SURE = 1.5


@dataclass(frozen=True)
class Measured:
    """A figure and its standard error, by the jackknife over batches."""

    value: float
    error: float

    @property
    def found(self) -> bool:
        """Whether it stands out of its error."""
        return self.value > _SURE * self.error

    def interval(self, form: str = ".3f") -> str:
        """The value and two standard errors to either side, as text."""
        low, high = self.value - 2 * self.error, self.value + 2 * self.error
        return f"{self.value:{form}} [{low:{form}}, {high:{form}}]"


def plain_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row as JSON takes it, whatever in it was measured."""
    return {key: asdict(cell) if isinstance(cell, Measured) else cell for key, cell in row.items()}


def policy_gradient(algorithm: Algorithm, policy: nn.Module, data: TensorDict, minibatch: int) -> Tensor:
    """Gradient float32 [P] of the algorithm's loss on transitions [N] over the parameters that are trained,
    in parts of `minibatch` as RL takes them, at the policy that collected them.
    """
    trained = [p for p in policy.parameters() if p.requires_grad]
    total = torch.zeros(sum(p.numel() for p in trained))
    for part in data.split(minibatch):
        loss, _ = algorithm.loss(part)
        found = torch.autograd.grad(loss, trained, allow_unused=True)
        flat = [torch.zeros_like(p) if g is None else g for p, g in zip(trained, found, strict=True)]
        total += torch.cat([g.flatten() for g in flat]).float().cpu() * (len(part) / len(data))
    return total


def signal(gradients: Tensor, decisions: float) -> Measured:
    """Signal per PER decisions: |G|^2 over the variance that the gradient of so many decisions has.

    Args:
        gradients: [M, P] of M >= 3 batches.
        decisions: of a batch, on average.
    """
    products = gradients.double() @ gradients.double().T

    def of(keep: Tensor) -> float:
        shared, whole = _shared(products[keep][:, keep])
        return PER / decisions * shared / max(whole - shared, 1e-30)

    return _jackknifed(of, len(gradients))


def alignment(one: Tensor, other: Tensor, apart: bool = True) -> Measured | None:
    """Cosine of the true directions behind two sets of gradients [M, P] and [N, P], or None where one of
    them has no signal that stands out.

    Args:
        apart: False: batch m of both is of the same decisions, whose noise is left out.
    """
    sets = [one.double(), other.double()]
    if not all(signal(g, PER).found for g in sets):
        return None
    mine, theirs, between = sets[0] @ sets[0].T, sets[1] @ sets[1].T, sets[0] @ sets[1].T

    def of(rows: Tensor, columns: Tensor) -> float:
        cross = between[rows][:, columns]
        if not apart:
            cross = cross[rows[:, None] != columns]
        lengths = _shared(mine[rows][:, rows])[0] * _shared(theirs[columns][:, columns])[0]
        return float(cross.mean() / max(lengths, 1e-30) ** 0.5)

    if not apart:
        return _jackknifed(lambda keep: of(keep, keep), len(one))
    rows, columns = torch.arange(len(one)), torch.arange(len(other))
    parts = (
        _jackknifed(lambda keep: of(keep, columns), len(one)),
        _jackknifed(lambda keep: of(rows, keep), len(other)),
    )
    return Measured(parts[0].value, (parts[0].error ** 2 + parts[1].error ** 2) ** 0.5)


def _shared(products: Tensor) -> tuple[float, float]:
    """|G|^2 and E|g|^2 of batches by their products [M, M]."""
    count, own = len(products), products.diag().sum()
    return float((products.sum() - own) / (count * (count - 1))), float(own / count)


def _jackknifed(of: Callable[[Tensor], float], count: int) -> Measured:
    """A figure of `count` batches, and its error by leaving each of them out."""
    every = torch.arange(count)
    left = torch.tensor([of(every[every != out]) for out in range(count)], dtype=torch.float64)
    spread = (left - left.mean()).square().sum() * (count - 1) / count
    return Measured(of(every), float(spread.sqrt()))
