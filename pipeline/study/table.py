"""The table of a study: what columns found of rows, what each row cost, and paired comparisons; None where a
cell was not run, or where a column that was run has no episode of a task.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from pipeline.evaluation.statistics import mcnemar, over_seeds
from pipeline.study.columns import ALL, Measured, Outcomes
from pipeline.study.plan import Row, Study

Table = dict[str, Any]
Key = tuple[str, str]  # name and place of a row
BySeed = Mapping[int, Measured]


def study_table(study: Study) -> Table:
    """The table as it stands.

    Returns:
        name; columns (title and labels by name); rows (row, place, title, seed, note, physics_episodes by who
        acted and minutes, both None before what the row is about is there, and cells by column and label, of
        those labels that the row has); pooled (the same rows over all their seeds, where several were run);
        comparisons (row, place, other, title, column, seeds, and by label gain in points, episodes, and
        McNemar's gained, lost, p of the same episodes; with several seeds by_seed, the gain of each, and
        over_seeds, see statistics.over_seeds).
    """
    found = measured(study)
    rows = {row.key: row for row in study.rows}
    labels = {
        key: {name: column.labels(row.cfg) for name, column in study.columns.items()}
        for key, row in rows.items()
    }
    return {
        "name": study.cfg["name"],
        "columns": {
            name: {"title": column.title, "labels": all_labels(study, name)}
            for name, column in study.columns.items()
        },
        "rows": [_entry(study, row, found, labels[row.key]) for row in study.rows],
        "pooled": [
            {
                "row": row.name,
                "place": row.place,
                "title": row.title,
                "seeds": {name: list(found[key, name]) for name in study.columns},
                "cells": {
                    name: _cells(pooled(study, found, key, name), labels[key][name]) for name in study.columns
                },
            }
            for key, row in rows.items()
            if any(len(found[key, name]) > 1 for name in study.columns)
        ],
        "comparisons": [
            comparison
            for number, other in enumerate(study.against)
            for (name, place), row in rows.items()
            for column in study.columns
            if name not in study.against[: number + 1]  # itself, and what it was compared with already
            if (comparison := _compared(row, other, column, found, labels[name, place][column]))
        ],
    }


def measured(study: Study) -> dict[tuple[Key, str], dict[int, Measured]]:
    """What has been run, by row and column, by seed."""
    out: dict[tuple[Key, str], dict[int, Measured]] = {}
    for row in study.rows:
        for name in study.columns:
            mine, one = out.setdefault((row.key, name), {}), study.read(row, name)
            if one is not None:
                mine[row.seed] = one
    return out


def pooled(study: Study, found: Mapping[tuple[Key, str], BySeed], key: Key, column: str) -> Measured | None:
    """What a column found of a row with all seeds that were run; None if there are none."""
    several = list(found[key, column].values())
    return study.columns[column].pool(several) if len(several) > 1 else next(iter(several), None)


def all_labels(study: Study, column: str) -> list[str]:
    """Labels of a column's cells, of all rows; what is over all of them stands last."""
    found = dict.fromkeys(label for row in study.rows for label in study.columns[column].labels(row.cfg))
    return [*(label for label in found if label != ALL), *(label for label in found if label == ALL)]


def _entry(
    study: Study,
    row: Row,
    found: Mapping[tuple[Key, str], BySeed],
    labels: Mapping[str, Sequence[str]],
) -> dict[str, Any]:
    """A row of one seed."""
    there = row.made.finished
    return {
        "row": row.name,
        "place": row.place,
        "title": row.title,
        "seed": row.seed,
        "note": row.note,
        "physics_episodes": row.made.physics_episodes() if there else None,
        "minutes": row.made.seconds() / 60 if there else None,
        "cells": {name: _cells(found[row.key, name].get(row.seed), labels[name]) for name in study.columns},
    }


def _cells(one: Measured | None, labels: Sequence[str]) -> dict[str, Any]:
    """Figures by label, None where there are none."""
    known = one.cells if one else {}
    return {label: dict(known[label]) if label in known else None for label in labels}


def _compared(
    row: Row,
    other: str,
    column: str,
    found: Mapping[tuple[Key, str], BySeed],
    labels: Sequence[str],
) -> dict[str, Any] | None:
    """A row against another in the same place, over the seeds with which both were run; None if there are
    none.
    """
    mine, theirs = found[row.key, column], found[(other, row.place), column]
    seeds = [seed for seed in mine if seed in theirs]
    pairs = [_pairs(theirs[seed].outcomes, mine[seed].outcomes) for seed in seeds]
    if not any(pairs):
        return None
    cells: dict[str, Any] = {}
    for label in labels:
        chosen = [[(one, two) for task, one, two in some if label in (task, ALL)] for some in pairs]
        if all(chosen):
            cells[label] = gain_of(*zip(*(pair for some in chosen for pair in some), strict=True))
            if len(chosen) > 1:
                gains = [gain_of(*zip(*some, strict=True))["gain"] for some in chosen]
                cells[label] |= {"by_seed": gains, "over_seeds": over_seeds(gains)}
    return {
        "row": row.name,
        "place": row.place,
        "other": other,
        "title": row.title,
        "column": column,
        "seeds": seeds,
        "cells": cells,
    }


def _pairs(before: Outcomes, after: Outcomes) -> list[tuple[str, bool, bool]]:
    """Task, and success before and after, of the episodes that both have."""
    return [(where[0], before[where], won) for where, won in after.items() if where in before]


def gain_of(before: Sequence[bool], after: Sequence[bool]) -> dict[str, Any]:
    """gain in points, episodes, and McNemar's gained, lost, p, of the same episodes [N]."""
    one, two = torch.tensor(before), torch.tensor(after)
    gain = 100 * float(two.float().mean() - one.float().mean())
    return {"gain": gain, "episodes": len(one), **mcnemar(one, two)}
