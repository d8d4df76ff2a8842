"""What a study measures of each row: a stage on top of its policy, and the cells that it fills."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from envs.physics.suite import task_names
from envs.targets import ConfigError, nearest
from pipeline.evaluation.by_task import tasks_of_seeds
from pipeline.evaluation.result import outcomes
from pipeline.evaluation.statistics import rate_entry, rate_line
from pipeline.stages import prove
from pipeline.study.methods import Made

Cfg = Mapping[str, Any]
ALL = "all"  # label of the cell over all tasks


@dataclass(frozen=True)
class Measured:
    """What a column found of a row.

    Args:
        cells: figures by label; `text` of the column says them in words.
        outcomes: success by task and episode seed, by which rows are compared; {} if there are none.
    """

    cells: Mapping[str, Mapping[str, Any]]
    outcomes: Mapping[tuple[str, int], bool]

    @classmethod
    def of_success(cls, success: Mapping[tuple[str, int], bool]) -> Measured:
        """Rates of each task, and of all."""
        tasks = dict.fromkeys(task for task, _ in success)
        cells = {
            task: rate_entry(torch.tensor([won for (name, _), won in success.items() if name == task]))
            for task in tasks
        }
        return cls({**cells, ALL: rate_entry(torch.tensor(list(success.values())))}, success)


class Column(ABC):
    """A column, or several that are measured at once; a study names one by `_target_`.

    Args:
        title: what it is.
    """

    def __init__(self, title: str):
        self.title = title

    @abstractmethod
    def add(self, cfg: Cfg, made: Made) -> str:
        """Add the stage that measures to the row's graph, if it is not there; returns its name.

        Raises:
            ConfigError: if this cannot be measured with the row's config.
        """

    @abstractmethod
    def labels(self, cfg: Cfg) -> list[str]:
        """Labels of the cells that it fills in a row of this config."""

    @abstractmethod
    def read(self, cfg: Cfg, folder: Path) -> Measured:
        """What the finished stage found."""

    @abstractmethod
    def text(self, cell: Mapping[str, Any]) -> str:
        """A cell in words."""


class Success(Column):
    """True success, deterministic, task by task on the evaluation seeds, with Wilson intervals.

    Args:
        title: see Column.
        variant: one of task.variants; "" for the task as it is.
    """

    def __init__(self, title: str, variant: str = ""):
        super().__init__(title)
        self.variant = variant

    def add(self, cfg: Cfg, made: Made) -> str:
        """See Column.add."""
        graph, inputs = made.graph, {"policy": made.policy}
        if not self.variant:
            for name, node in graph.nodes.items():  # the loop proves its own first and last policy
                if node.stage is prove.evaluate_physics and node.inputs == inputs:
                    return name
            return graph.add(f"evaluate-{made.policy}", prove.evaluate_physics, inputs)
        known = cfg["task"].get("variants") or {}
        if self.variant not in known:
            near = nearest(self.variant, known)
            raise ConfigError(f"variant={self.variant} is not one of task.variants{near}")
        name = f"evaluate-{made.policy}-{self.variant}"
        return graph.add(name, prove.evaluate_variant, inputs, variant=self.variant)

    def labels(self, cfg: Cfg) -> list[str]:
        """See Column.labels."""
        return [*task_names(cfg["task"]["name"]), ALL]

    def read(self, cfg: Cfg, folder: Path) -> Measured:
        """See Column.read."""
        seeds, (success,) = outcomes(folder)
        keys = zip(tasks_of_seeds(cfg, seeds), seeds, strict=True)
        return Measured.of_success(dict(zip(keys, success.tolist(), strict=True)))

    def text(self, cell: Mapping[str, Any]) -> str:
        """See Column.text."""
        return rate_line(cell)
