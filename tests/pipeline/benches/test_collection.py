"""The benchmark of collecting plays the same episodes on one core and on two, of any suite."""

from __future__ import annotations

import os

import pytest

from envs.targets import ConfigError
from pipeline.benches.worlds import collection
from pipeline.config import load_config

TASK = {
    "suite": {"_target_": "examples.task_suite.DotToSquare"},
    "name": "reach",
    "size": [32, 32],
    "chunk": 4,
    "horizon": 8,
}


def test_one_core_is_compared_with_two(capsys: pytest.CaptureFixture[str]) -> None:
    known = os.sched_getaffinity(0)
    if len(known) < 2:
        with pytest.raises(ConfigError, match="one core with two"):
            collection({"task": TASK}, 4)
        return
    seconds = collection({"task": TASK}, 4)
    said = capsys.readouterr().out
    assert seconds.keys() == {1, 2} and os.sched_getaffinity(0) == known
    assert "1 core(s):" in said and "at [32, 32], 4 episodes, 0 dropped" in said
    assert f"{seconds[1] / seconds[2]:.2f}x as fast as one" in said


def test_a_task_without_physics_is_refused() -> None:
    cfg = load_config(["task=lerobot", "task.data=[anywhere]"])
    with pytest.raises(ConfigError, match="bench collection records its own episodes; choose a task with a"):
        collection(cfg)
