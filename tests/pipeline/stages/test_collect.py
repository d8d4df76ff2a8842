"""What is said of scripted experts that fail while data are collected, and how many suites play at once."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import ClassVar

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from actors.factory import build_physics, build_pool
from envs.physics.suite import SuiteError
from envs.specs import CHUNK, STATE
from envs.targets import ConfigError
from pipeline.config import load_config
from pipeline.loop import build_loop
from pipeline.stages.collect import run_recorded
from tests.suites.counting import Counting


def test_an_expert_that_fails_is_an_alarm_with_videos(tmp_path: Path) -> None:
    cfg = load_config(["experiment=soak", "track=disabled", "task.horizon=4"])  # too short for anybody
    graph = build_loop(cfg, tmp_path)
    made = graph.run("collect")["collect"]["result"]
    assert made["expert_failures"] and f"push {len(made['expert_failures'])} of " in made["alarm"]
    films = list((graph.folder("collect") / "media").glob("expert-push-*.mp4"))
    assert 1 <= len(films) <= 3 and all(film.stat().st_size for film in films)


class Alone(Counting):
    """Counts; of all that are made in a process one may be played."""

    played: ClassVar[set[int]] = set()

    def reset(self, task: str, seed: int) -> None:
        super().reset(task, seed)
        self.played.add(id(self))
        if len(self.played) > 1:
            raise SuiteError("somebody else has the robot")


class Still(TensorDictModuleBase):
    """A policy that asks for nothing."""

    in_keys, out_keys = [STATE], [CHUNK]

    def __init__(self, chunk: int):
        super().__init__()
        self.chunk = chunk

    def forward(self, seen: TensorDict) -> TensorDict:
        return seen.set(CHUNK, torch.zeros(len(seen), self.chunk, 1))


@pytest.mark.long
def test_a_suite_that_is_there_once_is_played_by_one_object() -> None:
    cfg = load_config(["experiment=soak", "launch.workers=2", "task.horizon=4", "task.chunk=4"])
    cfg["task"] |= {"suite": {"_target_": f"{__name__}.Alone", "fault": ""}, "envs": 1}
    cfg["task"] |= {"name": "count", "size": [4, 4], "mode": "absolute"}
    with closing(build_pool(cfg)) as pool:
        assert len(pool.processes()) == 1 and len(pool.script([(seed, 0.0) for seed in range(3)], 1)) == 3
    made = list(run_recorded(cfg, Still(4), [5, 6, 7]))
    assert [[track.seed for track in tracks] for tracks in made] == [[5], [6], [7]]
    with pytest.raises(ConfigError, match=r"task\.envs=1 .* asks for 2, which is rl\.envs / rl\.shards"):
        build_physics(cfg, 2)
    with pytest.raises(ConfigError, match=r"task\.envs"):
        load_config(["experiment=soak", "+task.envs=0"])
