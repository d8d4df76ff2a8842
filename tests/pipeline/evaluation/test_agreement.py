"""Agreement of imagined and true values against cases that were worked out by hand."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import pearsonr, spearmanr

from pipeline.evaluation.value.agreement import (
    Cell,
    agreement,
    bias,
    correlation,
    macro,
    micro,
    order,
    overall,
)
from pipeline.evaluation.value.chance import mmrv
from pipeline.evaluation.value.page import build_page, ranking, table_text, verdict

TRUE = np.array([0.9, 0.5, 0.1])


def bools(text: str) -> torch.Tensor:
    return torch.tensor([letter == "1" for letter in text])


def cell(policy: str, true: str | None, *repeats: str, inside: bool = True, task: str = "push") -> Cell:
    imagined = torch.stack([bools(text) for text in repeats])
    judged = torch.ones_like(imagined)
    return Cell(policy, task, inside, imagined, judged, None if true is None else bools(true))


def test_rank_violations_weigh_by_the_true_difference() -> None:
    assert mmrv(TRUE, np.array([0.6, 0.3, 0.2])) == 0.0
    # The last two change places: each is wrong about the other, by .4; the first is right about both.
    assert mmrv(TRUE, np.array([0.6, 0.2, 0.3])) == pytest.approx((0.0 + 0.4 + 0.4) / 3)
    # All turned round: .9 is wrong about .1, .5 about either end, .1 about .9.
    assert mmrv(TRUE, -TRUE) == pytest.approx((0.8 + 0.4 + 0.8) / 3)
    # Who estimates all alike does not say that the smaller of a pair is smaller: .5 beside .9, .1 beside .9.
    assert mmrv(TRUE, np.zeros(3)) == pytest.approx((0.0 + 0.4 + 0.8) / 3)


def test_correlations_are_those_of_the_textbook() -> None:
    estimated = np.array([0.6, 0.2, 0.3])
    # deviations .4, 0, -.4 and .2333, -.1667, -.0667: .12 / sqrt(.32 * .08667)
    assert correlation(pearsonr, TRUE, estimated) == pytest.approx(0.12 / math.sqrt(0.32 * 0.26 / 3))
    assert correlation(spearmanr, TRUE, estimated) == pytest.approx(0.5)
    assert correlation(pearsonr, TRUE, np.full(3, 0.4)) is None
    assert correlation(spearmanr, TRUE[:1], estimated[:1]) is None


def test_pairs_that_tie_in_truth_say_nothing_and_those_that_tie_in_estimates_are_not_kept() -> None:
    every = ~np.eye(3, dtype=bool)
    some = order(np.array([0.5, 0.5, 0.1]), np.array([0.3, 0.6, 0.2]), every)
    assert some == {"kept": 2, "pairs": 2, "all": 3}
    assert order(TRUE, np.array([0.4, 0.4, 0.1]), every) == {"kept": 2, "pairs": 3, "all": 3}
    assert order(TRUE, np.array([0.4, 0.4, 0.1]), ~every) == {"kept": 0, "pairs": 0, "all": 3}


def test_micro_counts_episodes_and_macro_cells() -> None:
    large = {"tp": 8, "fp": 0, "fn": 0, "tn": 0}
    small = {"tp": 0, "fp": 1, "fn": 1, "tn": 0}
    assert micro([large, small]) == {"tp": 8, "fp": 1, "fn": 1, "tn": 0, "accuracy": 0.8}
    assert macro([large, small]) == {"tp": 0.5, "fp": 0.25, "fn": 0.25, "tn": 0.0, "accuracy": 0.5}


def test_a_cell_knows_its_value_and_how_sure_it_is() -> None:
    one = cell("a", "1100", "1000", "1110")
    # rates 1/4 and 3/4: their standard deviation is sqrt(1/8), the mean's error that over sqrt(2)
    assert one.estimated == 0.5 and one.error == pytest.approx(0.25)
    assert one.table == {"tp": 3, "fp": 1, "fn": 1, "tn": 3, "accuracy": 0.75}
    assert cell("a", "1100", "1000").error is None
    assert cell("a", "1100", "1000", "1000").error is None  # a world without noise says nothing of errors
    assert cell("a", "1100", "1000", "0100").error == 0.0
    with pytest.raises(ValueError, match="nobody tried a on push"):
        _ = cell("a", None, "1000").value


def test_what_the_judge_dropped_counts_for_nothing() -> None:
    judged = torch.tensor([[True, False, True, True], [False] * 4])
    some = Cell("a", "push", True, bools("1100").repeat(2, 1), judged, bools("1100"))
    assert some.rates == [pytest.approx(1 / 3)] and some.row()["dropped"] == 5
    assert some.table == {"tp": 1, "fp": 0, "fn": 0, "tn": 2, "accuracy": 1.0}
    nothing = Cell("b", "push", True, bools("11")[None], torch.zeros(1, 2, dtype=torch.bool), bools("11"))
    assert nothing.row()["estimated"] is None and agreement([nothing]) == {}


def test_values_are_compared_on_the_starts_that_were_judged() -> None:
    """A judge that abstains where the policy fails must not seem to under- or over-estimate it."""
    judged = torch.tensor([[True, True, False, False], [True, False, True, False]])
    some = Cell("a", "push", True, bools("1100").repeat(2, 1), judged, bools("1100"))
    assert some.value == 0.5 and some.matched == some.estimated == pytest.approx(0.75)
    assert agreement([some])["difference"] == 0.0 and some.row()["true_value"] == 0.5
    said = result_of(some)
    assert "| a | 75 (all starts 50) -> 75 +- 25.0 |" in table_text(said)
    page = build_page(said)
    assert "a, push: 75 (all starts 50) -&gt; 75" in page and page.count("75.0%") == 2
    whole = build_page(result_of(cell("a", "1110", "1110", "1110")))  # .75 in truth and imagination, too
    assert re.findall(r'<rect [^>]* rx="4">', page) == re.findall(r'<rect [^>]* rx="4">', whole)


def test_kind_outside_and_hard_inside() -> None:
    """As WPE found: under-estimated where the world knows policies, over-estimated under noise."""
    cells = [
        cell("good", 4 * "1111", 4 * "1110", 4 * "1110"),
        cell("fair", 4 * "1100", 4 * "1000", 4 * "1000"),
        cell("noise", 4 * "0000", 4 * "0000", 4 * "1000", inside=False),
    ]
    found = agreement(cells)
    assert found["kept"] and found["mmrv"] == 0.0 and found["spearman"] == 1.0 and "tasks" not in found
    assert found["bias"]["in"] == {"cells": 2, "mean": -0.25, "over": 0, "under": 2, "exact": 0}
    assert found["bias"]["out"]["mean"] == 0.125 and found["bias"]["out"]["over"] == 1
    assert found["difference"] == pytest.approx((0.25 + 0.25 + 0.125) / 3)


def test_orders_are_compared_within_tasks_alone() -> None:
    easy = [cell("a", 6 * "1111", 6 * "1111"), cell("b", 6 * "1110", 6 * "0111")]
    hard = [cell("a", 6 * "0000", 6 * "0000", task="pull"), cell("b", 6 * "1000", 6 * "1111", task="pull")]
    found = agreement([*easy, *hard, cell("c", None, "1111")])
    assert found["order"] == {"kept": 2, "pairs": 2, "all": 2} and found["kept"] and found["cells"] == 4
    assert set(found["tasks"]) == {"pull", "push"} and found["tasks"]["pull"]["difference"] == 0.375
    assert bias(np.array([0.2]), np.array([0.2]))["exact"] == 1


def result_of(*cells: Cell) -> dict[str, Any]:
    """What policy-value.json holds of cells."""
    return {
        "name": "tiny",
        "weights": {},
        "simulator": "S",
        "judge": "J",
        "judged_by": {},
        "judge_cost": {},
        "repeats": 2,
        "starts": {one.task: one.imagined.shape[1] for one in cells},
        "cells": [one.row() for one in cells],
        "overall": [one.row() for one in overall(cells)],
        "agreement": agreement(cells),
        "notes": [],
    }


def test_where_all_true_values_are_equal_there_is_no_ranking_to_keep() -> None:
    said = result_of(cell("a", "10", "11"), cell("b", "01", "00"))
    assert (
        said["agreement"]["order"] == {"kept": 0, "pairs": 0, "all": 1} and said["agreement"]["kept"] is None
    )
    assert verdict(said).startswith("no ranking to keep") and "0 of 0" not in build_page(said)
    other = result_of(cell("a", 3 * "11", 3 * "11"), cell("b", 3 * "00", 3 * "11"))
    assert verdict(other).startswith("ranking not kept (0 of 1 pairs told apart in truth, of 1)")


def test_policies_have_a_value_over_all_starts_and_a_ranking_without_truth() -> None:
    said = result_of(
        cell("a", None, "1100", "0000"),
        cell("b", None, "1000", "1100"),
        cell("a", None, "1", "1", task="pull"),
        cell("b", None, "1", "1", task="pull"),
    )
    rows = {row["policy"]: row for row in said["overall"]}
    # of five starts 3 and 1, so .4 +- .2, and 2 and 3, so .5 +- .1: every start counts the same
    assert [rows[name]["estimated"] for name in "ab"] == pytest.approx([0.4, 0.5])
    assert [rows[name]["standard_error"] for name in "ab"] == pytest.approx([0.2, 0.1])
    assert rows["a"]["task"] == "all" and rows["a"]["episodes"] == 10 and "true" not in rows["a"]
    assert ranking(said).endswith("in percent: b: 50 +- 10.0; a: 40 +- 20.0.")
    text = table_text(said)
    assert "| policy | push | pull | all |" in text and "| 100 | 40 +- 20.0 |" in text
    assert ranking(said) in text and "nobody knows" in text
    page = build_page(said)
    assert ranking(said) in page and page.count("<td>all</td>") == 2
    one = result_of(cell("a", "1100", "1100", "1000"), cell("b", None, "1000", "1000"))
    assert "| policy | push |" in table_text(one) and "a: 50 -> 38 +- 12.5; b: 25." in ranking(one)
    lost = Cell("c", "push", True, bools("1100")[None], torch.zeros(1, 4, dtype=torch.bool))
    assert ranking(result_of(lost, cell("d", None, "0000"))).endswith("d: 0; c: nothing judged.")
