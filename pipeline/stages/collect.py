"""Stages that gather episodes: scripted ones and those of the current policy in physics, or recordings."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from actors.factory import build_physics, build_policy, build_pool, open_clips, world_spec
from actors.rollouts.evaluate import evaluate
from envs.episodes.episode import Episode
from envs.episodes.formats.lerobot import LeRobotDataset
from envs.episodes.formats.lerobot_writer import LeRobotWriter
from envs.episodes.write_behind import WriteBehind
from envs.files import write_text
from envs.physics.worker import Track
from envs.targets import ConfigError
from pipeline.code_version import digest
from pipeline.evaluation.statistics import rate_entry
from pipeline.stage import Inputs, stage
from pipeline.stages.given import DATASETS, PHYSICS, ROBOT, Cfg
from pipeline.stages.seeds import Purpose, episode_seeds

_SHARD = 64  # episodes of a deployment side by side, and per file
SPLITS = ("train", "held_out", "calibration")  # in the order in which they are written


@stage(reads=(*ROBOT, "collect"))
def collect(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Scripted episodes into a LeRobot data set, split by split; goes on after the last finished shard."""
    section = cfg["collect"]
    jobs = scripted_jobs(cfg)
    task, robot = cfg["task"], world_spec(cfg).embodiment
    writer = LeRobotWriter(folder / "dataset", robot)
    pool = build_pool(cfg)
    done = len(LeRobotDataset(writer.root)) if writer.shards else 0
    total = sum(section["episodes"].values())
    try:
        with (
            tqdm(total=total, initial=done, desc="collect", unit="ep", dynamic_ncols=True) as bar,
            WriteBehind(writer) as behind,
        ):
            for split, batch in shards(section["episodes"], section["shard"], done):
                mine = [jobs[number] for number in batch]
                tracks = pool.script([(seed, level) for seed, level, _ in mine], task["chunk"])
                behind.write(
                    [
                        Episode.from_track(track, source, robot)
                        for track, (_, _, source) in zip(tracks, mine, strict=True)
                    ],
                    split=split,
                )
                bar.update(len(batch))
    finally:
        pool.close()
    store = open_clips(cfg, [writer.root])
    return {
        "episodes": len(store),
        "held_out": len(store.split("held_out")),
        "frames": int(store.length.sum()),
        "successes": sum(bool(row["success"]) for row in store.episodes),
    }


def scripted_jobs(cfg: Cfg) -> list[tuple[int, float, str]]:
    """(episode seed, noise level, source) of every scripted episode.

    Consecutive episodes mix all sources, so any prefix of the data has the right proportions.

    Raises:
        ConfigError: if collect.mix does not come to whole percents.
    """
    section = cfg["collect"]
    total = sum(section["episodes"].values())
    names = [name for name, share in section["mix"].items() for _ in range(round(100 * share))]
    if len(names) != 100:
        raise ConfigError(f"collect.mix={section['mix']} must be whole percents that add up to 1")
    order = torch.randperm(100, generator=torch.Generator().manual_seed(0)).tolist()
    low, high = section["noise_level"]
    jobs = []
    for number, seed in enumerate(episode_seeds(cfg["seed"], Purpose.COLLECT, total)):
        source = names[order[number % 100]]
        drawn = low + (high - low) * ((number * 0.618) % 1.0)
        jobs.append((seed, {"expert": 0.0, "random": 1.0}.get(source, drawn), source))
    return jobs


def shards(splits: Mapping[str, int], size: int, done: int) -> Iterator[tuple[str, range]]:
    """(split, episode numbers) of every file still to be written; splits follow each other, no file is mixed.

    Args:
        splits: episodes per split.
        size: episodes per file at most.
        done: episodes written already.
    """
    begin = 0
    for split in SPLITS:
        end = begin + splits.get(split, 0)
        for first in range(begin, end, size):
            numbers = range(max(first, done), min(first + size, end))
            if len(numbers):
                yield split, numbers
        begin = end


@stage(reads=(*PHYSICS, "rounds.splits"))
def deploy(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Episodes of the current stochastic policy in physics, recorded whole.

    Settings: number of the round, episodes.
    """
    number, episodes = inputs.settings["number"], inputs.settings["episodes"]
    policy, robot = build_policy(cfg, inputs.weights("policy")), world_spec(cfg).embodiment
    seeds = episode_seeds(cfg["seed"], Purpose.DEPLOY, episodes, offset=100_000 * number)
    data = folder / "dataset"
    shutil.rmtree(data, ignore_errors=True)  # a deployment is short; half of one is begun anew
    won: list[bool] = []
    tracks = (track for some in run_recorded(cfg, policy, seeds) for track in some)
    with WriteBehind(LeRobotWriter(data, robot)) as behind:
        for split, batch in shards(split_counts(episodes, cfg["rounds"]["splits"]), _SHARD, 0):
            mine = [next(tracks) for _ in batch]
            behind.write([Episode.from_track(t, f"policy-{number}", robot) for t in mine], split=split)
            won += [bool(track.rows["success"][-1]) for track in mine]
    tracks.close()
    success = torch.tensor(won)
    return {
        "episodes": len(success),
        "true_stochastic": rate_entry(success),
        "success": float(success.float().mean()),
    }


def split_counts(episodes: int, shares: Mapping[str, float]) -> dict[str, int]:
    """Episodes per split; the splits named in `shares` get at least one each, train the rest."""
    counts = {name: max(1, round(share * episodes)) for name, share in shares.items()}
    return {"train": episodes - sum(counts.values()), **counts}


def run_recorded(cfg: Cfg, policy: Any, seeds: list[int], stochastic: bool = True) -> Iterator[list[Track]]:
    """Recorded episodes of a policy in physics, in the order of the seeds, as many at once as run side by
    side.
    """
    env = build_physics(cfg, batch=min(_SHARD, len(seeds)), record=True)
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


@stage(reads=("task",))
def recordings(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Recorded data sets in place of physics; nothing is copied.

    Settings: fingerprint of the data sets, so that longer ones have another key.

    Raises:
        ConfigError: if no episode is left to learn from.
    """
    paths = [Path(path).resolve() for path in cfg["task"]["data"]]
    write_text(folder / DATASETS, json.dumps([str(path) for path in paths]))
    store = open_clips(cfg, paths)
    if not len(store.split("train")):
        raise ConfigError(f"task.data={[str(path) for path in paths]} hold no episode of the split 'train'")
    labels = [row["success"] for row in store.episodes]
    return {
        "episodes": len(store),
        "held_out": len(store.split("held_out")),
        "frames": int(store.length.sum()),
        "labelled": sum(label is not None for label in labels),
        "successes": sum(label is True for label in labels),
    }


def fingerprint(paths: list[str]) -> str:
    """Changes when recorded data sets do: a hash of their info.json.

    Raises:
        ConfigError: for a folder that is no LeRobot v3.0 data set.
    """
    texts = []
    for path in paths:
        info = Path(path) / "meta" / "info.json"
        if not info.is_file():
            raise ConfigError(
                f"task.data: {info} is missing; name folders of LeRobot v3.0 data sets (`worldloop convert` makes"
                " them of other recordings)"
            )
        texts.append(info.read_text())
    return digest(texts)
