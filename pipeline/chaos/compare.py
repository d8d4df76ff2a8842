"""Whether two runs of one config hold the same: every file, bit for bit, but for times and traffic."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from envs.manifest import MANIFEST, digest_of, hashes

# Times, what travelled between processes, and workers that were replaced: how a run went, not what it made.
_THE_WAY = re.compile(r"time/|second|minutes|_m?s$|_bytes$|^(deaths|rerun)$")


def differences(one: Path, other: Path) -> list[str]:
    """Paths of files that differ, or that only one of two runs has."""
    mine, theirs = _files(one), _files(other)
    return sorted(name for name in mine.keys() | theirs.keys() if mine.get(name) != theirs.get(name))


def _files(run: Path) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for path in sorted((run / "stages").glob(f"*/{MANIFEST}")):
        stage = path.parent
        if stage.name.startswith("report-"):  # says the run's name; all that it shows is compared here
            continue
        out[stage.name] = _timeless(json.loads(path.read_text())["result"])
        for name in hashes(stage):
            out[f"{stage.name}/{name}"] = _content(stage / name)
    return out


def _content(path: Path) -> Any:
    if path.suffix == ".jsonl":
        return [_timeless(json.loads(line)) for line in path.read_text().splitlines()]
    if path.suffix in (".html", ".png"):
        return None  # drawn from what is compared
    return digest_of(path)


def _timeless(value: Any) -> Any:
    """Without what no two runs share."""
    if isinstance(value, dict):
        return {key: _timeless(held) for key, held in value.items() if not _THE_WAY.search(str(key))}
    return [_timeless(held) for held in value] if isinstance(value, list) else value
