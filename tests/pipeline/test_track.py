"""Tracking is live: rows are in the wandb run before the stage that writes them ends."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from pipeline import track
from pipeline.graph.graph import Graph
from pipeline.graph.stage import Inputs, stage
from pipeline.graph.view import ConfigView
from pipeline.track import WandbTracker, tracking

CFG: dict[str, Any] = {
    "name": "tiny",
    "seed": 0,
    "track": {"wandb": "offline", "project": "worldloop"},
    "launch": {},
}


def logged(root: Path) -> str:
    """What offline runs hold on disk so far, as text between bytes."""
    return "".join(path.read_bytes().decode("latin1") for path in root.rglob("run-*.wandb"))


@stage(reads=("name",))
def slow(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Write a row, and wait until it is in the wandb run."""
    with (folder / "metrics.jsonl").open("a") as rows:
        rows.write(json.dumps({"step": 0, "slow/loss_before_the_end": 0.5}) + "\n")
        rows.flush()
        rows.write('{"step": 1, "half a ro')
        rows.flush()
        deadline = time.monotonic() + 60
        while "loss_before_the_end" not in logged(folder.parent.parent) and time.monotonic() < deadline:
            time.sleep(0.2)
    (folder / "metrics.jsonl").write_text(
        '{"step": 0, "slow/loss_before_the_end": 0.5}\n{"step": 1, "slow/loss_before_the_end": 0.25}\n'
    )
    return {"seen": "loss_before_the_end" in logged(folder.parent.parent)}


def test_rows_appear_before_the_stage_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(track, "_PERIOD", 0.2)
    graph = Graph(CFG, tmp_path / "stages")
    graph.add("slow", slow)
    with tracking(CFG, tmp_path) as tracker:
        manifests = graph.run(tracker=tracker)
    assert manifests["slow"]["result"]["seen"]
    state = json.loads((tmp_path / "wandb.json").read_text())
    assert state["rows"] == {"slow": 1}
    with tracking(CFG, tmp_path) as tracker:  # goes on in the same run, and sends nothing twice
        graph.run(tracker=tracker)
        assert isinstance(tracker, WandbTracker) and tracker._run.id == state["id"]
    assert json.loads((tmp_path / "wandb.json").read_text()) == state


def test_disabled_imports_nothing(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from pipeline.track import tracking\n"
        f"with tracking({{'track': {{'wandb': 'disabled'}}}}, Path({str(tmp_path)!r})) as tracker:\n"
        "    with tracker.follow('a', Path('.')): pass\n"
        "assert 'wandb' not in sys.modules and not list(Path("
        f"{str(tmp_path)!r}).iterdir())"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
