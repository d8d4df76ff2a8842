"""Stages that gather episodes in physics: scripted ones, and those of the current policy."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from actors.factory import ConfigError, bench_config, build_physics, build_policy, open_clips
from actors.rollouts.evaluate import evaluate
from envs.episodes import Episode, LeRobotDataset, LeRobotWriter
from envs.episodes.write_behind import WriteBehind
from envs.physics.pool import BenchPool, Track
from pipeline.evaluation.statistics import rate_entry
from pipeline.stages.given import DEPLOY, HELD_OUT, TRAIN, Cfg, Found, seeds_of


def collect(cfg: Cfg, folder: Path, found: Found, part: str) -> dict[str, Any]:
    """Scripted episodes into a LeRobot data set; goes on after the last finished shard."""
    section, task, bench = cfg["collect"], cfg["task"], bench_config(cfg)
    total = section["episodes"] if part == "train" else section["held_out"]
    seeds = seeds_of(cfg, TRAIN if part == "train" else HELD_OUT, total)
    names = [name for name, share in section["mix"].items() for _ in range(round(100 * share))]
    if len(names) != 100:
        raise ConfigError(f"collect.mix={section['mix']} must add up to 1")
    # Consecutive episodes mix all behaviours, so that any prefix of the data has the right proportions.
    order = torch.randperm(100, generator=torch.Generator().manual_seed(0)).tolist()
    jobs = []
    for number, seed in enumerate(seeds):
        behaviour = names[order[number % 100]]
        low, high = section["noise"]
        noise_level = {"expert": 0.0, "random": 1.0}.get(
            behaviour, low + (high - low) * ((number * 0.618) % 1.0)
        )
        jobs.append((seed, noise_level, behaviour))
    writer = LeRobotWriter(folder / "dataset", bench.views, bench.size, task["control_hz"])
    size = section["shard"]
    pool = BenchPool(bench, 2 * (torch.get_num_threads()), task["horizon"], cfg["launch"]["workers"])
    done = len(LeRobotDataset(writer.root)) if writer.shards else 0
    try:
        with (
            tqdm(total=total, initial=done, desc=f"collect {part}", unit="ep", dynamic_ncols=True) as bar,
            WriteBehind(writer) as behind,
        ):
            for begin in range(done, total, size):
                batch = jobs[begin : begin + size]
                tracks = pool.script([(seed, noise_level) for seed, noise_level, _ in batch], task["chunk"])
                behind.write(
                    [
                        Episode.from_track(t, b, bench.views, task["control_hz"])
                        for t, (_, _, b) in zip(tracks, batch, strict=True)
                    ]
                )
                bar.update(len(batch))
    finally:
        pool.close()
    store = open_clips(cfg, [writer.root])
    return {
        "episodes": len(store),
        "frames": int(store.length.sum()),
        "successes": sum(row["success"] for row in store.episodes),
    }


def deploy(cfg: Cfg, folder: Path, found: Found, number: int, episodes: int) -> dict[str, Any]:
    """Episodes of the current stochastic policy in physics, recorded whole."""
    (policy_folder,) = found.values()
    policy = build_policy(cfg, policy_folder / "weights.safetensors")
    seeds = seeds_of(cfg, DEPLOY, episodes, offset=100_000 * number)
    data = folder / "dataset"
    shutil.rmtree(data, ignore_errors=True)  # a deployment is short; half of one is begun anew
    bench, won = bench_config(cfg), []
    with WriteBehind(LeRobotWriter(data, bench.views, bench.size, cfg["task"]["control_hz"])) as behind:
        for tracks in run_recorded(cfg, policy, seeds):
            behind.write(
                [
                    Episode.from_track(track, f"policy-{number}", bench.views, cfg["task"]["control_hz"])
                    for track in tracks
                ]
            )
            won += [bool(track.rows["success"][-1]) for track in tracks]
    success = torch.tensor(won)
    return {
        "episodes": len(success),
        "true_stochastic": rate_entry(success),
        "success": float(success.float().mean()),
    }


def run_recorded(cfg: Cfg, policy: Any, seeds: list[int], stochastic: bool = True) -> Iterator[list[Track]]:
    """Recorded episodes of a policy in physics, in the order of the seeds, as many at once as run side by
    side.
    """
    env = build_physics(cfg, batch=min(64, len(seeds)), record=True)
    try:
        for begin in range(0, len(seeds), env.batch_size[0]):
            part = seeds[begin : begin + env.batch_size[0]]
            evaluate(
                env,
                policy,
                part,
                stochastic=stochastic,
                label="deploy",
                sampling_seed=cfg["seed"] * 1000 + begin,
            )
            tracks = {track.seed: track for track in env.pop_tracks()}
            yield [tracks[seed] for seed in part]
    finally:
        env.close()
