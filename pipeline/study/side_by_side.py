"""All columns of a study in one table, and which row is best at what."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.study.columns import Column

NOT_RUN = "not run"
Columns = Mapping[str, Column]


def headlines(table: Mapping[str, Any], columns: Columns) -> list[list[str]]:
    """Headings, then a line for each row: one cell for each column, over all seeds that were run."""
    lines = [["", *(_heading(column) for column in columns.values())]]
    for title, cells in _rows(table).items():
        lines.append([title, *(_text(column, cells[name]) for name, column in columns.items())])
    return lines


def best_of(table: Mapping[str, Any], columns: Columns) -> list[str]:
    """A sentence for each place: which row is best at each of the columns by which rows can be ranked; [] as
    long as fewer than two rows were run in it.
    """
    places = dict.fromkeys(row["place"] for row in table["rows"])
    titles = {row["title"]: row["place"] for row in table["rows"]}
    out = []
    for place in places:
        mine = {title: cells for title, cells in _rows(table).items() if titles[title] == place}
        winners = []
        for name, column in columns.items():
            merits = {
                title: merit
                for title, cells in mine.items()
                if (cell := cells[name].get(column.headline)) is not None
                if (merit := column.merit(cell)) is not None
            }
            if len(merits) > 1 and len(set(merits.values())) > 1:
                winners.append(f"{column.title}: {max(merits, key=merits.__getitem__)}")
        if winners:
            out.append(f"Best{f' in {place}' if place else ''}, of what was run: {'; '.join(winners)}.")
    return out


def _rows(table: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Cells by column and label of each row, by title: pooled over seeds where several were run."""
    out: dict[str, dict[str, Any]] = {}
    for row in table["rows"]:
        known = out.setdefault(row["title"], dict(row["cells"]))
        for name, cells in row["cells"].items():  # of the first seed that was run
            if not any(known[name].values()):
                known[name] = cells
    for row in table["pooled"]:
        out[row["title"]].update(
            {name: row["cells"][name] for name, seeds in row["seeds"].items() if len(seeds) > 1}
        )
    return out


def _heading(column: Column) -> str:
    return column.title if column.headline == "all" else f"{column.title}, {column.headline}"


def _text(column: Column, cells: Mapping[str, Any]) -> str:
    cell = cells.get(column.headline)
    return NOT_RUN if cell is None else column.text(cell)
