"""What imagined returns are worth beside true ones, task by task, as recorded episodes alone can tell it.

At a moment of a recorded episode the same world imagines the recorded actions, and others that the policy
draws there. Both imagined returns share all that the moment itself says, so their difference is what the
actions did in imagination; its covariance with the recorded return is what of that is true. A gradient of
imagined returns points along the true one by this correlation, the rest of it is noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import scipy
import torch
from torch import Tensor

Estimate = tuple[float, float]  # and its standard error

_FEWEST = 8  # moments of a task of which anything is told
_AGES = 2**0.5  # times a standard error grows with each round of training


@dataclass(frozen=True)
class Worth:
    """Of a task.

    Args:
        value: in [0, 1], by which its imagined decisions are weighed.
        measured: the correlation of this task's own moments, and its standard error; None where they tell
            none, because returns do not differ or moments are too few.
        known: that, and what was known of earlier worlds.
        moments: that it was measured on.
    """

    value: float
    measured: Estimate | None
    known: Estimate | None
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


def worth_by_task(
    returns: Returns, tasks: Sequence[str], earlier: Mapping[str, Estimate] | None = None
) -> dict[str, Worth]:
    """The worth of each task that occurs in `tasks` [N].

    Few moments tell little of one task. What was known before the world learned more is taken with them, with
    twice the variance; and each task is drawn towards the mean of all, by as much as its standard error says
    and tasks do not differ (random effects, DerSimonian and Laird 1986). A task that tells nothing has that
    mean; where none tells anything, imagination is taken at its word.

    Args:
        earlier: what was known of tasks then (Worth.known).
    """
    mine = {name: torch.tensor([task == name for task in tasks]) for name in sorted(set(tasks))}
    measured = {name: correlation(returns[which]) for name, which in mine.items()}
    known = {name: _joined(found, (earlier or {}).get(name)) for name, found in measured.items()}
    told = {name: one for name, one in known.items() if one is not None}
    pooled, mean = dict(zip(told, _pooled(list(told.values())), strict=True)), _mean(list(told.values()))
    return {
        name: Worth(min(1.0, max(0.0, pooled.get(name, mean))), measured[name], known[name], int(which.sum()))
        for name, which in mine.items()
    }


def _joined(now: Estimate | None, earlier: Estimate | None) -> Estimate | None:
    """What is known of a task, by what was measured now and what was known earlier."""
    old = None if earlier is None else (earlier[0], earlier[1] * _AGES)
    found = [one for one in (now, old) if one is not None]
    if not found:
        return None
    weights = [1 / error**2 for _, error in found]
    value = sum(w * value for w, (value, _) in zip(weights, found, strict=True)) / sum(weights)
    return value, sum(weights) ** -0.5


def correlation(returns: Returns) -> Estimate | None:
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
    imagination knows it, and taken from them first: for the covariance by the mean of both draws, which does
    not correlate with their difference; for the spread by the other draw alone, which nothing of the recorded
    actions is in.

    Returns count by their ranks (normal scores): where successes are rare and paid well, two of them would
    decide.
    """
    true, begun = _scores(returns.true), _scores(returns.begun)
    imagined, others = _scores(torch.cat((returns.imagined, returns.others))).chunk(2)
    apart = imagined - others
    apart = apart - apart.mean()
    both, alone = _rest(true, (imagined + others) / 2, begun), _rest(true, others, begun)
    scale = (alone.square().mean() * apart.square().mean() / 2).sqrt()
    if not scale > 1e-6:
        return None
    return float((both * apart).mean() / scale)


def _scores(values: Tensor) -> Tensor:
    """Normal quantiles float64 [N] of the ranks of values [N]; those that are alike share theirs."""
    ranks = torch.from_numpy(scipy.stats.rankdata(values.numpy()))
    return torch.special.ndtri((ranks - 0.5) / len(values))


def _rest(value: Tensor, *known: Tensor) -> Tensor:
    """What is left of values float64 [N] beside a linear function of known ones."""
    told = torch.stack((torch.ones_like(value), *known), 1)
    # columns may be alike, as progress is where it is worth nothing
    fitted = torch.linalg.lstsq(told, value[:, None], driver="gelsd").solution
    return value - (told @ fitted).squeeze(-1)


def _pooled(found: Sequence[Estimate]) -> list[float]:
    """Each of several estimates (value, standard error), drawn towards their mean."""
    between = _between(found)
    mean = _mean(found)
    return [(value * between + mean * error**2) / (between + error**2) for value, error in found]


def _mean(found: Sequence[Estimate]) -> float:
    """Of estimates, by how sure they are; 1 of none."""
    between = _between(found)
    weights = [1 / (between + error**2) for _, error in found]
    total = sum(weights)
    return sum(w * value for w, (value, _) in zip(weights, found, strict=True)) / total if found else 1.0


def _between(found: Sequence[Estimate]) -> float:
    """The variance of what is estimated, beyond that of the estimates."""
    if len(found) < 2:
        return 0.0
    weights = [1 / error**2 for _, error in found]
    total = sum(weights)
    mean = sum(w * value for w, (value, _) in zip(weights, found, strict=True)) / total
    excess = sum(w * (value - mean) ** 2 for w, (value, _) in zip(weights, found, strict=True))
    scale = total - sum(w**2 for w in weights) / total
    return max(0.0, (excess - (len(found) - 1)) / scale)
