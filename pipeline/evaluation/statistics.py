"""Honest numbers: Wilson intervals, the exact McNemar test, Student's t over seeds, confusion tables,
quantiles of errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import scipy
import torch
from torch import Tensor

_MOST = 1_000_000  # values looked at; torch.quantile takes 16 M, and a million says the same


def wilson(successes: int, episodes: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson score interval of a success rate (Wilson 1927); (0, 1) without episodes."""
    if episodes == 0:
        return 0.0, 1.0
    interval = scipy.stats.binomtest(successes, episodes).proportion_ci(confidence, method="wilson")
    return float(interval.low), float(interval.high)


def rate_entry(success: Tensor) -> dict[str, Any]:
    """{"successes", "episodes", "low", "high"} of outcomes bool [N]."""
    successes, episodes = int(success.sum()), len(success)
    low, high = wilson(successes, episodes)
    return {"successes": successes, "episodes": episodes, "low": round(low, 4), "high": round(high, 4)}


def rate(entry: Mapping[str, Any]) -> float | None:
    """The share of successes in a `rate_entry`; None without episodes, of which nothing is known."""
    return float(entry["successes"] / entry["episodes"]) if entry["episodes"] else None


def rise(before: Mapping[str, Any], after: Mapping[str, Any]) -> float | None:
    """The difference of two `rate_entry`s' rates; None where one of them has no episodes."""
    low, high = rate(before), rate(after)
    return None if low is None or high is None else high - low


def percent_line(entry: Mapping[str, Any], digits: int = 1) -> str:
    """The rate of a `rate_entry` in percent, or that nothing was judged."""
    share = rate(entry)
    return "not judged" if share is None else f"{100 * share:.{digits}f}%"


def rate_line(entry: Mapping[str, Any]) -> str:
    """A `rate_entry` in words: successes of episodes, the rate in percent, and its interval; or that nothing
    was judged.
    """
    if not entry["episodes"]:
        return percent_line(entry)
    return (
        f"{entry['successes']}/{entry['episodes']} = {percent_line(entry)}"
        f" [{100 * entry['low']:.1f}, {100 * entry['high']:.1f}]"
    )


def points_line(difference: float | None) -> str:
    """A difference of rates in points; None where nobody knows it."""
    return "unknown" if difference is None else f"{100 * difference:+.1f}"


def psnr_line(first: float | None, last: float | None) -> str:
    """PSNR of the first and the last frames in dB; "-" for what nobody knows."""
    return " → ".join("-" if value is None else f"{value:.1f}" for value in (first, last))


def mcnemar(before: Tensor, after: Tensor) -> dict[str, Any]:
    """Exact two-sided McNemar test of paired outcomes bool [N] -> {"gained", "lost", "p"}."""
    gained, lost = int((after & ~before).sum()), int((before & ~after).sum())
    discordant = gained + lost
    p = float(scipy.stats.binomtest(gained, discordant, 0.5).pvalue) if discordant else 1.0
    return {"gained": gained, "lost": lost, "p": p}


def over_seeds(gains: Sequence[float], confidence: float = 0.95) -> dict[str, Any]:
    """{"mean", "low", "high", "p"} of what a method gained with two seeds of training or more: Student's t,
    which takes a seed for one observation however many episodes its policy played; p is None if all are
    alike.
    """
    mean = sum(gains) / len(gains)
    if max(gains) == min(gains):
        return {"mean": mean, "low": mean, "high": mean, "p": None}
    test = scipy.stats.ttest_1samp(gains, 0.0)
    low, high = test.confidence_interval(confidence)
    return {"mean": mean, "low": float(low), "high": float(high), "p": float(test.pvalue)}


def confusion(predicted: Tensor, truth: Tensor) -> dict[str, Any]:
    """{"tp", "fp", "fn", "tn", "accuracy"} of predictions and truth bool [N]; accuracy is None of none."""
    tp, fp = int((predicted & truth).sum()), int((predicted & ~truth).sum())
    fn, tn = int((~predicted & truth).sum()), int((~predicted & ~truth).sum())
    accuracy = round((tp + tn) / len(truth), 4) if len(truth) else None
    return {"tp": tp, "fp": fp, "fn": fn, "tn": tn, "accuracy": accuracy}


def balanced_accuracy(table: Mapping[str, Any]) -> float | None:
    """Mean share of successes and of failures that are told right, of a `confusion`; of the one kind that
    there is; None of none. Who always says the same has 1/2, whatever the share of successes.
    """
    told = [table[right] / of for right, of in _by_truth(table) if of]
    return sum(told) / len(told) if told else None


def verdicts_line(table: Mapping[str, Any]) -> str:
    """How many successes and failures of a `confusion` are told right: '6/13 successes, 31/37 failures'."""
    kinds = zip(("successes", "failures"), _by_truth(table), strict=True)
    return (
        ", ".join(f"{table[right]:.0f}/{of:.0f} {kind}" for kind, (right, of) in kinds if of) or "none judged"
    )


def _by_truth(table: Mapping[str, Any]) -> tuple[tuple[str, float], tuple[str, float]]:
    return ("tp", table["tp"] + table["fn"]), ("tn", table["tn"] + table["fp"])


def mean(values: Tensor) -> float | None:
    """The mean of values [N]; None of none."""
    return float(values.mean()) if len(values) else None


def quantiles(values: Tensor) -> dict[str, float] | None:
    """{"median", "p90"} of the finite values [N]; None where there is none."""
    values = values[torch.isfinite(values)]
    if not len(values):
        return None
    values = values[:: len(values) // _MOST + 1]
    return {"median": float(values.median()), "p90": float(values.quantile(0.9))}
