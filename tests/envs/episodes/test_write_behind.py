"""Shards written while others are made."""

from __future__ import annotations

from pathlib import Path

import pytest

from envs.episodes import Episode, LeRobotDataset, LeRobotWriter
from envs.episodes.write_behind import WriteBehind


def test_shards_come_in_order_and_are_there_at_the_end(episodes: list[Episode], tmp_path: Path) -> None:
    with WriteBehind(LeRobotWriter(tmp_path / "set", episodes[0].embodiment)) as behind:
        behind.write(episodes[:2])
        behind.write(episodes[2:4])
    assert [episode.seed for episode in LeRobotDataset(tmp_path / "set")] == [0, 1, 2, 3]


def test_what_fails_in_writing_is_raised_and_nothing_finished_is_lost(
    episodes: list[Episode], tmp_path: Path
) -> None:
    with (
        pytest.raises(AttributeError),
        WriteBehind(LeRobotWriter(tmp_path / "set", episodes[0].embodiment)) as behind,
    ):
        behind.write(episodes[:2])
        behind.write([None])  # type: ignore[list-item]
    assert len(LeRobotDataset(tmp_path / "set")) == 2
