"""What chance does to the agreement of values: intervals over starts, and what a perfect world shows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from envs.rng import constant_generator
from pipeline.evaluation.joined.page import parts_of
from pipeline.evaluation.value.agreement import Cell, agreement
from pipeline.evaluation.value.chance import by_chance, intervals, told_apart
from pipeline.evaluation.value.page import build_page, order_text, table_text, verdict
from tests.pipeline.evaluation.test_agreement import cell, result_of

STARTS, REPEATS = 32, 4


def drawn(true: list[float], estimated: list[float], seed: int = 0) -> list[Cell]:
    """Cells of policies that succeed by chance at these rates, in truth and in imagination."""
    generator = constant_generator(seed)
    judged = torch.ones(REPEATS, STARTS, dtype=torch.bool)
    return [
        Cell(
            f"policy {number}",
            "push",
            True,
            torch.rand(REPEATS, STARTS, generator=generator) < imagined,
            judged,
            torch.rand(STARTS, generator=generator) < truth,
        )
        for number, (truth, imagined) in enumerate(zip(true, estimated, strict=True))
    ]


def test_a_perfect_world_shows_no_more_than_chance_does() -> None:
    """Of independent episodes at one rate p the difference's variance is p (1 - p) (1/N + 1/RN)."""
    rates = [0.5] * 6
    found = [agreement(drawn(rates, rates, seed)) for seed in range(40)]
    error = math.sqrt(0.25 * (1 / STARTS + 1 / (REPEATS * STARTS)))
    wanted = error * math.sqrt(2 / math.pi)
    assert np.mean([one["chance"]["difference"] for one in found]) == pytest.approx(wanted, rel=0.1)
    assert np.mean([one["difference"] for one in found]) == pytest.approx(wanted, rel=0.1)
    means = [np.mean([one["mmrv"] for one in found]), np.mean([one["chance"]["mmrv"] for one in found])]
    assert min(means) > 0.05  # of a ranking of equals
    assert all(one["order"]["all"] == 15 for one in found)
    # by the test's own error of 5% at most; pairs that differ by an episode had all been counted
    assert sum(one["order"]["pairs"] for one in found) < 0.05 * 15 * 40


def test_repeats_that_are_alike_make_nobody_surer() -> None:
    one = cell("a", 8 * "1100", *[8 * "1000"] * 4)
    other = cell("a", 8 * "1100", 8 * "1000")
    assert by_chance([[one]]) == by_chance([[other]])


@pytest.mark.long
def test_intervals_hold_what_is_true_of_all_starts_far_more_often_than_not() -> None:
    true = [0.2, 0.3, 0.4, 0.5, 0.6, 0.7]
    held: dict[str, int] = {"bias_in": 0, "difference": 0, "pearson": 0}
    for seed in range(40):
        found = agreement(drawn(true, [rate + 0.15 for rate in true], seed))["intervals"]
        for name, value in {"bias_in": 0.15, "difference": 0.15, "pearson": 1.0}.items():
            low, high = found[name]
            held[name] += low <= value <= high + 1e-9
            assert low < high
    assert min(held.values()) >= 34


def test_the_same_starts_are_drawn_for_all_policies_and_equal_cells_give_equal_intervals() -> None:
    """Policies that succeed from the same starts differ by no start that is drawn: their order is sure."""
    true = 8 * "1100"
    cells = [cell("a", true, true, 8 * "1101"), cell("b", true, true, 8 * "1101")]
    one = intervals([cells], {"bias_in": 0.125, "mmrv": 0.0})
    assert one == intervals([cells], {"bias_in": 0.125, "mmrv": 0.0})
    assert "mmrv" not in one and 0 < one["bias_in"][0] < 0.125 < one["bias_in"][1] < 0.25


def test_what_truth_tells_apart_is_paired() -> None:
    base, better, other = "0" * 20, "1" * 6 + "0" * 14, "0" * 14 + "1" * 5 + "0"
    found = told_apart(
        [cell(name, text, text) for name, text in zip("abc", (base, better, other), strict=True)]
    )
    assert found.tolist() == [[False, True, False], [True, False, False], [False, False, False]]


SOMETIMES = torch.tensor([[True, False, False, False]])
CASES: dict[str, list[Cell]] = {
    "one policy": [cell("a", 4 * "1100", 4 * "1000")],
    "one start": [cell("a", "1", "0"), cell("b", "0", "1")],
    "no spread": [cell("a", "1111", "1111"), cell("b", "1111", "1111")],
    "a judge that mostly abstains": [
        Cell(name, "push", True, SOMETIMES, SOMETIMES, SOMETIMES[0]) for name in ("a", "b")
    ],
    "a judge that abstains by policy": [
        Cell("a", "push", True, SOMETIMES, SOMETIMES, SOMETIMES[0]),
        Cell("b", "push", True, ~SOMETIMES, ~SOMETIMES, SOMETIMES[0]),
    ],
}


@pytest.mark.parametrize("name", CASES)
def test_where_nothing_can_be_said_it_is_said(name: str) -> None:
    said = result_of(*CASES[name])
    text, page = table_text(said), build_page(said)
    assert verdict(said).startswith("no ranking to keep (") and "nan" not in text + page
    assert "By chance: what a perfect world" in text and "By chance: what a perfect world" in page
    if name != "one policy":
        assert "No figure changes with the starts" in text and "[" not in verdict(said)
    else:
        assert "no task has two policies" in text and "estimated less true -25.0 [" in verdict(said)


def test_intervals_and_chance_stand_beside_figures() -> None:
    true = [0.1, 0.9, 0.5]
    said = result_of(*drawn(true, true))
    text = verdict(said)
    assert "told apart in truth, of 3)" in text and text.count("(by chance ") == 2 and text.count("[") == 5
    assert text.split("; ")[1] in build_page(said).replace("</td><td>", ", ") or "(by chance " in build_page(
        said
    )
    assert "intervals" not in result_of(cell("a", None, "11"))["agreement"]
    assert "By chance" not in table_text(result_of(cell("a", None, "11")))


def test_results_of_before_open() -> None:
    said = result_of(*drawn([0.1, 0.9], [0.1, 0.9]))
    old: dict[str, Any] = {**said["agreement"], "order": {"kept": 1, "pairs": 1}}
    del old["intervals"], old["chance"]
    said["agreement"] = old
    assert verdict(said).startswith("ranking kept (1 of 1 pairs); Pearson 1.00,") and build_page(said)
    (part,) = (part for part in parts_of({"policy-value": said}, {}) if part.rows)
    assert "1 of 1 pairs" in [row.value for row in part.rows]
    assert order_text({"kept": 1, "pairs": 2, "all": 6}) == "1 of 2 pairs told apart in truth, of 6"
