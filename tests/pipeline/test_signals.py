"""Ctrl-C on every command that lasts: it ends soon, without a traceback, and nothing it began lives on."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.chaos import life
from pipeline.chaos.processes import nothing_left

SOAK = ["experiment=soak", "track=disabled"]


def wait_for(pattern: str, log: Path, alive: life.BaseProcess) -> None:
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        said = log.read_text(errors="replace") if log.exists() else ""
        if re.search(pattern, said):
            return
        assert alive.exitcode is None, said
        time.sleep(0.1)
    raise AssertionError(f"no {pattern!r} in {said}")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run that has a data set, a policy and a small world."""
    folder = tmp_path_factory.mktemp("runs")
    words = ["stage", "state-1", *SOAK, f"runs={folder}", "name=known"]
    process = life.begin(words, "known", folder / "known.log", folder)
    process.join(300)
    assert process.exitcode == 0, (folder / "known.log").read_text()
    yield folder / "known"


ENDLESS = ["imitation.perception.steps=90000", "finetune.simulator.fit.steps=90000"]
COMMANDS = {
    "run": (["run", *SOAK, "name=new", "collect.episodes.train=5000"], r"collect: +\d"),
    "stage": (["stage", "imitation", *SOAK, "name=new", *ENDLESS], r"perception: +\d+%.*loss|action_error"),
    "evaluate": (
        ["evaluate", "policy=imitation", *SOAK, "name=known", "evaluate.episodes=4000"],
        r"physics: +\d",
    ),
    "finetune": (
        ["finetune", "simulator=unet_small", "task=lerobot", "name=new", "track=disabled", *ENDLESS],
        r"simulator: +\d+%.*loss",
    ),
    "serve": (["serve", *SOAK, "name=known", "serve.port=0"], r"http://127\.0\.0\.1:\d+"),
    "bench": (["bench", "learning", "track=disabled"], r"\w"),
    "chaos": (["chaos", "chaos.events=0", "chaos.seconds=500"], r"0 iterations"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_ends_a_command_and_all_that_it_began(name: str, run: Path) -> None:
    words, pattern = COMMANDS[name]
    words = [*words, f"runs={run.parent}"]
    if name == "finetune":
        data = next(run.glob("stages/collect-*/dataset"))
        words += [f"task.data=[{data}]", f"finetune.data=[{data}]"]
    log = run.parent / f"{name}.log"
    process = life.begin(words, name, log, run.parent)
    assert process.pid is not None
    try:
        wait_for(pattern, log, process)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: everything in the foreground
        process.join(60)
        said = log.read_text(errors="replace")
        assert process.exitcode in ((0, 130) if name == "serve" else (130,)), said
        assert "Traceback" not in said, said
        nothing_left(name, process.pid, AssertionError)
    finally:
        process.kill()
