"""The bench of launch.compile, where nothing can be compiled in no time: an engine that has no such parts."""

from __future__ import annotations

import pytest

from pipeline.benches.compiled import compiled
from pipeline.config import load_config


@pytest.mark.long
def test_it_compares_training_and_sampling_three_ways(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["experiment=smoke", "task.size=[32,32]", "task.suite.cameras=[head]", "launch.device=cpu"]
    found = compiled(load_config([*words, "simulator_fit.first.fit.batch=2"]))
    assert list(found) == ["a training step of 2", "a chunk of 1", "a chunk of 32"]
    assert all(list(by) == ["plain", "blocks", "graphs"] for by in found.values())
    assert all(seconds > 0 for by in found.values() for seconds in by.values())
    said = capsys.readouterr().out.splitlines()
    assert sum("launch.compile=graphs" in line for line in said) == 3
