"""worldloop bench learning: wall time of our GRPO to a goal that TorchRL's own toy recipe takes hours to."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from actors.fleets.fleet import LocalFleet
from actors.policies.vla import ChunkPolicy
from actors.process import prepare_process
from actors.rollouts.evaluate import evaluate
from actors.rollouts.host import Host, Weights
from envs.physics.toy_tracking import ToyTrackingEnv
from envs.rng import seed_process
from envs.targets import options
from learners.rl.algorithm import RLConfig
from learners.rl.grpo import GRPO
from learners.rl.loop import train_rl
from learners.rl.starts import Starts
from learners.rl.watch import Watch
from pipeline.config import load_config

GOAL, EPISODES, SEEDS = 0.6, 100, (0, 1, 2)
# "35-68 s an iteration, 2-3 hours" by its own account and a trial on two cores: two hours is the kinder
# figure.
RECIPE_SECONDS = 7200.0
_GRPO: dict[str, Any] = {
    "group": 8,
    "normalise": True,
    "clip_low": 0.2,
    "clip_high": 0.28,
    "clip_numbers": None,
    "kl": 0.0,
    "entropy": 0.0,
    "shaped": False,
}


def build(seed: int, envs: int) -> tuple[ChunkPolicy, LocalFleet]:
    """A policy of TinyVLA's size and the task of TorchRL's toy recipe: two actions, chunks of four, 64 tokens
    per number, six decisions, two steps within 0.35.
    """
    seed_process(seed)
    env = ToyTrackingEnv(envs, seed=seed)
    head = {"_target_": "actors.policies.chunk_tokens.ChunkTokenHead", "bins": 64}
    policy = ChunkPolicy(
        env.spec,
        head,
        width=128,
        points=8,
        channels=16,
        cameras="all",
        instruction_keypoints=0,
        command=False,
    )
    return policy, LocalFleet(Host(env, policy, bootstrap=False))


def learn(seed: int, limit: int, folder: Path, envs: int = 256) -> tuple[float, int, float]:
    """Seconds, iterations and greedy success when the goal was first reached, or when `limit` iterations were
    over; the evaluations' time counts.
    """
    policy, fleet = build(seed, envs)
    unseen = ToyTrackingEnv(EPISODES, targets=1_000 + seed)
    rate, done = 0.0, 0

    def reached(iteration: int, _: Weights) -> tuple[dict[str, float], bool]:
        nonlocal rate, done
        done = iteration + 1
        rate = evaluate(unseen, policy, list(range(EPISODES)), label=f"greedy {iteration}").rate
        return {"greedy_success": rate}, rate >= GOAL

    began = time.perf_counter()
    own = {
        "envs": envs,
        "shards": 1,
        "epochs": 2,
        "minibatch": 256,
        "lr": 1e-3,
        "kl_stop": 1.0,
        "anchor": 0.0,
    }
    shared = {**load_config([])["rl"], **own, "anchor": 0.0, "checkpoint_every": limit}
    config = options(RLConfig, {**shared, "iterations": limit, "microbatches": 1, "seed": seed}, "rl")
    try:
        train_rl(
            fleet,
            policy,
            GRPO(policy, unseen.spec, **_GRPO),
            config,
            folder,
            Starts(range(4096)),
            name=f"learning {seed}",
            watch=Watch(1, reached),
        )
    finally:
        fleet.close()
    return time.perf_counter() - began, done, rate


def learning(cfg: Mapping[str, Any]) -> None:
    """GRPO on ToyVLAEnv to 60% greedy success over 100 episodes with targets never seen, three seeds."""
    prepare_process(0, 0)
    seconds = []
    for seed in SEEDS:
        with tempfile.TemporaryDirectory() as folder:
            took, iterations, rate = learn(seed, 400, Path(folder))
        reached = rate >= GOAL
        seconds.append(took if reached else float("inf"))
        print(
            f"seed {seed}: {100 * rate:.0f}% of {EPISODES} greedy episodes after {iterations} iterations,"
            f" {took:.1f} s{'' if reached else ': NOT reached'}"
        )
    mean = statistics.fmean(seconds)
    print(
        f"mean {mean:.1f} s to {GOAL:.0%}, {RECIPE_SECONDS / mean:.0f}x sooner than the"
        f" {RECIPE_SECONDS / 3600:.0f} hours that TorchRL's toy recipe (vla_grpo) asks for (goal 10x)"
    )
