"""Tables that people read in a terminal, and that pages and issues show as such."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def markdown_table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown; bars inside cells are escaped.

    Raises:
        ValueError: if a row has not as many cells as there are headings.
    """
    lines = [_line(headings), f"|{' --- |' * len(headings)}"]
    for row in rows:
        if len(row) != len(headings):
            raise ValueError(f"{len(row)} cells, {list(row)}, under {len(headings)} headings")
        lines.append(_line(row))
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
