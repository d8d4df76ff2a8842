"""What the judge's stage tells of a judge that cannot know what it is asked, or has not learned it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from envs.episodes.formats.lerobot.writer import LeRobotWriter
from envs.episodes.splits import write_splits
from pipeline.config import load_config
from pipeline.graph.stage import Inputs
from pipeline.stages.given import DATASETS
from pipeline.stages.judging import stage as judging
from tests.embodiments import ARM_DELTAS
from tests.moving_square import SIZE, episodes_of, moving_square


@pytest.mark.parametrize(("judge", "blind"), [("proxy", True), ("learned", False)])
def test_a_judge_that_is_blind_to_several_instructions_is_an_alarm(
    judge: str, blind: bool, tmp_path: Path
) -> None:
    data, settings = tmp_path / "data", {"phase": "first"}
    some = episodes_of(ARM_DELTAS)
    other = [replace(episode, instruction="pull the other") for episode in some[10:]]
    LeRobotWriter(data, ARM_DELTAS.at(SIZE)).write([*some[:10], *other])
    words = (f"judge={judge}", "task=lerobot", f"task.data=[{data}]", "task.size=[32,32]")
    cfg = load_config(["experiment=smoke", *words, "task.chunk=4", "task.horizon=8", "launch.device=cpu"])
    (tmp_path / DATASETS).write_text(json.dumps([str(data)]))
    view = judging.judge.view("judge-1", cfg, settings)
    made = judging.judge.run(view, tmp_path, Inputs({"data": tmp_path}, settings))
    said = "ProxyJudge reads no instruction, and recordings hold 2 different ones"
    assert (said in made.get("alarm", "")) == blind


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.long
def test_a_judge_that_cannot_tell_success_on_recorded_video_is_an_alarm(told: bool, tmp_path: Path) -> None:
    """Once success is what its pictures show, and once it is what a coin says."""
    data, settings = tmp_path / "data", {"phase": "first"}
    some = [
        moving_square(ARM_DELTAS, seed, "expert" if told and seed % 4 < 2 else "random") for seed in range(24)
    ]
    coin = [np.full(len(episode), seed % 4 < 2) for seed, episode in enumerate(some)]
    if not told:
        some = [replace(episode, success=said) for episode, said in zip(some, coin, strict=True)]
    LeRobotWriter(data, ARM_DELTAS.at(SIZE)).write(some)
    write_splits(data, {"train": 8, "calibration": 16})
    words = ("judge=learned", "task=lerobot", f"task.data=[{data}]", "task.size=[32,32]", "launch.device=cpu")
    fit = ("judge_fit.first.imagined=0", "judge_fit.first.fit.steps=120")
    cfg = load_config(["experiment=smoke", *words, *fit, "task.chunk=4", "task.horizon=8"])
    (tmp_path / DATASETS).write_text(json.dumps([str(data)]))
    view = judging.judge.view("judge-1", cfg, settings)
    made = judging.judge.run(view, tmp_path, Inputs({"data": tmp_path}, settings))
    assert made["calibration_successes"] == made["calibration_failures"] == 8
    assert (made["auc"] >= 0.8) == told, made["auc"]
    assert ("hardly tells success from failure" in made.get("alarm", "")) == (not told)


@pytest.mark.parametrize(("success", "missing"), [(True, "failed"), (False, "succeeded")])
def test_calibration_on_one_outcome_asks_for_the_other(
    success: bool, missing: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, settings = tmp_path / "data", {"phase": "first"}
    some = [moving_square(ARM_DELTAS, seed) for seed in range(8)]
    said = [replace(one, success=np.full(len(one), success or seed < 2)) for seed, one in enumerate(some)]
    LeRobotWriter(data, ARM_DELTAS.at(SIZE)).write(said)
    write_splits(data, {"train": 4, "calibration": 4})
    words = ("judge=learned", "task=lerobot", f"task.data=[{data}]", "task.size=[32,32]", "launch.device=cpu")
    fit = ("judge_fit.first.imagined=0", "judge_fit.first.fit.steps=2")
    cfg = load_config(["experiment=smoke", *words, *fit, "task.chunk=4", "task.horizon=8"])
    (tmp_path / DATASETS).write_text(json.dumps([str(data)]))
    judging.judge.run(
        judging.judge.view("judge-1", cfg, settings), tmp_path, Inputs({"data": tmp_path}, settings)
    )
    (told,) = [line for line in capsys.readouterr().out.splitlines() if "calibration episodes" in line]
    assert f"{4 * success} of 4 calibration episodes succeeded, and one that {missing} is needed" in told
    assert "do not tell which" not in told
