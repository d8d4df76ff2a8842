"""What stages are given of the data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from envs.episodes import Episode, LeRobotWriter
from envs.episodes.clips import ClipStore
from pipeline.stages.given import successful_episodes
from tests.conftest import BENCH


def test_what_worked_is_the_newest_policys_and_demonstrations_where_that_is_little(
    episodes: list[Episode], tmp_path: Path
) -> None:
    names = ["expert", "expert", "policy-1", "policy-1", "policy-2", "policy-2", "policy-2", "noisy"]
    won = [True, True, True, True, True, True, False, True]
    seeds = [1, 2, 3, 4, 5, 6, 7, 9]  # those of policies divisible by 8 are kept for measuring
    told = [
        replace(episode, behaviour=name, seed=seed, success=np.full_like(episode.success, ok))
        for episode, name, seed, ok in zip(episodes, names, seeds, won, strict=True)
    ]
    LeRobotWriter(tmp_path / "dataset", BENCH.views, BENCH.size, 10.0).write(told)
    known = ClipStore([tmp_path / "dataset"])
    assert successful_episodes({"imitation": {"demos": 2}}, known, 2).tolist() == [4, 5]
    assert successful_episodes({"imitation": {"demos": 3}}, known, 2).tolist() == [4, 5]
    assert successful_episodes({"imitation": {"demos": 3}}, known, 3).tolist() == [0, 1]
