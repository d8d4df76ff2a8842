"""Finished runs side by side: engines, algorithms or seeds, as a Markdown table with one column a run."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from actors.factory import ConfigError
from pipeline.evaluation.statistics import rate_line

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
    lines = [["", *(folder.name for folder in folders)], ["---"] * (1 + len(folders))]
    lines += [[label, *(cell(result) for result in results)] for label, cell in _ROWS]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _percent(entry: Result) -> str:
    return f"{100 * entry['successes'] / max(1, entry['episodes']):.1f}%"


def _rate(key: str) -> Callable[[Result], str]:
    return lambda r: rate_line(r[key])


def _gain(result: Result) -> str:
    before, after = (
        result[key]["successes"] / result[key]["episodes"] for key in ("physics_before", "physics_after")
    )
    return f"**{100 * (after - before):+.1f}** points"


def _minutes(*stages: str) -> Callable[[Result], str]:
    return lambda r: f"{sum(s for name, s in r['stage_seconds'].items() if name.startswith(stages)) / 60:.1f}"


def _figure(form: Callable[[Result], str]) -> Callable[[Result], str]:
    """Figures of the rollouts of each group of episodes."""
    return lambda r: "; ".join(form(r["rollout"][group]) for group in _GROUPS)


def _error(key: str, digits: int) -> Callable[[Result], str]:
    """Median and 90th percentile of a rollout's error."""
    return _figure(lambda d: f"{d[key]['median']:.{digits}f} / {d[key]['p90']:.{digits}f}")


def _verdicts(source: str) -> Callable[[Result], str]:
    return lambda r: "; ".join(f"{100 * r['judge'][group][source]['accuracy']:.1f}" for group in _GROUPS)


_GROUPS = ("expert", "noisy", "on-policy")
_OF = ", ".join(_GROUPS[:-1]) + " and " + _GROUPS[-1]
_ROWS: tuple[tuple[str, Callable[[Result], str]], ...] = (
    ("engine; algorithm; seed", lambda r: f"{r['engine']}; {r['algorithm']}; {r['seed']}"),
    ("true success before", _rate("physics_before")),
    ("true success after", _rate("physics_after")),
    ("gain", _gain),
    (
        "gained / lost, McNemar p",
        lambda r: f"{r['paired']['gained']} / {r['paired']['lost']}, {r['paired']['p']:.1e}",
    ),
    (
        "imagined before → after",
        lambda r: f"{_percent(r['imagined_before'])} → {_percent(r['imagined_after'])}",
    ),
    (
        "gap imagined - true, by round",
        lambda r: ", ".join(f"{100 * entry['gap']:+.1f}" for entry in r["rounds"]),
    ),
    ("physics episodes learned from", lambda r: str(r["physics_episodes_used"])),
    (
        "imagined episodes learned from, by round",
        lambda r: ", ".join(str(n) for n in r["imagined_episodes_used"]),
    ),
    ("minutes in all", _minutes("")),
    ("autoencoder, vision", _minutes("tokenizer", "vision")),
    ("joint states", _minutes("state")),
    ("judge", _minutes("judge")),
    ("RL in imagination", _minutes("rl")),
    (f"object px, median / p90, {_OF}", _error("object_px", 2)),
    ("object cm", _error("object_cm", 2)),
    ("own account cm", _error("place_cm", 2)),
    ("joint states rad", _error("state_rad", 4)),
    ("object not found, % of frames", _figure(lambda d: f"{100 * d['object_lost']:.1f}")),
    (
        "PSNR dB, first → last frames",
        _figure(lambda d: f"{d['psnr_first_frames']:.1f} → {d['psnr_last_frames']:.1f}"),
    ),
    ("verdicts right, %, real video", _verdicts("physics video")),
    ("verdicts right, %, generated video", _verdicts("simulator rollouts")),
    (
        "frames/s at batch 1, 32",
        lambda r: ", ".join(f"{speed:.0f}" for speed in r["frames_per_second"].values()),
    ),
)
