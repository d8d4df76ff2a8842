"""Gripper ranges that names alone say, against what was recorded."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from actors.playing.controls import Controls
from actors.world_config import embodiment_of
from envs.embodiment import Arm, Embodiment
from tests.envs.episodes.lerobot.sets import SETS, write_set


def recorded(folder: Path, kind: str, low: float, high: float) -> Path:
    """One of LeRobot's sets, whose last number, a gripper, goes from `low` to `high`."""
    write_set(folder, SETS[kind])
    for path in (folder / "data").rglob("*.parquet"):
        table = pq.read_table(path)
        action = np.stack(table["action"].to_numpy())
        action[:, -1] = np.linspace(low, high, len(action))
        place = table.column_names.index("action")
        column = pa.array(action.tolist(), table.schema.field("action").type)
        pq.write_table(table.set_column(place, "action", column), path)
    return folder


def robot_of(*folders: Path) -> Embodiment:
    return embodiment_of({"task": {"suite": None, "data": [str(folder) for folder in folders]}})


@pytest.mark.parametrize(
    ("kind", "low", "high", "wanted"),
    [
        ("so101", 2.0, 97.0, (100.0, 0.0)),  # the drivers' own
        ("so101", -4.0, 104.0, (100.0, 0.0)),  # calibrated a little off
        ("so101", 0.0, 1.0, (1.0, 0.0)),
        ("so101", -400.0, 400.0, (400.0, -400.0)),
        ("so101", 50.0, 50.0, (100.0, 0.0)),  # never used
        ("single_arm", 0.0, 1.0, (0.0, 1.0)),
        ("single_arm", 0.0, 100.0, (0.0, 100.0)),
        ("single_arm", 0.0, 0.0625, (0.0, 0.0625)),  # metres
    ],
)
def test_a_guessed_range_is_held_against_what_was_recorded(
    kind: str, low: float, high: float, wanted: tuple[float, float], tmp_path: Path
) -> None:
    (arm,) = robot_of(recorded(tmp_path, kind, low, high)).arms
    assert arm.gripper_range == wanted


def test_another_range_is_told_once_and_is_that_of_all_sets(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sets = [recorded(tmp_path / name, "so101", 0.0, high) for name, high in (("a", 0.5), ("b", 1.0))]
    for _ in range(2):
        robot = robot_of(*sets)
    assert robot.arms[0].gripper_range == (1.0, 0.0)
    (told,) = [record.message for record in caplog.records]
    assert "gripper.pos goes from 0 to 1" in told and "Say gripper_range in" in told
    (channel,) = [channel for channel in Controls(robot).channels if channel.name == "gripper.pos"]
    assert channel.limits == (0.0, 1.0) and channel.rate == -2.0


def test_what_a_set_says_of_itself_counts(tmp_path: Path) -> None:
    folder = recorded(tmp_path, "so101", 0.0, 1.0)
    (folder / "meta/stats.json").write_text(json.dumps({"action": {"min": [-1.0] * 6, "max": [5.0] * 6}}))
    assert robot_of(folder).arms[0].gripper_range == (5.0, -1.0)  # LeRobot's statistics, where there are any
    info = json.loads((folder / "meta/info.json").read_text())
    arm = {"name": "arm", "numbers": [0, 1, 2, 3, 4], "gripper": 5, "gripper_range": [90, 10]}
    info["features"]["action"]["info"] = {"worldloop": {"arms": [arm]}}
    (folder / "meta/info.json").write_text(json.dumps(info))
    assert robot_of(folder).arms == (Arm("arm", (0, 1, 2, 3, 4), 5, (90, 10)),)


def test_rows_that_lie_behind_a_link_are_looked_at(tmp_path: Path) -> None:
    folder, store = recorded(tmp_path / "set", "so101", 0.0, 1.0), tmp_path / "store"
    (folder / "data").rename(store)
    (folder / "data").mkdir()
    for part in store.iterdir():
        (folder / "data" / part.name).symlink_to(part)
    assert robot_of(folder).arms[0].gripper_range == (1.0, 0.0)


def test_rows_that_cannot_be_read_leave_the_guess(tmp_path: Path) -> None:
    folder = recorded(tmp_path, "so101", 0.0, 1.0)
    for path in (folder / "data").rglob("*.parquet"):
        path.write_bytes(path.read_bytes()[:100])
    assert robot_of(folder).arms[0].gripper_range == (100.0, 0.0)
