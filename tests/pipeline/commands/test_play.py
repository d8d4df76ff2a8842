"""What `worldloop play` opens of a config."""

from __future__ import annotations

from pathlib import Path

from actors.factory import build_pool
from envs.episodes import Episode, LeRobotWriter
from envs.physics.suite import build_suite
from pipeline.commands.play import build_game
from pipeline.config import load_config

COUNTING = {"_target_": "tests.envs.physics.sections.Counting", "fault": ""}


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
