"""What imagined returns are worth beside true ones, task by task, as recorded episodes alone can tell it.

At a moment of a recorded episode the same world imagines the recorded actions, and others that the policy
draws there. Both imagined returns share all that the moment itself says, so their difference is what the
actions did in imagination; its covariance with the recorded return is what of that is true. A gradient of
imagined returns points along the true one by this correlation, the rest of it is noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_FEWEST = 8  # moments of a task of which anything is told


@dataclass(frozen=True)
class Worth:
    """Of a task.

    Args:
        value: in [0, 1], by which its imagined decisions are weighed.
        measured: the correlation of this task's own moments, and its standard error; None where they tell
            none, because returns do not differ or moments are too few.
        moments: that it was measured on.
    """

    value: float
    measured: tuple[float, float] | None
    moments: int


@dataclass(frozen=True)
class Returns:
    """Returns float32 [N] of N moments, over as many chunks as RL imagines.

    Args:
        true: of the recorded actions, on recorded frames.
        imagined: of the same actions, imagined.
        others: of actions that the policy drew at the same moment, imagined.
        begun: the judge's progress at the moment.
        episode: int64 [N], that the moment belongs to; those of one are not independent.
    """

    true: Tensor
    imagined: Tensor
    others: Tensor
    begun: Tensor
    episode: Tensor

    def __getitem__(self, which: Tensor) -> Returns:
        parts = (self.true, self.imagined, self.others, self.begun, self.episode)
        return Returns(*(part[which] for part in parts))


def worth_by_task(returns: Returns, tasks: Sequence[str]) -> dict[str, Worth]:
    """The worth of each task that occurs in `tasks` [N].

    Few moments tell little of one task, so what is measured in each is drawn towards the mean of all, by as
    much as its standard error says and tasks do not differ (random effects, DerSimonian and Laird 1986). A
    task that tells nothing has that mean; where none tells anything, imagination is taken at its word.
    """
    mine = {name: torch.tensor([task == name for task in tasks]) for name in sorted(set(tasks))}
    measured = {name: correlation(returns[which]) for name, which in mine.items()}
    known = {name: found for name, found in measured.items() if found is not None}
    pooled = dict(zip(known, _pooled(list(known.values())), strict=True))
    mean = _mean(list(known.values()))
    return {
        name: Worth(min(1.0, max(0.0, pooled.get(name, mean))), measured[name], int(which.sum()))
        for name, which in mine.items()
    }


def correlation(returns: Returns) -> tuple[float, float] | None:
    """Of what actions did in imagination with what they truly did, and its standard error (jackknife over
    episodes); None where nothing can be told.
    """
    groups = returns.episode.unique()
    if len(returns.true) < _FEWEST or len(groups) < 3:
        return None
    whole = _correlation(returns)
    left = [_correlation(returns[returns.episode != group]) for group in groups]
    some = torch.tensor([value for value in left if value is not None])
    if whole is None or len(some) < len(groups):
        return None
    spread = (some - some.mean()).square().sum() * (len(some) - 1) / len(some)
    # no error of nothing: so few moments may agree by chance
    least = 1 / len(returns.true) ** 0.5
    return whole, max(float(spread.sqrt()), least)


def _correlation(returns: Returns) -> float | None:
    """The covariance of true returns with the difference of imagined ones, over the spreads of both. Two
    draws differ by twice the variance of one. What moments say of true returns is noise here, as far as
    imagination knows it, and taken from them first: for the covariance by the mean of both draws, which
    does not correlate with their difference; for the spread by the other draw alone, which nothing of the
    recorded actions is in.
    """
    apart = (returns.imagined - returns.others).double()
    apart = apart - apart.mean()
    both = _rest(returns.true, (returns.imagined + returns.others) / 2, returns.begun)
    alone = _rest(returns.true, returns.others, returns.begun)
    scale = (alone.square().mean() * apart.square().mean() / 2).sqrt()
    if not scale > 1e-6:
        return None
    return float((both * apart).mean() / scale)


def _rest(value: Tensor, *known: Tensor) -> Tensor:
    """What is left of values [N] beside a linear function of known ones, float64 [N]."""
    told = torch.stack((torch.ones_like(value), *known), 1).double()
    # columns may be alike, as progress is where it is worth nothing
    fitted = torch.linalg.lstsq(told, value.double()[:, None], driver="gelsd").solution
    return value.double() - (told @ fitted).squeeze(-1)


def _pooled(found: Sequence[tuple[float, float]]) -> list[float]:
    """Each of several estimates (value, standard error), drawn towards their mean."""
    between = _between(found)
    mean = _mean(found)
    return [(value * between + mean * error**2) / (between + error**2) for value, error in found]


def _mean(found: Sequence[tuple[float, float]]) -> float:
    """Of estimates, by how sure they are; 1 of none."""
    between = _between(found)
    weights = [1 / (between + error**2) for _, error in found]
    total = sum(weights)
    return sum(w * value for w, (value, _) in zip(weights, found, strict=True)) / total if found else 1.0


def _between(found: Sequence[tuple[float, float]]) -> float:
    """The variance of what is estimated, beyond that of the estimates."""
    if len(found) < 2:
        return 0.0
    weights = [1 / error**2 for _, error in found]
    total = sum(weights)
    mean = sum(w * value for w, (value, _) in zip(weights, found, strict=True)) / total
    excess = sum(w * (value - mean) ** 2 for w, (value, _) in zip(weights, found, strict=True))
    scale = total - sum(w**2 for w in weights) / total
    return max(0.0, (excess - (len(found) - 1)) / scale)
