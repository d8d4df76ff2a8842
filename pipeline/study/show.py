"""A study's table for people: Markdown for documents and terminals, a page for browsers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from markupsafe import Markup

from pipeline.evaluation.report import templates
from pipeline.markdown import markdown_table
from pipeline.study.columns import Column
from pipeline.study.side_by_side import NOT_RUN, best_of, headlines

OVER_SEEDS = (
    "Rows over several seeds count the episodes of all their policies: their intervals, and McNemar's p, hold"
    " for these policies. What other seeds may bring is told by the gains by seed, with Student's interval at"
    " 95% and p, which take a seed for one observation."
)
_NONE = "no episode"  # of a task, in a column that was run
Lines = list[list[str]]
Columns = Mapping[str, Column]


def sections_of(table: Mapping[str, Any], columns: Columns) -> list[tuple[str, Lines]]:
    """Title and lines, the first of which are headings, of all columns side by side if there are several, of
    each column's cells, and of the comparisons.
    """
    out = [("Side by side", headlines(table, columns))] if len(columns) > 1 else []
    for name, column in columns.items():
        known = table["columns"][name]
        labels = known["labels"]
        lines = [["", "seed", *labels, "physics episodes", "minutes"]]
        for row in table["rows"]:
            cells = [_cell(column, row["cells"][name], label) for label in labels]
            lines.append([row["title"], str(row["seed"]), *cells, _episodes(row), _minutes(row)])
        for row in table["pooled"]:
            seeds = row["seeds"][name]
            if len(seeds) > 1:
                cells = [_cell(column, row["cells"][name], label) for label in labels]
                lines.append([row["title"], ", ".join(map(str, seeds)), *cells, "", ""])
        out.append((known["title"], lines))
    return out + _comparisons(table)


def markdown(table: Mapping[str, Any], columns: Columns) -> str:
    """The whole table as Markdown."""
    parts = [f"# {table['name']}"]
    for title, lines in sections_of(table, columns):
        parts.append(f"## {title}\n\n{markdown_table(lines[0], lines[1:])}")
    parts += best_of(table, columns)
    if table["pooled"]:
        parts.append(OVER_SEEDS)
    parts += [f"{title}: {text}." for title, text in notes_of(table).items()]
    return "\n\n".join(parts) + "\n"


def page(table: Mapping[str, Any], columns: Columns, charts: Sequence[Markup]) -> str:
    """One self-contained HTML page."""
    return (
        templates()
        .get_template("study.html.j2")
        .render(
            name=table["name"],
            sections=sections_of(table, columns),
            best=[*best_of(table, columns), *([OVER_SEEDS] if table["pooled"] else [])],
            charts=charts,
            notes=notes_of(table),
            not_run=NOT_RUN,
        )
    )


def notes_of(table: Mapping[str, Any]) -> dict[str, str]:
    """What must be known to compare a row with others, by its title."""
    return {row["title"]: row["note"] for row in table["rows"] if row["note"]}


def _comparisons(table: Mapping[str, Any]) -> list[tuple[str, Lines]]:
    """For each column and row compared with: gains in points and McNemar's test of the same episodes."""
    out = []
    for name, known in table["columns"].items():
        for other in dict.fromkeys(entry["other"] for entry in table["comparisons"]):
            mine = [e for e in table["comparisons"] if (e["column"], e["other"]) == (name, other)]
            lines = [["", "seeds", *known["labels"]]]
            for entry in mine:
                cells = [_gain(entry["cells"].get(label)) for label in known["labels"]]
                lines.append([entry["title"], ", ".join(map(str, entry["seeds"])), *cells])
            if mine:
                titles = {row["title"] for row in table["rows"] if row["row"] == other}
                against = titles.pop() if len(titles) == 1 else other
                out.append((f"{known['title']}, against {against} on the same episodes", lines))
    return out


def _cell(column: Column, cells: Mapping[str, Any], label: str) -> str:
    if label not in cells:  # of other rows
        return ""
    if cells[label] is None:
        return NOT_RUN if all(cell is None for cell in cells.values()) else _NONE
    return column.text(cells[label])


def _gain(cell: Mapping[str, Any] | None) -> str:
    if cell is None:
        return "-"
    text = f"{cell['gain']:+.1f}, p {cell['p']:.2g} ({cell['gained']} won, {cell['lost']} lost)"
    if over := cell.get("over_seeds"):
        known = "" if over["p"] is None else f", p {over['p']:.2g}"
        gains = ", ".join(f"{gain:+.1f}" for gain in cell["by_seed"])
        text += f"; by seed {gains} [{over['low']:+.1f}, {over['high']:+.1f}]{known}"
    return text


def _episodes(row: Mapping[str, Any]) -> str:
    spent = row["physics_episodes"]
    return NOT_RUN if spent is None else " + ".join(f"{count} {who}" for who, count in spent.items())


def _minutes(row: Mapping[str, Any]) -> str:
    return NOT_RUN if row["minutes"] is None else f"{row['minutes']:.1f}"
