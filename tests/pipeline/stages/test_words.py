"""Words decide for a trained policy, too: from the same first frames it does what either instruction asks."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from actors.factory import build_physics, build_policy, build_pool, open_clips
from actors.rollouts.evaluate import evaluate
from actors.world_config import world_spec
from envs.episodes import Episode, LeRobotWriter
from learners.stages.imitation import Cloning, train_imitation
from learners.training.fit import FitConfig
from pipeline.config import load_config
from pipeline.stages.given import mode_of

STARTS = [11, 12, 13, 14]
WORDS = [
    *("task=tabletop", "task.name=push", "task.suite.phrasings=[plain]", "task.suite.cameras=[head]"),
    *(
        "cameras=main",
        "policy.instruction_keypoints=8",
        "policy.command=true",
        "launch.workers=1",
        "threads=1",
    ),
]


@pytest.mark.long
@pytest.mark.slow
def test_a_cloned_policy_does_what_the_words_ask_at_the_same_first_frame(tmp_path: Path) -> None:
    cfg = load_config(WORDS)
    asked = {False: "the one thing", True: "the other"}
    writer = LeRobotWriter(tmp_path / "data", world_spec(cfg).embodiment)
    for swapped in asked:
        pool = build_pool(cfg, {"swapped": swapped})
        try:
            tracks = list(pool.script([(seed, 0.0) for seed in STARTS], cfg["task"]["chunk"]))
        finally:
            pool.close()
        assert all(track.rows["success"][-1] for track in tracks)
        robot = world_spec(cfg).embodiment
        writer.write([Episode.from_track(track, "expert", robot) for track in tracks])
    store = open_clips(cfg, [tmp_path / "data"])
    torch.manual_seed(0)
    policy = build_policy(cfg)
    cloning = Cloning(policy, store, torch.arange(len(store)), mode_of(cfg))
    train_imitation(cloning, FitConfig(500, 48, 2e-3, warmup=30, bf16=False, ema=0.99), tmp_path / "fit")
    done = {}
    for swapped in asked:
        env = build_physics(cfg, len(STARTS), changes={"swapped": swapped})
        try:
            done[asked[swapped]] = int(evaluate(env, policy, STARTS).success.sum())
        finally:
            env.close()
    # Success asks that the other thing stays where it is, so whoever is deaf succeeds in half of them.
    assert sum(done.values()) >= 7, done
