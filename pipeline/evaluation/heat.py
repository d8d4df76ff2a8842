"""Success by task and scene as heat maps: in truth, in imagination, and how far they lie apart."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.evaluation.statistics import rate, rise

Entry = Mapping[str, Any]
_FEW = 10  # scenes whose cells are wide enough for numbers


@dataclass(frozen=True)
class Cell:
    """One field.

    Args:
        colour: in CSS.
        text: in the field.
        title: what it says when it is pointed at.
    """

    colour: str
    text: str
    title: str


@dataclass(frozen=True)
class HeatMap:
    """Fields of every task (rows) in every scene (columns); None where no episode was tried."""

    title: str
    rows: Mapping[str, Sequence[Cell | None]]


@dataclass(frozen=True)
class HeatMaps:
    """Heat maps over the same scenes."""

    scenes: Sequence[str]
    maps: Sequence[HeatMap]

    @property
    def wide(self) -> bool:
        """Whether fields have room for their text."""
        return len(self.scenes) <= _FEW


def heat_maps(cells: Sequence[Entry]) -> HeatMaps | None:
    """Heat maps of result.json's `scenes`; None if there is one task in one scene, of which the whole says
    everything.
    """
    if not cells:
        return None
    fields: dict[str, Callable[[Entry], Cell | None]] = {
        "true before": lambda cell: _rate(cell, "physics_before"),
        "true after": lambda cell: _rate(cell, "physics_after"),
        "imagined after": lambda cell: _rate(cell, "imagined_after"),
        "imagined − true": _gap,
    }
    return _maps({title: (cells, field) for title, field in fields.items()})


def heat_maps_of(found: Mapping[str, Sequence[Entry]]) -> HeatMaps | None:
    """A heat map for each title, of cells with task, scene and the rate entry `success`; None if none of them
    has several scenes.
    """
    if all(len({cell["scene"] for cell in cells}) < 2 for cells in found.values()):
        return None
    return _maps({title: (cells, lambda cell: _rate(cell, "success")) for title, cells in found.items()})


def _maps(drawn: Mapping[str, tuple[Sequence[Entry], Callable[[Entry], Cell | None]]]) -> HeatMaps:
    """Maps over the same tasks and scenes, without those in which nothing was tried."""
    every = {(cell["task"], cell["scene"]) for cells, _ in drawn.values() for cell in cells}
    tasks, scenes = (sorted({where[n] for where in every}) for n in (0, 1))
    maps = []
    for title, (cells, field) in drawn.items():
        found = {(cell["task"], cell["scene"]): field(cell) for cell in cells}
        rows = {task: [found.get((task, scene)) for scene in scenes] for task in tasks}
        if any(cell for row in rows.values() for cell in row):
            maps.append(HeatMap(title, rows))
    return HeatMaps(scenes, maps)


def _where(cell: Entry) -> str:
    return f"{cell['task']}, {cell['scene']}" if cell["scene"] else str(cell["task"])


def _rate(cell: Entry, key: str) -> Cell | None:
    entry = cell.get(key)
    known = rate(entry) if entry else None
    if not entry or known is None:
        return None
    share = 100 * known
    interval = f"95% [{100 * entry['low']:.0f}, {100 * entry['high']:.0f}]"
    title = f"{_where(cell)}: {entry['successes']} of {entry['episodes']}, {interval}"
    return Cell(_mixed("--blue", 8 + 0.72 * share), f"{share:.0f}", title)


def _gap(cell: Entry) -> Cell | None:
    true, imagined = cell.get("physics_after"), cell.get("imagined_after")
    apart = rise(true, imagined) if true and imagined else None
    if not true or apart is None:
        return None
    points = 100 * apart
    kind = "--bad" if points > 0 else "--cold"
    title = f"{_where(cell)}: imagined {points:+.0f} points from {true['episodes']} true episodes"
    return Cell(_mixed(kind, min(80.0, abs(points))), f"{points:+.0f}", title)


def _mixed(colour: str, percent: float) -> str:
    return f"color-mix(in srgb, var({colour}) {percent:.0f}%, var(--card))"
