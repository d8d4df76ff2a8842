"""EWMBench as text and as one page that a paper could print."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.evaluation.media import inline
from pipeline.evaluation.report import templates
from pipeline.markdown import markdown_table

# Columns of the table: key, heading and form. Arrows say which way is better.
COLUMNS = (
    ("scene", "scene ↑", "{:.3f}"),
    ("sa", "SA ↑", "{:.3f}"),
    ("ta", "TA ↑", "{:.3f}"),
    ("dyn", "DYN ↑", "{:.3f}"),
    ("hsd", "HSD ↓", "{:.4f}"),
    ("ndtw", "NDTW ↓", "{:.4f}"),
    ("missing", "no gripper ↓", "{:.1%}"),
    ("bleu", "BLEU ↑", "{:.3f}"),
    ("steps", "steps ↑", "{:.3f}"),
    ("logic", "logic ↑", "{:.3f}"),
    ("diversity", "diversity", "{:.4f}"),
)


def build_page(result: Mapping[str, Any], films: Mapping[int, Path]) -> str:
    """One self-contained HTML page of ewmbench.json.

    Args:
        films: the video of the sample that stands for an episode, of some, by number.
    """
    shown = [row for row in result["rows"] if row["episode"] in films and films[row["episode"]].is_file()]
    videos = [
        {
            **row,
            "url": inline(films[row["episode"]].read_bytes(), "video/mp4"),
            "cells": _cells(row["generated"]),
        }
        for row in shown
    ]
    return (
        templates()
        .get_template("ewmbench.html.j2")
        .render(
            result=result,
            headings=[title for _, title, _ in COLUMNS],
            rows=_rows(result),
            videos=videos,
            detector=_detector(result["detector"]),
            table=[[f"{row['episode']}", *_cells(row["generated"])] for row in result["rows"]],
        )
    )


def summary_text(result: Mapping[str, Any]) -> str:
    """Markdown: the table, the detector's own error, and what must be known to read them."""
    rows = [[name, *cells] for name, cells in _rows(result).items()]
    lines = [
        f"{result['simulator']} on {len(result['rows'])} held-out episodes, {result['samples']} samples of"
        " each",
        "",
        markdown_table(["", *(title for _, title, _ in COLUMNS)], rows),
        "",
        *(f"{name}: {text}" for name, text in _detector(result["detector"]).items()),
        *result["notes"],
    ]
    return "\n".join(lines)


def chosen_text(result: Mapping[str, Any]) -> str:
    """Which of its samples stands for an episode: without trajectories none is known to be the best."""
    if result["samples"] == 1:
        return "generated"
    return f"{'first' if result['overall']['generated']['sa'] is None else 'best'} of {result['samples']}"


def _rows(result: Mapping[str, Any]) -> dict[str, list[str]]:
    """Cells by the name of the row."""
    count, whole, best = result["samples"], result["overall"], chosen_text(result)
    rows = {best: _cells(whole["generated"])}
    if count > 1:
        rows[f"mean of {count}"] = _cells(whole["mean"])
    for task, figures in result["tasks"].items():
        rows[f"{task}, {best}"] = _cells(figures["generated"])
    return {**rows, "recorded": _cells(whole["recorded"]), "first frame held": _cells(whole["still"])}


def _cells(row: Mapping[str, Any]) -> list[str]:
    """The texts of COLUMNS; "-" for what is unknown."""
    return ["-" if row.get(key) is None else form.format(row[key]) for key, _, form in COLUMNS]


def _detector(found: Mapping[str, Any] | None) -> dict[str, str]:
    """What the detector's own error is, by camera."""
    if not found:
        return {}
    return {f"gripper detector, {view}": error_text(row) for view, row in found["cameras"].items()}


def error_text(row: Mapping[str, Any]) -> str:
    """A camera's row of detecting.detector_error in words."""
    parts = ["finds none"]
    if row["px"] is not None:
        parts = [f"{row['px']['median']:.2f} px off (median; 90% within {row['px']['p90']:.2f})"]
    if row["missed"] is not None:
        parts.append(f"misses {100 * row['missed']:.1f}%")
    if row["imagined"] is not None:
        parts.append(f"imagines {100 * row['imagined']:.1f}% of those out of sight")
    return f"{', '.join(parts)} on {row['frames']} held-out frames"
