"""What `worldloop play` opens of a config."""

from __future__ import annotations

from pathlib import Path

import pytest

from actors.factory import build_pool
from envs.episodes import Episode, LeRobotWriter
from envs.manifest import write_manifest
from envs.physics.suite import build_suite
from envs.targets import ConfigError
from pipeline.commands.play import build_game, learned_world
from pipeline.config import load_config
from pipeline.loop import build_loop


def test_of_several_rounds_the_newest_finished_world_is_opened(tmp_path: Path) -> None:
    cfg = load_config(["experiment=soak", "rounds.count=3"])
    graph = build_loop(cfg, tmp_path)

    def finish(*stages: str) -> None:
        for stage in stages:
            folder = graph.folder(stage)
            folder.mkdir(parents=True)
            (folder / "weights.safetensors").touch()
            write_manifest(folder, {"stage": stage, "key": folder.name.rpartition("-")[2], "result": {}})

    assert learned_world(cfg, tmp_path) == {}
    finish("simulator-1", "state-1", "judge-1", "simulator-2", "judge-2")
    world = learned_world(cfg, tmp_path)
    assert world == {
        part: graph.folder(f"{part}-1") / "weights.safetensors" for part in ("simulator", "state", "judge")
    }
    finish("state-2")
    assert learned_world(cfg, tmp_path)["judge"] == graph.folder("judge-2") / "weights.safetensors"


COUNTING = {"_target_": "tests.suites.counting.Counting", "fault": ""}


def test_recordings_are_played_in_the_tasks_that_their_run_played(tmp_path: Path) -> None:
    cfg = load_config(["experiment=soak", "launch.workers=1"])
    known = ["count", "recount", "uncount"]  # the suite has one more than the run plays, and first
    cfg["task"] |= {"suite": {**COUNTING, "tasks": known}, "name": ["uncount", "recount"]}
    cfg["task"] |= {"size": [4, 4], "horizon": 4, "mode": "absolute"}
    pool, robot = build_pool(cfg), build_suite(cfg["task"]["suite"]).embodiment
    tracks = pool.script([(seed, 0.0) for seed in range(4)], cfg["task"]["chunk"])
    pool.close()
    LeRobotWriter(tmp_path / "set", robot).write([Episode.from_track(one, "expert", robot) for one in tracks])
    game = build_game(cfg, {}, tmp_path / "set")
    assert set(game.tasks) == set(known)
    for number, track in enumerate(tracks):
        game.hand_over("recorded", number)
        assert (game.seed, game.instruction) == (track.seed, track.instruction)
        assert track.instruction in game.recorded[number].title
    # the config has come to name another task since
    later = build_game({**cfg, "task": {**cfg["task"], "name": "count"}}, {}, tmp_path / "set")
    assert [one.task for one in later.recorded] == [track.instruction for track in tracks]
    fewer = {**cfg["task"], "suite": {**COUNTING, "tasks": ["count"]}, "name": "count"}
    with pytest.raises(
        ConfigError, match=r"episode of seed 0 was told 'uncount', which this suite says of none"
    ):
        build_game({**cfg, "task": fewer}, {}, tmp_path / "set")
