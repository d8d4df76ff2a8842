"""Signals: what learns writes its checkpoint before it leaves, and goes on as if nothing had been."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from learners.training.checkpoint import Checkpoints
from learners.training.fit import FitConfig, fit
from learners.training.interrupt import clean_ending, deferred_signals

ENDS = [(signal.SIGTERM, SystemExit), (signal.SIGINT, KeyboardInterrupt)]


@pytest.fixture(autouse=True)
def interruptible() -> Iterator[None]:
    """SIGINT as in a shell's foreground; what a shell starts in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("number", "end"), ENDS)
def test_the_first_signal_waits_and_the_second_does_not(
    number: signal.Signals, end: type[BaseException]
) -> None:
    with clean_ending(), pytest.raises(end), deferred_signals() as asked:
        assert not asked()
        os.kill(os.getpid(), number)
        assert asked() == number
        os.kill(os.getpid(), number)
        time.sleep(1)
        raise AssertionError("the second signal was swallowed")


@pytest.mark.parametrize(("number", "end"), ENDS)
def test_a_signal_that_a_library_turned_into_its_own_error_ends_the_command(
    number: signal.Signals, end: type[BaseException]
) -> None:
    with pytest.raises(end), clean_ending():
        try:
            os.kill(os.getpid(), number)
            time.sleep(1)
        except (KeyboardInterrupt, SystemExit) as interrupted:
            raise ValueError("argument 1: " + repr(interrupted)) from None
    with pytest.raises(ValueError, match="its own"), clean_ending():
        raise ValueError("its own")


@pytest.mark.parametrize(("number", "end"), ENDS)
def test_a_signal_that_a_library_turned_into_another_end_has_the_status_that_shells_expect(
    number: signal.Signals, end: type[BaseException]
) -> None:
    with pytest.raises(end) as ended, clean_ending():
        try:
            os.kill(os.getpid(), number)
            time.sleep(1)
        except (KeyboardInterrupt, SystemExit):
            sys.exit(1)  # as Ray does while a driver waits
    assert getattr(ended.value, "code", 143) == 143
    with pytest.raises(SystemExit, match="2"), clean_ending():
        sys.exit(2)


@pytest.mark.parametrize(("number", "end"), ENDS)
def test_a_signal_after_the_last_question_is_answered_too(
    number: signal.Signals, end: type[BaseException]
) -> None:
    with clean_ending(), pytest.raises(end):
        with deferred_signals() as asked:
            assert not asked()
            os.kill(os.getpid(), number)
        raise AssertionError("the signal was swallowed")


@pytest.mark.parametrize("at", [3, 7])  # in the middle, between checkpoints, and in the last step
@pytest.mark.parametrize(("number", "end"), ENDS)
def test_an_interrupted_fit_goes_on_to_the_same_metrics_weights_and_result(
    number: signal.Signals, end: type[BaseException], at: int, tmp_path: Path
) -> None:
    def run(folder: Path, disturb: Callable[[int], None]) -> tuple[list[Any], Tensor, float]:
        torch.manual_seed(0)
        module = nn.Linear(3, 1)
        learned: list[Tensor] = []

        def batch(step: int, generator: torch.Generator) -> Tensor:
            return torch.randn(4, 3, generator=generator)

        def loss(data: Tensor, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
            disturb(len(learned))  # batches are made ahead of their steps
            learned.append(data)
            return module(data).square().mean(), {}

        result = fit("x", module, batch, loss, FitConfig(steps=8, batch=4, lr=1e-3, bf16=False), folder)
        rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
        return rows, module.weight.detach().clone(), result["loss"]

    def interrupt(step: int) -> None:
        if step == at:
            os.kill(os.getpid(), number)

    whole = run(tmp_path / "whole", lambda step: None)
    with clean_ending(), pytest.raises(end):
        run(tmp_path / "cut", interrupt)
    assert Checkpoints(tmp_path / "cut").facts()["step"] == at + 1  # type: ignore[index]
    rows, weight, loss = run(tmp_path / "cut", lambda step: None)
    assert rows == whole[0] and torch.equal(weight, whole[1]) and loss == whole[2]


@pytest.mark.long
def test_a_command_ends_soon_and_leaves_a_checkpoint(tmp_path: Path) -> None:  # Ctrl-C: test_signals.py
    words = ["stage", "imitation", "experiment=soak", f"runs={tmp_path}", "track=disabled"]
    words += ["imitation.perception.steps=5000"]
    command = subprocess.Popen(
        [sys.executable, "-m", "pipeline", *words],
        cwd=Path(__file__).resolve().parents[3],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and command.poll() is None:
        if any(log.stat().st_size for log in tmp_path.rglob("metrics.jsonl")):
            break
        time.sleep(0.1)
    command.send_signal(signal.SIGTERM)
    said = command.communicate(timeout=30)[0]
    assert command.returncode == 143, said
    assert "Traceback" not in said and "goes on from" in said
    assert list(tmp_path.rglob("checkpoint-*/facts.json"))
    assert not list(tmp_path.rglob(".owner.json"))
