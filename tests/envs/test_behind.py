"""Shards written while others are made."""

from __future__ import annotations

from pathlib import Path

import pytest

from envs.episodes.formats.lerobot import LeRobotDataset, LeRobotWriter
from envs.episodes.write_behind import WriteBehind


def test_shards_come_in_order_and_are_there_at_the_end(dataset: Path, tmp_path: Path) -> None:
    data = LeRobotDataset(dataset)
    episodes = list(data)[:4]
    with WriteBehind(LeRobotWriter(tmp_path, data.views, data.size, data.fps)) as behind:
        behind.write(episodes[:2])
        behind.write(episodes[2:])
    assert [episode.seed for episode in LeRobotDataset(tmp_path)] == [episode.seed for episode in episodes]


def test_what_fails_in_writing_is_raised_and_nothing_finished_is_lost(dataset: Path, tmp_path: Path) -> None:
    data = LeRobotDataset(dataset)
    episodes = list(data)[:2]
    with (
        pytest.raises(AttributeError),
        WriteBehind(LeRobotWriter(tmp_path, data.views, data.size, data.fps)) as behind,
    ):
        behind.write(episodes)
        behind.write([None])  # type: ignore[list-item]
    assert len(LeRobotDataset(tmp_path)) == 2
