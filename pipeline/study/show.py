"""A study's table for people: Markdown for documents and terminals, a page for browsers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from pipeline.study.columns import Column

NOT_RUN = "not run"
Lines = list[list[str]]


def sections_of(table: Mapping[str, Any], columns: Mapping[str, Column]) -> list[tuple[str, Lines]]:
    """Title and lines, the first of which are headings, of each column's cells and of the comparisons."""
    out = []
    for name, column in columns.items():
        known = table["columns"][name]
        labels = known["labels"]
        lines = [["", "seed", *labels, "physics episodes", "minutes"]]
        for row in table["rows"]:
            cells = [_cell(column, row["cells"][name][label]) for label in labels]
            lines.append([row["title"], str(row["seed"]), *cells, _episodes(row), _minutes(row)])
        for row in table["pooled"]:
            seeds = row["seeds"][name]
            if len(seeds) > 1:
                cells = [_cell(column, row["cells"][name][label]) for label in labels]
                lines.append([row["title"], ", ".join(map(str, seeds)), *cells, "", ""])
        out.append((known["title"], lines))
    return out + _comparisons(table)


def markdown(table: Mapping[str, Any], columns: Mapping[str, Column]) -> str:
    """The whole table as Markdown."""
    parts = [f"# {table['name']}"]
    for title, lines in sections_of(table, columns):
        rows = [lines[0], ["---"] * len(lines[0]), *lines[1:]]
        parts.append(f"## {title}\n\n" + "\n".join(f"| {' | '.join(row)} |" for row in rows))
    parts += [f"{title}: {text}." for title, text in notes_of(table).items()]
    return "\n\n".join(parts) + "\n"


def page(table: Mapping[str, Any], columns: Mapping[str, Column]) -> str:
    """One self-contained HTML page."""
    made = Environment(
        loader=PackageLoader("pipeline", "evaluation/page"),
        autoescape=select_autoescape(["j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return made.get_template("study.html.j2").render(
        name=table["name"], sections=sections_of(table, columns), notes=notes_of(table), not_run=NOT_RUN
    )


def notes_of(table: Mapping[str, Any]) -> dict[str, str]:
    """What must be known to compare a row with others, by its title."""
    return {row["title"]: row["note"] for row in table["rows"] if row["note"]}


def _comparisons(table: Mapping[str, Any]) -> list[tuple[str, Lines]]:
    """For each column and row compared with: gains in points and McNemar's test of the same episodes."""
    titles = {row["row"]: row["title"] for row in table["rows"]}
    out = []
    for name, known in table["columns"].items():
        for other in dict.fromkeys(entry["other"] for entry in table["comparisons"]):
            mine = [e for e in table["comparisons"] if (e["column"], e["other"]) == (name, other)]
            lines = [["", "seeds", *known["labels"]]]
            for entry in mine:
                cells = [_gain(entry["cells"].get(label)) for label in known["labels"]]
                lines.append([titles[entry["row"]], ", ".join(map(str, entry["seeds"])), *cells])
            if mine:
                out.append((f"{known['title']}, against {titles[other]} on the same episodes", lines))
    return out


def _cell(column: Column, cell: Mapping[str, Any] | None) -> str:
    return NOT_RUN if cell is None else column.text(cell)


def _gain(cell: Mapping[str, Any] | None) -> str:
    if cell is None:
        return "-"
    return f"{cell['gain']:+.1f}, p {cell['p']:.2g} ({cell['gained']} won, {cell['lost']} lost)"


def _episodes(row: Mapping[str, Any]) -> str:
    spent = row["physics_episodes"]
    return NOT_RUN if spent is None else " + ".join(f"{count} {who}" for who, count in spent.items())


def _minutes(row: Mapping[str, Any]) -> str:
    return NOT_RUN if row["minutes"] is None else f"{row['minutes']:.1f}"
