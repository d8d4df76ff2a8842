"""Finished runs side by side: engines, algorithms or seeds, as a Markdown table with one column a run."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from envs.targets import ConfigError
from pipeline.evaluation.statistics import (
    percent_line,
    points_line,
    psnr_line,
    rate_line,
    rise,
    verdicts_line,
)
from pipeline.markdown import markdown_table

Result = Mapping[str, Any]


def compare(folders: list[Path]) -> str:
    """The table of the runs in `folders`, from their result.json.

    Raises:
        ConfigError: if a folder holds no finished run.
    """
    results = []
    for folder in folders:
        file = folder / "result.json"
        if not file.is_file():
            raise ConfigError(
                f"{file} is not there; a run writes it when it ends: worldloop run name={folder.name} ..."
            )
        results.append(json.loads(file.read_text()))
    rows = [[label, *(cell(result) for result in results)] for label, cell in _ROWS]
    return markdown_table(["", *(folder.name for folder in folders)], rows)


def _rate(key: str) -> Callable[[Result], str]:
    return lambda r: rate_line(r[key]) if r[key] else "-"


def _gain(result: Result) -> str:
    if not result["physics_before"]:
        return "-"
    return f"**{points_line(rise(result['physics_before'], result['physics_after']))}** points"


def _paired(result: Result) -> str:
    paired = result["paired"]
    return f"{paired['gained']} / {paired['lost']}, {paired['p']:.1e}" if paired else "-"


def _minutes(*stages: str) -> Callable[[Result], str]:
    return lambda r: f"{sum(s for name, s in r['stage_seconds'].items() if name.startswith(stages)) / 60:.1f}"


def _figure(form: Callable[[Result], str]) -> Callable[[Result], str]:
    """A figure of the rollouts of each group of episodes; groups differ by data."""

    def cells(result: Result) -> str:
        return "; ".join(f"{name} {form(row)}" for name, row in result["rollout"].items())

    return cells


def _error(key: str, digits: int) -> Callable[[Result], str]:
    """Median and 90th percentile of a rollout's error, "-" where nobody knows it."""
    return _figure(
        lambda d: f"{d[key]['median']:.{digits}f} / {d[key]['p90']:.{digits}f}" if d.get(key) else "-"
    )


def _verdicts(video: str) -> Callable[[Result], str]:
    return lambda r: "; ".join(
        f"{group} {verdicts_line(tables[video])}" for group, tables in r["judge"].items()
    )


_ROWS: tuple[tuple[str, Callable[[Result], str]], ...] = (
    ("task; simulator; policy", lambda r: f"{r['task']}; {r['simulator']}; {r['policy']}"),
    ("algorithm; seed", lambda r: f"{r['algorithm']}; {r['seed']}"),
    ("true success before", _rate("physics_before")),
    ("true success after", _rate("physics_after")),
    ("gain", _gain),
    ("gained / lost, McNemar p", _paired),
    (
        "imagined before → after",
        lambda r: f"{percent_line(r['imagined_before'])} → {percent_line(r['imagined_after'])}",
    ),
    (
        "gap imagined - true, by round",
        lambda r: ", ".join(points_line(entry["gap"]) for entry in r["rounds"]),
    ),
    ("recorded episodes learned from", lambda r: str(r["episodes_used"])),
    (
        "imagined episodes played, by round",
        lambda r: ", ".join(str(n) for n in r["imagined_episodes_used"]),
    ),
    ("minutes in all", _minutes("")),
    ("tokenizer, simulator, student", _minutes("tokenizer", "simulator", "student", "pace")),
    ("state expert", _minutes("state")),
    ("judge", _minutes("judge", "text_world")),
    ("RL in imagination", _minutes("rl")),
    (
        "PSNR dB, first → last frames",
        _figure(lambda d: psnr_line(d["psnr_first_frames"], d["psnr_last_frames"])),
    ),
    ("state, spreads, median / p90", _error("state", 3)),
    ("object px", _error("object_px", 2)),
    ("object cm", _error("object_cm", 2)),
    ("verdicts that are right, recorded video", _verdicts("recorded")),
    ("verdicts that are right, generated video", _verdicts("generated")),
    (
        "frames/s at batch 1, 32",
        lambda r: ", ".join(f"{speed:.0f}" for speed in r["frames_per_second"].values()),
    ),
)
