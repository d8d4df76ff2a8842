"""All columns of a study in one table, and which row is best at what."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pipeline.study.columns import Column

NOT_RUN = "not run"
Columns = Mapping[str, Column]


def headlines(table: Mapping[str, Any], columns: Columns) -> list[list[str]]:
    """Headings, then a line for each row: one cell for each column, over all seeds that were run, which are
    told where other rows of the column were run with others.
    """
    lines = [["", *(_heading(column) for column in columns.values())]]
    for title in _titles(table):
        line = [title]
        for name, column in columns.items():
            seeds = _seeds(table, name, column)
            cell = _cell(table, name, column, title, seeds[title])
            text = NOT_RUN if cell is None else column.text(cell)
            if cell is not None and len({mine for mine in seeds.values() if mine}) > 1:
                text += f" (seed{'s' if len(seeds[title]) > 1 else ''} {', '.join(map(str, seeds[title]))})"
            line.append(text)
        lines.append(line)
    return lines


def best_of(table: Mapping[str, Any], columns: Columns) -> list[str]:
    """A sentence for each place: which row is best at each of the columns by which rows can be ranked; [] as
    long as fewer than two rows were run in it.

    Rows that were run with other seeds than others are compared on the first seed that all of them have.
    """
    titles = _titles(table)
    out = []
    for place in dict.fromkeys(titles.values()):
        winners = []
        for name, column in columns.items():
            seeds = {
                title: mine
                for title, mine in _seeds(table, name, column).items()
                if mine and titles[title] == place
            }
            common = sorted(set.intersection(*map(set, seeds.values()))) if seeds else []
            unlike = len(set(seeds.values())) > 1
            merits = {
                title: merit
                for title, mine in seeds.items()
                if (cell := _cell(table, name, column, title, tuple(common[:1]) if unlike else mine))
                if (merit := column.merit(cell)) is not None
            }
            if len(merits) > 1 and len(set(merits.values())) > 1:
                best = max(merits, key=merits.__getitem__)
                winners.append(f"{column.title}: {best}{f' (seed {common[0]})' if unlike else ''}")
        if winners:
            out.append(f"Best{f' in {place}' if place else ''}, of what was run: {'; '.join(winners)}.")
    return out


def _titles(table: Mapping[str, Any]) -> dict[str, str]:
    """Rows by title, and their places."""
    return {row["title"]: row["place"] for row in table["rows"]}


def _seeds(table: Mapping[str, Any], name: str, column: Column) -> dict[str, tuple[int, ...]]:
    """The seeds with which each row, by title, has the headline of a column."""
    out: dict[str, tuple[int, ...]] = dict.fromkeys(_titles(table), ())
    for row in table["rows"]:
        if row["cells"][name].get(column.headline) is not None:
            out[row["title"]] += (row["seed"],)
    return out


def _cell(table: Mapping[str, Any], name: str, column: Column, title: str, seeds: tuple[int, ...]) -> Any:
    """The headline of a column in a row: of one seed, or pooled over all that it was run with; None without
    any.
    """
    if len(seeds) == 1:
        rows = (row for row in table["rows"] if row["title"] == title and row["seed"] == seeds[0])
    else:
        rows = (row for row in table["pooled"] if row["title"] == title and seeds)
    return next((row["cells"][name].get(column.headline) for row in rows), None)


def _heading(column: Column) -> str:
    return column.title if column.headline == "all" else f"{column.title}, {column.headline}"
