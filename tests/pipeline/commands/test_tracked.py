"""Every command that learns is tracked while it learns: rows are there before its stage is finished."""

from __future__ import annotations

import json
import shlex
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from envs.embodiment import Embodiment
from envs.manifest import write_manifest
from pipeline.chaos import life
from pipeline.chaos.processes import nothing_left
from pipeline.commands.submit import entrypoint
from pipeline.config import load_config
from pipeline.loop import build_loop
from tests.embodiments import ARM_DELTAS
from tests.sampling import those

# Stages that never end by themselves: there is no race between what they log and their end.
ENDLESS = ("imitation.perception.steps=900000", "finetune.simulator.fit.steps=900000")
COMMANDS = {
    "run": ["run"],
    "rl": ["rl"],
    "stage": ["stage", "imitation"],
    "controls": ["controls"],
    "finetune": ["finetune"],
    # what the head node of a cluster is asked to run; here it starts a Ray of its own if it comes to that
    "submit": shlex.split(entrypoint(["rl", "launch=ray", "launch.address=local"]))[3:],
}


def words_of(name: str, folder: Path, data: Path) -> list[str]:
    """A command with options by which its first stage that learns never ends."""
    if name == "finetune":
        task = [
            "simulator=unet_small",
            "task=lerobot",
            "threads=1",
            "task.size=[32,32]",
            "task.chunk=4",
            "task.horizon=8",
        ]
        task += [f"task.data=[{data}]", f"finetune.data=[{data}]"]
    else:
        task = ["experiment=soak"]
    return [*COMMANDS[name], *task, *ENDLESS, f"runs={folder}", "name=it", "track=offline"]


def finished_in_name_only(words: list[str], root: Path) -> None:
    """Let a run look finished, so that the controls beside it begin: they do what it lacks themselves."""
    loop = build_loop(load_config(words), root)
    loop.folder("report").mkdir(parents=True)
    write_manifest(loop.folder("report"), {"stage": "report", "result": {}})


SAMPLED = ("finetune",)  # the others learn in stages of the same graph


@pytest.mark.parametrize("name", those(SAMPLED, COMMANDS))
def test_rows_come_while_a_stage_learns(
    name: str, tmp_path: Path, tiny_data: Callable[[Embodiment], Path]
) -> None:
    words, log = words_of(name, tmp_path, tiny_data(ARM_DELTAS)), tmp_path / "log"
    root = tmp_path / "it/finetune" if name == "finetune" else tmp_path / "it"
    if name == "controls":
        finished_in_name_only(words[1:], root)
    mark = f"tracked-{name}"
    process = life.begin(words, mark, log, cores=1)
    assert process.pid is not None
    stage, tracked = (
        ("simulator", "simulator") if name == "finetune" else ("imitation", "imitation-perception")
    )
    try:
        rows: dict[str, Any] = {}
        deadline = time.monotonic() + 180
        while tracked not in rows and time.monotonic() < deadline:
            assert process.exitcode is None, log.read_text()
            time.sleep(0.2)
            state = root / "wandb.json"
            rows = json.loads(state.read_text())["rows"] if state.exists() else {}
        assert tracked in rows, log.read_text()
        stages = root if name == "finetune" else root / "stages"
        (folder,) = stages.glob(f"{stage}-*")
        assert not (folder / "manifest.json").exists()
        life.send(process, signal.SIGTERM)
        process.join(60)
        assert process.exitcode == 143, log.read_text()
        sent = b"".join(path.read_bytes() for path in root.rglob("run-*.wandb"))
        assert f"{tracked}/loss".encode() in sent
        nothing_left(mark, process.pid, AssertionError)
    finally:
        life.kill(process)
