"""What `worldloop controls` says beside its rows."""

from __future__ import annotations

from pathlib import Path

import pytest

from envs.targets import ConfigError
from pipeline.commands.controls import control_rows, table_text
from pipeline.config import load_config
from pipeline.loop import build_loop
from pipeline.study.methods import privileged_note


@pytest.mark.parametrize(("progress", "told"), [("3.0", "progress and success"), ("0.0", "success")])
def test_rl_in_physics_says_that_its_rewards_are_privileged(progress: str, told: str, tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke", f"judge.rewards.progress={progress}"])
    rows = {row.title: row.note for row in control_rows(cfg, tmp_path, build_loop(cfg, tmp_path))}
    noted = {title: note for title, note in rows.items() if note}
    assert set(noted) == {title for title in rows if title.startswith("RL in physics")} and len(noted) == 2
    assert all(f"suite's true {told}, which are privileged" in note for note in noted.values())
    assert all("critic is not warmed up" in note and "rl.recorded" in note for note in noted.values())
    assert "critic" not in privileged_note(load_config(["experiment=smoke", "algorithm=grpo"]))


@pytest.mark.parametrize(
    ("word", "why"),
    [
        ("algorithm=grpo", "GRPO has no critic"),
        ("algorithm=filtered_bc", "FilteredBC has no critic"),
        ("rl.recorded=0", "rl.recorded=0"),
    ],
)
def test_without_recorded_decisions_imagined_ones_are_not_left_out(
    word: str, why: str, tmp_path: Path
) -> None:
    cfg = load_config(["experiment=smoke", word])
    rows = control_rows(cfg, tmp_path, build_loop(cfg, tmp_path))
    assert "without_imagined" not in [row.name for row in rows] and len(rows) == 5
    assert why in rows[0].note and "rl.anchor" in rows[0].note


def test_rows_are_chosen_by_names_that_exist(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke"])
    names = [row.name for row in control_rows(cfg, tmp_path, build_loop(cfg, tmp_path))]
    assert names[0] == "" and len(set(names)) == len(names) == 6
    load_config(["experiment=smoke", f"controls.only=[{','.join(names[1:])}]"])
    with pytest.raises(ConfigError, match=r"controls\.only.*without_rl"):
        load_config(["experiment=smoke", "controls.only=[no_rl]"])


def test_the_table_shows_notes() -> None:
    row = {"successes": 5, "episodes": 10, "low": 0.2, "high": 0.8, "paired": None}
    loop, physics = table_text({"loop": row, "RL": {**row, "note": "by the suite"}}).splitlines()
    assert physics.endswith("(by the suite)") and "suite" not in loop
