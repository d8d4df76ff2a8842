"""The benchmark of learning speed runs, and its groups do not all score alike."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.benches.learning import learn


@pytest.mark.long
def test_a_few_iterations_on_the_toy_task(tmp_path: Path) -> None:
    _, iterations, rate = learn(0, 3, tmp_path, envs=64)
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert iterations == len(rows) and 0 < rate < 1
    assert all(0 < row["learning 0/success"] < 1 and row["learning 0/groups_dropped"] < 1 for row in rows)
