"""SIGINT and SIGTERM on every command that lasts: it ends soon, without a traceback, and nothing it began
lives on.
"""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from pathlib import Path

import pytest

from pipeline.chaos import life
from pipeline.chaos.processes import nothing_left
from pipeline.cli.main import COMMANDS

pytestmark = pytest.mark.slow

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
    """A finished run."""
    folder = tmp_path_factory.mktemp("runs")
    words = ["run", *SOAK, f"runs={folder}", "name=known"]
    process = life.begin(words, "known", folder / "known.log", cores=1)
    process.join(300)
    assert process.exitcode == 0, (folder / "known.log").read_text()
    yield folder / "known"


ENDLESS = ["imitation.perception.steps=90000", "finetune.simulator.fit.steps=90000"]
LASTS = {
    "run": (["run", *SOAK, "name=new", "collect.episodes.train=5000"], r"collect: +\d"),
    "rl": (
        ["rl", *SOAK, "name=new", "seed=1", *ENDLESS],
        r"perception: +\d+%.*loss|action_error",
    ),
    "stage": (["stage", "imitation", *SOAK, "name=new", *ENDLESS], r"perception: +\d+%.*loss|action_error"),
    "evaluate": (
        ["evaluate", "policy=imitation", *SOAK, "name=known", "evaluate.episodes=4000"],
        r"physics: +\d",
    ),
    "trust": (["trust", *SOAK, "name=known", "depth=1", "futures=300"], r"carried out: +\d"),
    "gradients": (["gradients", *SOAK, "name=known", "batches=9000"], r"imagined batches: +\d"),
    "cross-validate": (
        ["cross-validate", *SOAK, "name=known", "folds=2", "rounds.iterations=[90000]"],
        r"folds: +\d",
    ),
    "controls": (["controls", *SOAK, "name=known"], r"physics: +\d"),
    "study": (
        [
            "study",
            *SOAK,
            "name=new",
            "study.rows=[imitation]",
            "study.against=[]",
            "collect.episodes.train=5000",
        ],
        r"collect: +\d",
    ),
    "policy-value": (
        ["policy-value", *SOAK, "name=known", "policy_value.starts=2", "policy_value.repeats=400"],
        r"imagined \w|true \w",
    ),
    "fidelity": (["fidelity", *SOAK, "name=known", "fidelity.long.frames=90000"], r"\d+%"),
    "ewmbench": (["ewmbench", *SOAK, "name=known", "ewmbench.detector.fit.steps=90000"], r"detector: +\d+%"),
    "sweep": (["sweep", *SOAK, "name=known"], r"\w"),
    "rewards": (
        [
            *["rewards", *SOAK, "name=known", "rewards=[learned]", "variants=[]"],
            *["episodes=2", "judge_fit.first.fit.steps=90000"],
        ],
        r"judge: about",
    ),
    "gridworld": (["gridworld", "track=disabled", "collect.episodes.train=5000"], r"collect: +\d"),
    "judge": (["judge", *SOAK, "name=known", "frames=all"], r"\w"),
    "finetune": (
        [
            "finetune",
            "simulator=unet_small",
            "task=lerobot",
            "threads=1",
            "name=new",
            "track=disabled",
            *ENDLESS,
        ],
        r"simulator: +\d+%.*loss",
    ),
    "serve": (["serve", *SOAK, "name=known", "serve.port=0"], r"http://127\.0\.0\.1:\d+"),
    "play": (["play", *SOAK, "name=known", "serve.port=0"], r"http://127\.0\.0\.1:\d+"),
    "bench": (["bench", "learning", "track=disabled"], r"\w"),
    "chaos": (["chaos", "chaos.events=0", "chaos.seconds=500"], r"0 iterations"),
    "chaos soak": (["chaos", "chaos.events=500", "seed=770019"], r"life 1 begins"),
    "inspect": (["inspect"], r"\w"),
    "verify": (["verify"], r"verify: +\d"),
}
SHORT = ("inspect", "verify", "sweep", "judge")  # may have ended before they are asked to, or be about to
SERVERS = ("serve", "play")  # this is how they end
# answer from what is there, or hand over to a cluster
AT_ONCE = {"convert", "stages", "summary", "compare", "submit", "tasks", "config", "doctor", "completion"}


# The same code answers both, so one command is asked one way and the next the other; those whose processes
# live longest are asked both ways.
BOTH = ("run", "serve", "chaos")
SAMPLED = ("run", "stage", "bench")  # which need no run that has ended
CASES = [
    pytest.param(name, number, marks=() if name in SAMPLED else pytest.mark.long)
    for place, name in enumerate(LASTS)
    for asked, number in enumerate((signal.SIGINT, signal.SIGTERM))
    if name in BOTH or place % 2 == asked
]


def test_every_command_is_tried() -> None:
    assert {name.split()[0] for name in LASTS} | AT_ONCE == COMMANDS.keys()


@pytest.mark.parametrize(("name", "number"), CASES)
def test_a_signal_ends_a_command_and_all_that_it_began(
    name: str, number: signal.Signals, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    words, pattern = LASTS[name]
    mark, run, data = f"{name}-{number}", tmp_path / "known", tmp_path
    if "name=known" in words or name in ("finetune", *SHORT):  # what asks for a run that has ended
        run = request.getfixturevalue("run")
        data = next(run.glob("stages/collect-*/dataset"))
    if name == "finetune":
        words = [*words, f"task.data=[{data}]", f"finetune.data=[{data}]"]
    if name == "inspect":
        words = [*words, str(data), str(run.parent / mark)]
    elif name == "verify":
        words = [*words, str(run)]
    else:
        words = [*words, f"runs={run.parent}"]
    log = run.parent / f"{mark}.log"
    process = life.begin(words, mark, log, cores=1)
    assert process.pid is not None
    try:
        wait_for(pattern, log, process)
        with suppress(ProcessLookupError) if name in SHORT else nullcontext():
            if number == signal.SIGINT:
                os.killpg(process.pid, number)  # as a terminal does: everything in the foreground
            else:
                os.kill(process.pid, number)
        process.join(60)
        said = log.read_text(errors="replace")
        ends = {128 + number, *((0, -number) if name in SHORT else ()), *((0,) if name in SERVERS else ())}
        assert process.exitcode in ends, said
        assert "Traceback" not in said, said
        nothing_left(mark, process.pid, AssertionError)
        nothing_left("770019-1", process.pid, AssertionError)  # what a soak began
    finally:
        process.kill()
