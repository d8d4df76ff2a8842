"""Intervals and tests against published values."""

from __future__ import annotations

import pytest
import torch

from pipeline.evaluation.by_task import by_task
from pipeline.evaluation.statistics import (
    balanced_accuracy,
    confusion,
    mcnemar,
    mean,
    over_seeds,
    quantiles,
    rate_entry,
    verdicts_line,
    wilson,
)


def test_wilson_matches_published_values() -> None:
    # Newcombe 1998, table I: 81 of 263 and 0 of 20.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-4)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=1e-4)
    assert wilson(0, 0) == (0.0, 1.0)


def test_exact_mcnemar() -> None:
    before = torch.tensor([False] * 62 + [True] * 19 + [True] * 100)
    after = torch.tensor([True] * 62 + [False] * 19 + [True] * 100)
    result = mcnemar(before, after)
    assert (result["gained"], result["lost"]) == (62, 19) and result["p"] == pytest.approx(1.773e-6, rel=0.01)
    assert mcnemar(before, before)["p"] == 1.0


def test_a_seed_is_one_observation() -> None:
    found = over_seeds([18.5, 17.5, 24.5])
    half = 4.3027 * 3.7859 / 3**0.5  # Student's t of two degrees of freedom, times the standard error
    assert found["mean"] == pytest.approx(20.1667, abs=1e-3)
    assert (found["low"], found["high"]) == pytest.approx((20.1667 - half, 20.1667 + half), abs=1e-2)
    assert 0.01 < found["p"] < 0.05 and over_seeds([3.0, -1.0, 1.0])["p"] > 0.3
    assert over_seeds([2.0, 2.0]) == {"mean": 2.0, "low": 2.0, "high": 2.0, "p": None}


def test_confusion_and_rates() -> None:
    said, truth = torch.tensor([True, True, False, False]), torch.tensor([True, False, True, False])
    assert confusion(said, truth) == {"tp": 1, "fp": 1, "fn": 1, "tn": 1, "accuracy": 0.5}
    assert rate_entry(truth)["successes"] == 2
    nothing = torch.zeros(0, dtype=torch.bool)  # judged: neither right nor wrong
    assert confusion(nothing, nothing) == {"tp": 0, "fp": 0, "fn": 0, "tn": 0, "accuracy": None}
    assert balanced_accuracy(confusion(nothing, nothing)) is None
    assert verdicts_line(confusion(nothing, nothing)) == "none judged"


def test_who_always_says_no_is_no_judge() -> None:
    truth = torch.arange(50) < 13
    never = confusion(torch.zeros(50, dtype=torch.bool), truth)
    assert never["accuracy"] == 0.74 and balanced_accuracy(never) == 0.5
    assert verdicts_line(never) == "0/13 successes, 37/37 failures"
    assert verdicts_line(confusion(truth[:13], truth[:13])) == "13/13 successes"


def test_quantiles_leave_out_what_is_not_finite() -> None:
    assert quantiles(torch.tensor([1.0, 2.0, 3.0, float("nan")])) == {
        "median": 2.0,
        "p90": pytest.approx(2.8),
    }
    assert quantiles(torch.full((2,), float("nan"))) is None and mean(torch.zeros(0)) is None


def test_figures_task_by_task() -> None:
    won = torch.tensor([True, False, True, True])
    parts = by_task(["b", "a", "b", "a"], rate_entry, won)
    assert {name: (part["successes"], part["episodes"]) for name, part in parts.items()} == {
        "a": (1, 2),
        "b": (2, 2),
    }
    assert by_task(["a"] * 4, rate_entry, won) == {}
