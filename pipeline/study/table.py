"""The table of a study: rates with intervals, what each row cost, and paired comparisons; None where a cell
was not run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from pipeline.evaluation.statistics import mcnemar
from pipeline.study.columns import ALL, Measured
from pipeline.study.plan import Row, Study

Table = dict[str, Any]


def study_table(study: Study) -> Table:
    """The table as it stands.

    Returns:
        name; columns (title and labels by name); rows (row, title, seed, note, physics_episodes by who acted
        and minutes, both None before the policy is there, and cells by column and label); pooled (the same
        rows over all their seeds, where several were run); comparisons (row, other, column, seeds, and by
        label gain in points, episodes, and McNemar's gained, lost, p of the same episodes).
    """
    columns = study.columns
    found = {
        (row.name, row.seed, column): study.read(row, column) for row in study.rows for column in columns
    }
    names = list(dict.fromkeys(row.name for row in study.rows))
    labels = {column: _labels(study, column) for column in columns}
    seeds = {name: [row.seed for row in study.rows if row.name == name] for name in names}
    titles = {row.name: row.title for row in study.rows}
    together = {
        (name, column): _together({seed: found[name, seed, column] for seed in seeds[name]})
        for name in names
        for column in study.columns
    }
    return {
        "name": study.cfg["name"],
        "columns": {
            name: {"title": column.title, "labels": labels[name]} for name, column in study.columns.items()
        },
        "rows": [_entry(study, row, found, labels) for row in study.rows],
        "pooled": [
            {
                "row": name,
                "title": titles[name],
                "seeds": {column: list(together[name, column]) for column in study.columns},
                "cells": {
                    column: _cells(_pooled(list(together[name, column].values())), labels[column])
                    for column in study.columns
                },
            }
            for name in names
            if any(len(together[name, column]) > 1 for column in study.columns)
        ],
        "comparisons": [
            comparison
            for place, other in enumerate(study.against)
            for name in names
            for column in study.columns
            if name not in study.against[: place + 1]  # itself, and what it was compared with already
            if (comparison := _compared(name, other, column, together, labels[column]))
        ],
    }


def _entry(
    study: Study,
    row: Row,
    found: Mapping[tuple[str, int, str], Measured | None],
    labels: Mapping[str, Sequence[str]],
) -> dict[str, Any]:
    """A row of one seed."""
    there = row.made.finished
    return {
        "row": row.name,
        "title": row.title,
        "seed": row.seed,
        "note": row.note,
        "physics_episodes": row.made.physics_episodes() if there else None,
        "minutes": row.made.seconds() / 60 if there else None,
        "cells": {
            column: _cells(found[row.name, row.seed, column], labels[column]) for column in study.columns
        },
    }


def _cells(measured: Measured | None, labels: Sequence[str]) -> dict[str, Any]:
    """Figures by label, None where there are none."""
    known = measured.cells if measured else {}
    return {label: dict(known[label]) if label in known else None for label in labels}


def _labels(study: Study, column: str) -> list[str]:
    """Labels of a column's cells, of all rows; what is over all of them stands last."""
    found = dict.fromkeys(label for row in study.rows for label in study.columns[column].labels(row.cfg))
    return [*(label for label in found if label != ALL), *(label for label in found if label == ALL)]


def _together(by_seed: Mapping[int, Measured | None]) -> dict[int, Measured]:
    """What has been run, by seed."""
    return {seed: measured for seed, measured in by_seed.items() if measured is not None}


def _pooled(measured: Sequence[Measured]) -> Measured | None:
    """Success over several seeds of training, each on the same episodes; None if there is nothing to pool."""
    merged = {
        (task, number * _APART + seed): won
        for number, one in enumerate(measured)
        for (task, seed), won in one.outcomes.items()
    }
    return Measured.of_success(merged) if merged else None


_APART = 10**12  # between the episodes of one training seed and those of the next


def _compared(
    name: str,
    other: str,
    column: str,
    together: Mapping[tuple[str, str], Mapping[int, Measured]],
    labels: Sequence[str],
) -> dict[str, Any] | None:
    """A row against another, over the seeds with which both were run; None if there are none."""
    mine, theirs = together[name, column], together[other, column]
    pairs = [
        (task, theirs[seed].outcomes[task, episode], won)
        for seed in mine
        if seed in theirs
        for (task, episode), won in mine[seed].outcomes.items()
        if (task, episode) in theirs[seed].outcomes
    ]
    if not pairs:
        return None
    cells: dict[str, Any] = {}
    for label in labels:
        chosen = [(before, after) for task, before, after in pairs if label in (task, ALL)]
        if chosen:
            before, after = (torch.tensor(side) for side in zip(*chosen, strict=True))
            gain = 100 * float(after.float().mean() - before.float().mean())
            cells[label] = {"gain": gain, "episodes": len(chosen), **mcnemar(before, after)}
    seeds = [seed for seed in mine if seed in theirs]
    return {"row": name, "other": other, "column": column, "seeds": seeds, "cells": cells}
