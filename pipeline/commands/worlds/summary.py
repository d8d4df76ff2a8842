"""worldloop summary: what fidelity, ewmbench and policy-value measured of one simulator, on one page."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from envs.files import write_text
from envs.targets import ConfigError
from pipeline.evaluation.joined.page import build_page, parts_of, summary_text

RESULTS = ("fidelity", "ewmbench", "policy-value")  # commands, and the names of what they write


def summary(root: Path) -> str:
    """Write summary.html into the run's folder, from what is there.

    Returns:
        The table, as Markdown.

    Raises:
        ConfigError: if nothing has been measured, or different weights were: of other files, or of one that
            was written anew in between.
    """
    found = {name: _read(root / f"{name}.json") for name in RESULTS}
    there = {name: result for name, result in found.items() if result is not None}
    if not there:
        raise ConfigError(
            f"nothing was measured of the simulator of {root}: first `worldloop fidelity`, `worldloop"
            " ewmbench` or `worldloop policy-value` with the same options"
        )
    weights = {name: _weights(result) for name, result in there.items()}
    if len(set(weights.values())) > 1:
        measured = "; ".join(f"{name}: {path}, {mark[:12]}" for name, (path, mark) in weights.items())
        raise ConfigError(f"different weights were measured ({measured}); measure anew, by equal options")
    first = next(iter(there.values()))
    parts = parts_of(*found.values())
    page = build_page(first["name"], first["simulator"], first["weights"]["simulator"], parts)
    write_text(root / "summary.html", page)
    return summary_text(first["simulator"], parts)


def _weights(result: Mapping[str, Any]) -> tuple[str, str]:
    """The file of the simulator's weights and its mark; results of former versions hold no marks."""
    return result["weights"]["simulator"], result.get("marks", {}).get("simulator", "unknown")


def _read(path: Path) -> dict[str, Any] | None:
    return dict(json.loads(path.read_text())) if path.is_file() else None
