"""What a study measures of each row: stages on top of what the row is about, and the cells that they fill."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch
from markupsafe import Markup

from envs.physics.suite import task_names
from pipeline.evaluation.by_task import by_scene, scenes_of_seeds, tasks_of_seeds, variant_of
from pipeline.evaluation.heat import heat_maps_of
from pipeline.evaluation.report import templates
from pipeline.evaluation.result import outcomes
from pipeline.evaluation.statistics import rate, rate_entry, rate_line
from pipeline.stages import prove
from pipeline.study.methods import Made

Cfg = Mapping[str, Any]
Cell = Mapping[str, Any]
Outcomes = Mapping[tuple[str, int], bool]
T = TypeVar("T")
ALL = "all"  # label of the cell over all tasks


@dataclass(frozen=True)
class Measured:
    """What a column found of a row.

    Args:
        cells: figures by label; `text` of the column says them in words.
        outcomes: success by task and episode seed, by which rows are compared; {} if there are none.
        before: the same of a policy that the row began with, where a column compares the two.
        scenes: in which of the suite's scenes the episodes of `outcomes` were, if that was asked.
        curve: (x, y) of a line that the column draws; [] if there is none.
    """

    cells: Mapping[str, Cell]
    outcomes: Outcomes = field(default_factory=dict)
    before: Outcomes = field(default_factory=dict)
    scenes: Mapping[tuple[str, int], str] = field(default_factory=dict)
    curve: Sequence[tuple[float, float]] = ()

    @classmethod
    def of_success(cls, success: Outcomes, scenes: Mapping[tuple[str, int], str] | None = None) -> Measured:
        """Rates of each task, and of all."""
        tasks = dict.fromkeys(task for task, _ in success)
        cells = {
            task: rate_entry(torch.tensor([won for (name, _), won in success.items() if name == task]))
            for task in tasks
        }
        whole = rate_entry(torch.tensor(list(success.values())))
        return cls({**cells, ALL: whole}, success, scenes=scenes or {})


class Column(ABC):
    """A column, or several that are measured at once; a study names one by `_target_`.

    Args:
        title: what it is.

    Attributes:
        headline: label of the cell that stands for the column where all columns stand side by side.
    """

    headline: str = ALL

    def __init__(self, title: str):
        self.title = title

    @abstractmethod
    def add(self, cfg: Cfg, made: Made) -> Sequence[str]:
        """Add the stages that measure to the row's graph, as far as they are not there; returns the names of
        all whose results are read.

        Raises:
            ConfigError: if this cannot be measured with the row's config.
        """

    @abstractmethod
    def labels(self, cfg: Cfg) -> list[str]:
        """Labels of the cells that it fills in a row of this config."""

    @abstractmethod
    def read(self, cfg: Cfg, folders: Sequence[Path]) -> Measured:
        """What the finished stages found, in the order of their names."""

    @abstractmethod
    def text(self, cell: Cell) -> str:
        """A cell in words."""

    def pool(self, several: Sequence[Measured]) -> Measured:
        """What was found of one row with several seeds; here means of the figures that all of them have."""
        labels = [label for label in several[0].cells if all(label in one.cells for one in several)]
        return Measured({label: _mean([one.cells[label] for one in several]) for label in labels})

    def merit(self, cell: Cell) -> float | None:
        """By what the best row is found, more being better; None where rows are not to be ranked."""
        return None

    def chart(self, found: Mapping[str, Measured]) -> Markup:
        """A drawing of what was found of each row, by title; "" for none."""
        return Markup("")


class Success(Column):
    """True success, deterministic, task by task on the evaluation seeds, with Wilson intervals.

    Args:
        title: see Column.
        variant: one of task.variants; "" for the task as it is.
    """

    def __init__(self, title: str, variant: str = ""):
        super().__init__(title)
        self.variant = variant

    def add(self, cfg: Cfg, made: Made) -> Sequence[str]:
        """See Column.add."""
        inputs = {"policy": made.policy}  # the loop proves its own first and last policy
        if not self.variant:
            return (made.add_once(f"evaluate-{made.policy}", prove.evaluate_physics, inputs),)
        variant_of(cfg, self.variant)  # or says that there is none
        name = f"evaluate-{made.policy}-{self.variant}"
        return (made.add_once(name, prove.evaluate_variant, inputs, variant=self.variant),)

    def labels(self, cfg: Cfg) -> list[str]:
        """See Column.labels."""
        names = task_names(cfg["task"]["name"])
        return [*names, ALL] if len(names) > 1 else [ALL]

    def read(self, cfg: Cfg, folders: Sequence[Path]) -> Measured:
        """See Column.read."""
        success = outcomes_of(cfg, folders[0])
        scenes = scenes_of_seeds(cfg, (seed for _, seed in success), variant_of(cfg, self.variant))
        return Measured.of_success(success, dict(zip(success, scenes, strict=True)))

    def text(self, cell: Cell) -> str:
        """See Column.text."""
        return rate_line(cell)

    def pool(self, several: Sequence[Measured]) -> Measured:
        """Success over all seeds of training, each on the same episodes."""
        return Measured.of_success(
            together([one.outcomes for one in several]), together([one.scenes for one in several])
        )

    def chart(self, found: Mapping[str, Measured]) -> Markup:
        """Success of each row by task and scene as heat maps, where the suite has several scenes."""
        maps = heat_maps_of({title: _cells_of(one) for title, one in found.items()})
        if maps is None:
            return Markup("")
        drawn = templates().get_template("macros.html.j2").module.heats(maps)  # type: ignore[attr-defined]
        return Markup("<h2>{}, by task and scene</h2>{}").format(self.title, Markup(drawn))

    def merit(self, cell: Cell) -> float | None:
        """See Column.merit."""
        return rate(cell)


def _cells_of(found: Measured) -> list[dict[str, Any]]:
    """Cells of heat.heat_maps_of."""
    tasks, won = [task for task, _ in found.scenes], [found.outcomes[where] for where in found.scenes]
    scenes = list(found.scenes.values())
    return by_scene(tasks, scenes, lambda some: {"success": rate_entry(some)}, torch.tensor(won))


def outcomes_of(cfg: Cfg, folder: Path) -> dict[tuple[str, int], bool]:
    """Success by task and seed of a stage that evaluated a policy in physics."""
    seeds, (success,) = outcomes(folder)
    return dict(zip(zip(tasks_of_seeds(cfg, seeds), seeds, strict=True), success.tolist(), strict=True))


def together(several: Sequence[Mapping[tuple[str, int], T]]) -> dict[tuple[str, int], T]:
    """What is known of episodes with several seeds of training as of as many times the episodes."""
    return {
        (task, number * _APART + seed): won
        for number, one in enumerate(several)
        for (task, seed), won in one.items()
    }


_APART = 10**12  # between the episodes of one training seed and those of the next


def _mean(cells: Sequence[Cell]) -> dict[str, Any]:
    """Means of the numbers in cells, of those cells that have one; of anything else the first one's."""
    out = dict(cells[0])
    for key in out:
        values = [cell[key] for cell in cells if cell.get(key) is not None]
        if values and all(isinstance(one, (int, float)) for one in values):
            out[key] = sum(values) / len(values)
    return out
