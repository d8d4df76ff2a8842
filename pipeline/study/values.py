"""How far an imagined world's values of policies agree with the true ones (WPE)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pipeline.evaluation.result import result_of
from pipeline.evaluation.value.page import order_text
from pipeline.stages.measured.values import estimated_values, true_values
from pipeline.study.columns import Cell, Cfg, Column, Measured
from pipeline.study.methods import Made
from pipeline.study.worlds import measuring

_FIGURES = {"Pearson": "pearson", "Spearman": "spearman", "MMRV": "mmrv", "mean |dSR|": "difference"}


class PolicyValues(Column):
    """Values of the row's policy, of the same under noise, and of scripted experts, as the section
    policy_value says, against their true ones; correlations are over all of them.
    """

    headline = "Pearson"

    def add(self, cfg: Cfg, made: Made) -> Sequence[str]:
        """See Column.add."""
        roles = measuring(made, "data", "simulator", "state", "judge")
        # starts are held-out episodes, which are the same however few the world has learned from
        tried = {"data": "collect", "policy": made.policy}
        true = made.add_once("true-values", true_values, tried)
        inputs = {**roles, "data": "collect", "policy": made.policy, "true": true}
        return (made.add_once("estimated-values", estimated_values, inputs),)

    def labels(self, cfg: Cfg) -> list[str]:
        """See Column.labels."""
        return [*_FIGURES, "order kept", "confusion, all episodes"]

    def read(self, cfg: Cfg, folders: Sequence[Path]) -> Measured:
        """See Column.read."""
        found = result_of(folders[0])
        chance = found.get("chance", {})
        cells: dict[str, Cell] = {
            label: {"value": found.get(key), "chance": chance.get(key)} for label, key in _FIGURES.items()
        }
        cells["order kept"] = found.get("order", {"kept": 0, "pairs": 0})
        cells["confusion, all episodes"] = found.get("micro", {})
        return Measured(cells)

    def text(self, cell: Cell) -> str:
        """See Column.text."""
        if "pairs" in cell:
            return order_text(cell)
        if "tp" in cell:
            return "TP {tp:.0f}, FP {fp:.0f}, FN {fn:.0f}, TN {tn:.0f}".format(**cell)
        value, chance = cell.get("value"), cell.get("chance")
        more = "" if chance is None else f" (by chance {chance:.2f})"
        return "-" if value is None else f"{value:.2f}{more}"

    def merit(self, cell: Cell) -> float | None:
        """See Column.merit."""
        return None if cell["value"] is None else float(cell["value"])
