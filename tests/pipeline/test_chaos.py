"""A minute of chaos with real kills, as a user would run it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path


def test_a_minute_of_chaos_leaves_balanced_books(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pipeline", "chaos", "chaos.seconds=60", f"runs={tmp_path}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr[-3000:] + (tmp_path / "chaos-0/learner.log").read_text()[-3000:]
    found = json.loads((tmp_path / "chaos-0/chaos.json").read_text())
    assert (
        found["balanced"]
        and found["learner_kills"] >= 1
        and found["iterations"] >= 1
        and sum(found["events"].values()) >= 2
    )
