"""worldloop summary: what fidelity, ewmbench and policy-value measured of one simulator, on one page."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from envs.files import write_text
from envs.targets import ConfigError
from pipeline.commands.worlds.subject import pages_of
from pipeline.evaluation.joined.page import build_page, parts_of, summary_text
from pipeline.loop import build_loop

RESULTS = ("fidelity", "ewmbench", "policy-value")  # commands, and the names of what they write


def summary(cfg: Mapping[str, Any], root: Path) -> str:
    """Write summary.html into the simulator's folder (see pages_of), from what is there. What was measured of
    other weights than the newest result, such as before they were trained anew, or with other options of the
    simulator, such as more steps, is left out.

    Returns:
        The table, as Markdown, and where the page lies.

    Raises:
        ConfigError: if nothing has been measured.
    """
    folder = pages_of(root, build_loop(cfg, root), cfg["imagined"])
    files = {name: folder / f"{name}.json" for name in RESULTS}
    there = {name: dict(json.loads(file.read_text())) for name, file in files.items() if file.is_file()}
    if not there:
        raise ConfigError(
            f"nothing was measured of the simulator of {folder}: first `worldloop fidelity`, `worldloop"
            " ewmbench` or `worldloop policy-value` with the same options"
        )
    newest = there[max(there, key=lambda name: files[name].stat().st_mtime)]
    odd = {name: _odd(result, newest) for name, result in there.items()}
    left_out = {name: f"What {files[name].name} says is of {why}." for name, why in odd.items() if why}
    parts = parts_of({name: result for name, result in there.items() if name not in left_out}, left_out)
    page = build_page(newest["name"], newest["simulator"], newest["weights"]["simulator"], parts)
    write_text(folder / "summary.html", page)
    return f"{summary_text(newest['simulator'], parts)}\n{folder / 'summary.html'}"


def _odd(result: Mapping[str, Any], newest: Mapping[str, Any]) -> str:
    """What a result is of that the newest is not; "" if both are of one simulator."""
    if _weights(result) != _weights(newest):
        return f"other weights: {', '.join(_weights(result))}"
    same = result.get("options") == newest.get("options")  # results of former versions hold none
    return "" if same else "the same weights with other options of the section simulator"


def _weights(result: Mapping[str, Any]) -> tuple[str, str]:
    """The file of the simulator's weights and its mark; results of former versions hold no marks."""
    return result["weights"]["simulator"], result.get("marks", {}).get("simulator", "unknown")
