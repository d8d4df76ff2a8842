"""The benches of students and of strides, at sizes that say nothing but that they run, and go on."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from envs.targets import ConfigError
from pipeline.benches import distil as students
from pipeline.benches.distil import distil, reached
from pipeline.benches.strides import strides
from pipeline.config import load_config

TINY = (
    *("experiment=soak", "task.horizon=8", "policy.width=64", "track=disabled", "threads=1"),
    *("task.suite.cameras=[head]", "launch.workers=1", "collect.episodes.held_out=1", "name=bench"),
)
STUDENTS = (
    *("simulator=dit_small", "distill.steps=2", "tokenizer_fit={steps: 2, batch: 4}"),
    *("distill.first.fit={steps: 3, batch: 2}", "distill.method.critic_updates=1"),
    "state_fit.first.fit={steps: 2, batch: 4}",
)


def test_students_and_teacher_stand_in_one_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(students, "TEACHER", (2,))
    monkeypatch.setattr(students, "STUDENT", (2, 1))
    cfg = load_config([*TINY, *STUDENTS, f"runs={tmp_path}"])
    found = distil(cfg)
    titles = ["teacher, 2", "DMD2, 2", "DMD2, 1", "TrajectoryRegression, 2", "TrajectoryRegression, 1"]
    assert list(found) == titles
    assert all(math.isfinite(value) for row in found.values() for value in row.values())
    assert json.loads((tmp_path / "bench/distil.json").read_text()) == found
    said = capsys.readouterr().out
    assert said.count("\n| ") == 2 + len(titles)
    for row in found.values():
        assert sum(row[f"judge_{name}"] for name in ("tp", "fp", "fn", "tn")) > 0
    assert said.count("TrajectoryRegression, 1: m") == 1 and "teacher, 2: m" not in said
    assert distil(cfg) == found and "is finished, reused" in capsys.readouterr().out


def test_a_student_meets_all_that_it_should_or_it_is_said_what_it_missed() -> None:
    teacher = {"evaluations": 0, "speed_1": 10.0, "speed_32": 20.0, "rollout_psnr": 25.0, "judge_gap": -4.0}
    good = {"evaluations": 4, "speed_1": 41.0, "speed_32": 80.0, "rollout_psnr": 24.5, "judge_gap": 4.0}
    bad = {"evaluations": 8, "speed_1": 41.0, "speed_32": 79.0, "rollout_psnr": 24.4, "judge_gap": 4.1}
    met, missed = reached({"teacher, 15": teacher, "DMD2, 4": good, "DMD2, 8": bad})
    assert met.startswith("DMD2, 4: met (4.1 and 4.0 times the frames/s of teacher, 15 at 1 and 32, 0.50 dB")
    assert missed.startswith("DMD2, 8: missed by 8 evaluations, frames/s, PSNR, gap to truth (")


def test_strides_reach_as_many_times_further(tmp_path: Path) -> None:
    words = [*TINY, "simulator_fit.first.strides=[1,2]", f"runs={tmp_path}"]
    found = strides(load_config(words))
    assert list(found) == [1, 2] and found[2]["covers"] == 2 * found[1]["covers"]
    assert all(math.isfinite(value) for row in found.values() for value in row.values())


def test_benches_say_what_they_cannot_do() -> None:
    with pytest.raises(ConfigError, match=r"distill\.steps=0 is without a student"):
        distil(load_config([*TINY, "simulator=dit_small"]))
