"""A few minutes of chaos with real kills, as a user would run it."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from envs.manifest import DamagedArtefact, check, check_whole, keep_whole, read_manifest, write_manifest
from pipeline.chaos.books import Books
from pipeline.chaos.compare import differences
from pipeline.chaos.corruption import spoil


def chaos(folder: Path, *words: str) -> Path:
    command = [sys.executable, "-m", "pipeline", "chaos", f"runs={folder}", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-5000:]
    return folder / "chaos-0"


@pytest.mark.long
def test_kills_on_ray_leaves_balanced_books(tmp_path: Path) -> None:
    folder = chaos(tmp_path, "chaos.events=0", "chaos.seconds=20")
    found = json.loads((folder / "fleet/chaos.json").read_text())
    assert found["balanced"] and found["learner_kills"] >= 1 and found["iterations"] >= 1
    assert sum(found["events"].values()) >= 2


@pytest.mark.long
def test_a_slice_of_the_soak_leaves_nothing_wrong_unnoticed(tmp_path: Path) -> None:
    events = 16
    words = (f"chaos.events={events}", "chaos.seconds=0")
    folder = chaos(tmp_path, *words)
    books: dict[str, Any] = json.loads((folder / "soak/books.json").read_text())
    assert Books(**books).count >= events and books["runs"] >= 1 and len(books["events"]) >= events // 3
    assert set(books["answers"]) <= {
        *(f"{kind}: ended as asked" for kind in ("SIGKILL", "SIGKILL at a write", "SIGTERM", "SIGINT")),
        "worker killed: replaced",
        "disk full: told in a line",
        "corruption: told by name",
    }
    again = json.loads((chaos(tmp_path, *words) / "soak/books.json").read_text())
    assert again == books  # a soak goes on where it was: here, at its end


@pytest.mark.parametrize("seed", range(60))
def test_no_spoiled_file_passes(seed: int, tmp_path: Path) -> None:
    stage = tmp_path / "stages/one-key"
    (stage / "dataset").mkdir(parents=True)
    (stage / "weights.safetensors").write_bytes(bytes(range(200)))
    (stage / "dataset/info.json").write_text('{"fps": 10}')
    (stage / "empty.jsonl").touch()
    write_manifest(stage, {"stage": "one", "result": {"loss": 0.25}, "seconds": 12.5})
    (stage / "checkpoint-000000004").mkdir()  # a process may be killed before it has removed them
    (stage / "checkpoint-000000004/buffers.safetensors").write_bytes(b"x")
    manifest = read_manifest(stage)
    assert manifest is not None
    check(stage, manifest)
    done = spoil(tmp_path / "stages", random.Random(seed))
    assert done is not None and done[0] == stage
    with pytest.raises(DamagedArtefact, match="one-key"):
        check(stage, read_manifest(stage) or {})


@pytest.mark.parametrize("seed", range(10))
def test_no_spoiled_file_of_an_unfinished_stage_passes(seed: int, tmp_path: Path) -> None:
    stage = tmp_path / "stages/one-key"
    (stage / "dataset").mkdir(parents=True)
    for number in range(3):
        (stage / f"dataset/file-{number}.mp4").write_bytes(bytes(range(200)))
        keep_whole(stage, stage.glob("dataset/*"))
    (stage / "half.jsonl").touch()
    check_whole(stage)
    done = spoil(tmp_path / "stages", random.Random(seed))
    assert done is not None and done[0] == stage and "half" not in done[1]
    with pytest.raises(DamagedArtefact, match="one-key"):
        check_whole(stage)
    with pytest.raises(DamagedArtefact, match="one-key"):
        write_manifest(stage, {"stage": "one", "result": {}})


def test_runs_are_equal_but_for_their_times(tmp_path: Path) -> None:
    def made(name: str, weight: bytes, seconds: float, loss: float) -> Path:
        stage = tmp_path / name / "stages/one-key"
        stage.mkdir(parents=True)
        (stage / "weights.safetensors").write_bytes(weight)
        (stage / "metrics.jsonl").write_text(json.dumps({"step": 0, "loss": loss, "time/ms": seconds}) + "\n")
        write_manifest(stage, {"stage": "one", "result": {"loss": loss, "data_seconds": seconds}})
        return tmp_path / name

    one = made("one", b"w", 1.0, 0.5)
    assert differences(one, made("same", b"w", 2.0, 0.5)) == []
    assert differences(one, made("weights", b"v", 1.0, 0.5)) == ["one-key/weights.safetensors"]
    assert differences(one, made("loss", b"w", 1.0, 0.6)) == ["one-key", "one-key/metrics.jsonl"]
