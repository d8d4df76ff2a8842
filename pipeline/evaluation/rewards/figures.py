"""How well rewards tell how an episode goes: along its frames against true progress, and at its end against
true success.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.episodes.privileged import read_privileged
from envs.judges.base import Judge
from envs.judges.labels import progress_to_success
from envs.rng import resampling_generator
from envs.specs import Status
from pipeline.evaluation.judging import Scores, episode_success

PROGRESS = "progress"  # privileged: a suite's own progress in 0..1
BY_PHYSICS, BY_TIME = "the suite's own progress", "the discounted time to recorded success"
_RESAMPLES = 400  # of the episodes, for intervals
_DISCOUNT = 0.93  # of the time to success; ranks within an episode are the same with any


@dataclass(frozen=True)
class Truth:
    """What truly happened in N labelled episodes of T frames.

    Args:
        progress: float32 [N, T] in 0..1.
        success: bool [N].
        valid: bool [N, T], frames that exist.
        source: what progress is, in words.
    """

    progress: Tensor
    success: Tensor
    valid: Tensor
    source: str


def truth_of(store: ClipStore, episodes: Tensor) -> Truth:
    """The truth about all frames but the first of labelled episodes int64 [N]."""
    rows, valid = store.whole(episodes)
    known = read_privileged(store, PROGRESS)
    if known is None:
        progress, source = progress_to_success(store.arrays["success"][rows], _DISCOUNT), BY_TIME
    else:
        progress, source = known.reshape(len(known), -1)[:, 0][rows].clamp(0, 1), BY_PHYSICS
    return Truth(progress, episode_success(store, episodes), valid, source)


def by_rule(truth: Truth) -> Scores:
    """The rule's own scores: true progress, and success in the last frame of those episodes that had any."""
    last = truth.valid.long().cumsum(1).argmax(1)
    at_end = torch.arange(truth.valid.shape[1])[None] == last[:, None]
    known = torch.full_like(last, Status.OK.value)
    return Scores((at_end & truth.success[:, None]).float(), truth.progress, known)


def figures(judge: Judge, scores: Scores, truth: Truth, seed: int) -> dict[str, Any]:
    """How far a reward follows the truth.

    Returns:
        within: Spearman's correlation of its progress with true progress over the frames of one episode, mean
        over the episodes in which true progress varies (a reward that does not vary there counts as 0);
        pooled: the same over all frames of all episodes; auc: of its confidence that an episode succeeded,
        against true success. Each of within and auc is [value, low, high], 95% by resampling episodes; None
        where it cannot be said. dropped: how many episodes it could not judge, which are left out.
    """
    judged, dropped = scores.judged, int((~scores.judged).sum())
    scores = Scores(*(values[judged] for values in scores))
    truth = Truth(truth.progress[judged], truth.success[judged], truth.valid[judged], truth.source)
    over = ~truth.valid
    confidence = judge.confidence(scores.success.masked_fill(over, 0.0)).double().numpy()
    each = np.array([_rank(*pair) for pair in _episodes(scores, truth)])
    flat = (scores.progress[truth.valid].numpy(), truth.progress[truth.valid].numpy())
    constant = not len(flat[0]) or any(np.ptp(side) == 0 for side in flat)
    pooled = None if constant else float(scipy.stats.spearmanr(*flat).statistic)
    success = truth.success.numpy()
    return {
        "within": _interval(each[np.isfinite(each)], np.mean, seed),
        "pooled": pooled,
        "auc": _interval(np.stack((confidence, success), 1), lambda rows: auc(*rows.T), seed),
        "dropped": dropped,
    }


def auc(score: Any, positive: Any) -> float:
    """Area under the ROC curve of scores [N] for classes [N]: the share of pairs of a positive and a negative
    that the score puts in order, ties counting half; NaN if a class is missing.
    """
    positive = np.asarray(positive, bool)
    hits, misses = int(positive.sum()), int((~positive).sum())
    if not hits or not misses:
        return float("nan")
    ranks = scipy.stats.rankdata(score)
    return float((ranks[positive].sum() - hits * (hits + 1) / 2) / (hits * misses))


def chosen(truth: Truth, count: int) -> dict[str, list[int]]:
    """Numbers of the episodes to draw: the first `count` that succeeded, and as many that failed."""
    return {
        name: (truth.success == won).nonzero().flatten()[:count].tolist()
        for name, won in (("success", True), ("failure", False))
    }


def _episodes(scores: Scores, truth: Truth) -> list[tuple[Any, Any]]:
    return [
        (mine[valid].numpy(), true[valid].numpy())
        for mine, true, valid in zip(scores.progress, truth.progress, truth.valid, strict=True)
    ]


def _rank(mine: Any, true: Any) -> float:
    """Spearman's correlation; NaN where the truth does not vary, 0 where the reward does not."""
    if len(true) < 3 or np.ptp(true) == 0:
        return float("nan")
    return 0.0 if np.ptp(mine) == 0 else float(scipy.stats.spearmanr(mine, true).statistic)


def _interval(rows: Any, value: Callable[[Any], Any], seed: int) -> list[float] | None:
    """[value, low, high] of rows [N, ...], 95% by resampling them; None where there is no value."""
    if not len(rows) or not np.isfinite(value(rows)):
        return None
    draws = torch.randint(len(rows), (_RESAMPLES, len(rows)), generator=resampling_generator(seed)).numpy()
    values = np.array([value(rows[some]) for some in draws])
    low, high = np.nanquantile(values, (0.025, 0.975))
    return [float(value(rows)), float(low), float(high)]


def curve(values: Tensor, truth: Truth, number: int) -> list[float]:
    """Values [N, T] of one episode, frame by frame, as they are written down."""
    return [round(value, 3) for value in values[number][truth.valid[number]].tolist()]


def cell(found: Mapping[str, Any], name: str) -> str:
    """A figure of `figures` in words; "-" for what cannot be said."""
    value = found[name]
    if value is None:
        return "-"
    if isinstance(value, int):
        return str(value)
    return f"{value:.2f}" if isinstance(value, float) else f"{value[0]:.2f} [{value[1]:.2f}, {value[2]:.2f}]"
