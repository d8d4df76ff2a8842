"""Honest numbers: Wilson intervals, the exact McNemar test, confusion tables."""

from __future__ import annotations

from collections.abc import Mapping
from math import comb, sqrt
from typing import Any

from torch import Tensor


def wilson(successes: int, episodes: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a success rate (Wilson 1927), by default at 95%; (0, 1) without episodes."""
    if episodes == 0:
        return 0.0, 1.0
    rate = successes / episodes
    centre = (rate + z * z / (2 * episodes)) / (1 + z * z / episodes)
    half = z / (1 + z * z / episodes) * sqrt(rate * (1 - rate) / episodes + z * z / (4 * episodes**2))
    return max(0.0, centre - half), min(1.0, centre + half)


def rate_entry(success: Tensor) -> dict[str, Any]:
    """{"successes", "episodes", "low", "high"} of outcomes bool [N]."""
    successes, episodes = int(success.sum()), len(success)
    low, high = wilson(successes, episodes)
    return {"successes": successes, "episodes": episodes, "low": round(low, 4), "high": round(high, 4)}


def rate_line(entry: Mapping[str, Any]) -> str:
    """A `rate_entry` in words: successes of episodes, the rate in percent, and its interval."""
    return f"{entry['successes']}/{entry['episodes']} = {100 * entry['successes'] / max(1, entry['episodes']):.1f}% [{100 * entry['low']:.1f}, {100 * entry['high']:.1f}]"


def mcnemar(before: Tensor, after: Tensor) -> dict[str, Any]:
    """Exact two-sided McNemar test of paired outcomes bool [N] -> {"gained", "lost", "p"}."""
    gained, lost = int((after & ~before).sum()), int((before & ~after).sum())
    n, k = gained + lost, min(gained, lost)
    p = 1.0 if n == 0 else min(1.0, 2.0 * sum(comb(n, i) for i in range(k + 1)) / 2**n)
    return {"gained": gained, "lost": lost, "p": p}


def confusion(said: Tensor, truth: Tensor) -> dict[str, Any]:
    """{"tp", "fp", "fn", "tn", "accuracy"} of verdicts and truth bool [N]."""
    tp, fp = int((said & truth).sum()), int((said & ~truth).sum())
    fn, tn = int((~said & truth).sum()), int((~said & ~truth).sum())
    return {"tp": tp, "fp": fp, "fn": fn, "tn": tn, "accuracy": round((tp + tn) / max(1, len(truth)), 4)}
