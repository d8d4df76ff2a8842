"""What the judge's stage tells of a judge that cannot know what it is asked."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from envs.episodes.formats.lerobot_writer import LeRobotWriter
from pipeline.config import load_config
from pipeline.graph.stage import Inputs
from pipeline.stages import world
from pipeline.stages.given import DATASETS
from tests.embodiments import ARM_DELTAS
from tests.moving_square import SIZE, episodes_of


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
    view = world.judge.view("judge-1", cfg, settings)
    made = world.judge.run(view, tmp_path, Inputs({"data": tmp_path}, settings))
    said = "ProxyJudge reads no instruction, and recordings hold 2 different ones"
    assert (said in made.get("alarm", "")) == blind
