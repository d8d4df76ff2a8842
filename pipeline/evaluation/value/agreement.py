"""How far policies' values in an imagined world agree with their true ones.

Pearson's and Spearman's correlations, the mean maximum rank violation (Li et al. 2024, "Evaluating real-world
robot manipulation policies in simulation"), per-episode confusion on equal starts, the mean error of success
rates, and whether values are over- or under-estimated for policies like those that the world learned from and
for others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor

from pipeline.evaluation.statistics import confusion, rate_entry
from pipeline.evaluation.value.chance import by_chance, intervals, mmrv, told_apart

ALL = "all"  # in place of a task: all of them together
_COUNTS = ("tp", "fp", "fn", "tn")


@dataclass(frozen=True)
class Cell:
    """What came of one policy on one task, N starts, R repeats with other noise of the simulator.

    Args:
        policy, task: their names.
        inside: whether the world learned from policies like this one; noise on its actions makes it another.
        imagined: bool [R, N], the judge's verdicts.
        judged: bool [R, N], whether it gave any.
        true: bool [N], success from the same starts in physics; None where there is none.
    """

    policy: str
    task: str
    inside: bool
    imagined: Tensor
    judged: Tensor
    true: Tensor | None = None

    @property
    def rates(self) -> list[float]:
        """Share of successes among the judged episodes of each repeat that has any, R at most."""
        pairs = zip(self.imagined, self.judged, strict=True)
        return [float(won[known].float().mean()) for won, known in pairs if known.any()]

    @property
    def estimated(self) -> float:
        """The policy's value as imagined, the mean over repeats; NaN if nothing could be judged."""
        return float(np.mean(self.rates)) if self.rates else math.nan

    @property
    def error(self) -> float | None:
        """Standard error of `estimated` over repeats; None of fewer than two, and where all went alike, as in
        a world without noise, whose repeats say nothing of how sure it is.
        """
        alike = bool((self.imagined == self.imagined[:1]).all() and (self.judged == self.judged[:1]).all())
        if len(self.rates) < 2 or alike:
            return None
        return float(np.std(self.rates, ddof=1) / math.sqrt(len(self.rates)))

    @property
    def value(self) -> float:
        """The policy's true value.

        Raises:
            ValueError: where it is unknown.
        """
        if self.true is None:
            raise ValueError(f"nobody tried {self.policy} on {self.task} in physics")
        return float(self.true.float().mean())

    @property
    def matched(self) -> float:
        """The true value on the starts that `estimated` speaks of, each as often as it was judged. Where
        a judge abstains from hard starts, all starts would be unlike them.
        """
        assert self.true is not None and self.rates
        return float(
            np.mean([float(self.true[known].float().mean()) for known in self.judged if known.any()])
        )

    @property
    def table(self) -> dict[str, Any]:
        """Confusion of judged imagined episodes, all repeats together, with the true ones of their starts."""
        assert self.true is not None
        truth = self.true.expand_as(self.imagined)
        return confusion(self.imagined[self.judged], truth[self.judged])

    def row(self) -> dict[str, Any]:
        """The cell in numbers: policy, task, inside, estimated, standard_error, episodes, dropped, and, where
        they are known, true (a rate entry), true_value, matched_value (see `matched`; None of nothing
        judged) and confusion.
        """
        known = {} if self.true is None else {"true": rate_entry(self.true), "true_value": self.value}
        return {
            "policy": self.policy,
            "task": self.task,
            "inside": self.inside,
            "estimated": None if math.isnan(self.estimated) else self.estimated,
            "standard_error": self.error,
            "episodes": self.imagined.numel(),
            "dropped": int((~self.judged).sum()),
            **known,
            **(
                {"matched_value": self.matched if self.rates else None, "confusion": self.table}
                if known
                else {}
            ),
        }


def overall(cells: Sequence[Cell]) -> list[Cell]:
    """Each policy on the starts of all its cells together, of which every one counts the same."""
    mine: dict[str, list[Cell]] = {}
    for cell in cells:
        mine.setdefault(cell.policy, []).append(cell)
    return [_pooled(policy, some) for policy, some in mine.items()]


def _pooled(policy: str, cells: Sequence[Cell]) -> Cell:
    known = [cell.true for cell in cells if cell.true is not None]
    return Cell(
        policy,
        ALL,
        cells[0].inside,
        torch.cat([cell.imagined for cell in cells], 1),
        torch.cat([cell.judged for cell in cells], 1),
        torch.cat(known) if len(known) == len(cells) else None,
    )


