"""The bench of experts counts success by task, and shows the seeds on which an expert fails."""

from __future__ import annotations

from pathlib import Path

import pytest

from envs.episodes.video import read_video
from envs.targets import ConfigError
from pipeline.benches.experts import ExpertFails, experts
from pipeline.config import load_config

SMALL = (
    *("task=tabletop", "task.name=[push,pull]", "task.size=[16,16]", "evaluate.episodes=2"),
    *("task.suite.cameras=[head]", "launch.workers=1"),
)


@pytest.mark.long
def test_success_is_counted_by_task_and_variant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    experts(load_config([*SMALL, f"runs={tmp_path}", "~task.variants.swapped"]))
    said = capsys.readouterr().out
    assert said.count("  push ") == said.count("  pull ") == 7
    assert "expert, out_of_domain" in said and "expert, swapped" not in said and "2/2 = 100.0%" in said
    assert said.count(", 0 dropped") == 14
    assert not list(tmp_path.rglob("*.mp4"))


def test_an_expert_that_fails_is_shown_with_its_seeds(tmp_path: Path) -> None:
    words = [*SMALL, f"runs={tmp_path}", "task.horizon=4", "~task.variants"]
    with pytest.raises(
        ExpertFails, match=r"expert: push: the expert fails in 2 of 2 .*seeds 9000000, 9000002"
    ):
        experts(load_config(words))
    videos = sorted(tmp_path.rglob("*.mp4"))
    assert [video.name for video in videos[-2:]] == ["expert-push-9000000.mp4", "expert-push-9000002.mp4"]
    assert read_video(videos[0]).shape == (5, 3, 192, 192)


@pytest.mark.long
def test_episodes_that_crash_physics_are_said_to_be_dropped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cfg = load_config([*SMALL, f"runs={tmp_path}"])
    suite = {"_target_": "tests.suites.counting.OddSeed", "fault": "", "tasks": ["count", "recount"]}
    cfg["task"] |= {"suite": suite, "name": ["count", "recount"], "size": [4, 4], "horizon": 4}
    cfg["task"]["variants"], cfg["launch"]["workers"] = {}, 2
    with pytest.raises(
        ExpertFails, match=r"expert: count: the expert fails in 1 of 1 .*; .*recount: .* in 2 of 2"
    ):
        experts(cfg)
    said = capsys.readouterr().out
    assert said.count("  count                    0/1 = 0.0% [0.0, 79.3], 1 dropped") == 4
    assert said.count("  recount                  0/2 = 0.0% [0.0, 65.8], 0 dropped") == 4


def test_a_task_without_physics_has_no_experts() -> None:
    cfg = load_config(["task=lerobot", "task.data=[anywhere]"])
    with pytest.raises(
        ConfigError, match="bench experts records its own episodes; choose a task with a suite"
    ):
        experts(cfg)
