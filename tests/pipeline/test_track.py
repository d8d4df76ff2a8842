"""Tracking is live: rows are in the wandb run before the stage that writes them ends."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs.episodes.filming import write_film
from envs.episodes.video import read_video
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


@stage(reads=("name",))
def filming(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Learn in a part of the stage, show two videos, and one twice while it learns."""
    (folder / "part").mkdir()
    (folder / "part/metrics.jsonl").write_text('{"step": 3, "part/loss": 0.5}\n')
    for number in range(2):
        frames = [np.full((32, 48, 3), 40 * step, np.uint8) for step in range(4)]
        write_film(folder / f"media/before-{number}.mp4", frames, 10.0, rest=5)
    for step in (100, 200):
        write_film(folder / f"media/held-out-step{step:06d}.mp4", frames, 10.0, rest=5)
    return {}


def test_videos_and_parts_of_a_stage_are_tracked_once(tmp_path: Path) -> None:
    graph = Graph(CFG, tmp_path / "stages")
    graph.add("videos", filming)
    for _ in range(2):
        with tracking(CFG, tmp_path) as tracker:
            graph.run(tracker=tracker)
        state = json.loads((tmp_path / "wandb.json").read_text())
        late = [f"videos/held-out-step000{step}.mp4" for step in (100, 200)]
        assert state["videos"] == ["videos/before-0.mp4", "videos/before-1.mp4", *late]
        assert state["rows"] == {"videos-part": 3}
        sent = [path for path in tmp_path.rglob("*.mp4") if "wandb" in path.parts]
        assert len(sent) == 4 and all(path.stat().st_size > 0 for path in sent)


def test_no_video_is_seen_before_it_is_whole(tmp_path: Path) -> None:
    seen: list[list[Path]] = []

    class Looking:
        """A picture that looks for videos when it is encoded."""

        shape = (32, 48, 3)

        def __array__(self, *_: Any, **__: Any) -> np.ndarray:
            seen.append(sorted(tmp_path.glob("*.mp4")))
            return np.zeros(self.shape, np.uint8)

    write_film(tmp_path / "one.mp4", [Looking()] * 3, 10.0, rest=5)  # type: ignore[list-item]
    assert len(seen) >= 3 and not any(seen)
    assert read_video(tmp_path / "one.mp4").shape == (8, 3, 32, 48) and len(list(tmp_path.iterdir())) == 1


def test_disabled_imports_nothing(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from pipeline.track import tracking\n"
        f"with tracking({{'track': {{'wandb': 'disabled'}}}}, Path({str(tmp_path)!r})) as tracker:\n"
        "    with tracker.follow('a', Path('.')): pass\n"
        "assert 'wandb' not in sys.modules and not list(Path("
        f"{str(tmp_path)!r}).iterdir())"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