def agreement(cells: Sequence[Cell]) -> dict[str, Any]:
    """How far estimated and true values agree on the starts that were judged, over all cells and by task.

    Returns:
        policies, cells; pearson and spearman over cells, None where one side does not vary; mmrv, the mean
        over tasks; order {"kept", "pairs", "all"} of the pairs of policies of one task (see `order`), and
        kept, whether all that truth tells apart keep their order, None without any; micro {"tp", "fp", "fn",
        "tn", "accuracy"} of all episodes and macro, the mean over cells of the shares of each; difference,
        the mean of |estimated - true|; bias by "in" and "out" of distribution (see `bias`); intervals and
        chance of these (see chance.py); tasks, the same of each if there are several. {} if no cell knows its
        true value, or none of those could be judged.
    """
    known = [cell for cell in cells if cell.true is not None and cell.rates]
    if not known:
        return {}
    tasks = {task: [cell for cell in known if cell.task == task] for task in sorted({c.task for c in known})}
    out = _together(known, list(tasks.values()))
    if len(tasks) > 1:
        out["tasks"] = {task: _together(some, [some]) for task, some in tasks.items()}
    return out


def _together(cells: Sequence[Cell], tasks: Sequence[Sequence[Cell]]) -> dict[str, Any]:
    true, estimated = _values(cells)
    orders = [order(*_values(some), told_apart(some)) for some in tasks]
    kept = {name: sum(one[name] for one in orders) for name in ("kept", "pairs", "all")}
    tables = [cell.table for cell in cells]
    found: dict[str, Any] = {
        "policies": len({cell.policy for cell in cells}),
        "cells": len(cells),
        "pearson": correlation(scipy.stats.pearsonr, true, estimated),
        "spearman": correlation(scipy.stats.spearmanr, true, estimated),
        "mmrv": float(np.mean([mmrv(*_values(some)) for some in tasks])),
        "order": kept,
        "kept": kept["kept"] == kept["pairs"] if kept["pairs"] else None,
        "micro": micro(tables),
        "macro": macro(tables),
        "difference": float(np.abs(estimated - true).mean()),
        "bias": {
            name: bias(*_values(some))
            for name, inside in (("in", True), ("out", False))
            if (some := [cell for cell in cells if cell.inside is inside])
        },
    }
    figures = {**found, **{f"bias_{name}": side["mean"] for name, side in found["bias"].items()}}
    return {**found, "intervals": intervals(tasks, figures), "chance": by_chance(tasks)}


def _values(cells: Sequence[Cell]) -> tuple[np.ndarray, np.ndarray]:
    """True values on the judged starts and estimated ones, float64 [N] each."""
    return np.array([cell.matched for cell in cells]), np.array([cell.estimated for cell in cells])


def correlation(kind: Callable[..., Any], true: np.ndarray, estimated: np.ndarray) -> float | None:
    """SciPy's `pearsonr` or `spearmanr` of values [N]; None of fewer than two, or where a side is constant:
    nothing can be said then, and 0 would say that something was.
    """
    if len(true) < 2 or np.ptp(true) == 0 or np.ptp(estimated) == 0:
        return None
    return float(kind(true, estimated).statistic)


def order(true: np.ndarray, estimated: np.ndarray, apart: np.ndarray) -> dict[str, int]:
    """{"kept", "pairs", "all"}: of all pairs of values [N] those whose true ones differ beyond chance, as
    `apart` bool [N, N] says, and of these those whose estimates differ the same way.
    """
    every = list(combinations(range(len(true)), 2))
    pairs = [(a, b) for a, b in every if apart[a, b] and true[a] != true[b]]
    kept = sum((true[a] - true[b]) * (estimated[a] - estimated[b]) > 0 for a, b in pairs)
    return {"kept": int(kept), "pairs": len(pairs), "all": len(every)}


def micro(tables: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One confusion table of all episodes: every episode counts the same."""
    total = {name: sum(int(table[name]) for table in tables) for name in _COUNTS}
    count = sum(total.values())
    return {**total, "accuracy": (total["tp"] + total["tn"]) / max(1, count)}


def macro(tables: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Shares of each table, averaged over tables that hold any episode: every cell counts the same."""
    shares = []
    for table in tables:
        count = sum(table[name] for name in _COUNTS)
        if count:
            shares.append([table[name] / count for name in _COUNTS])
    mean = np.mean(shares, 0)
    return {**dict(zip(_COUNTS, mean.tolist(), strict=True)), "accuracy": float(mean[0] + mean[3])}


def bias(true: np.ndarray, estimated: np.ndarray) -> dict[str, Any]:
    """By how much values [N] are over-estimated in the mean (under-estimated, if negative), and how many
    cells are over, under and exact.
    """
    off = np.asarray(estimated, float) - np.asarray(true, float)
    return {
        "cells": len(off),
        "mean": float(off.mean()),
        "over": int((off > 0).sum()),
        "under": int((off < 0).sum()),
        "exact": int((off == 0).sum()),
    }
