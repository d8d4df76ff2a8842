"""Stages that gather episodes: scripted ones and those of the current policy in physics, or recordings."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from actors.factory import at_once, build_physics, build_policy, build_pool, open_clips
from actors.process import prepare_process
from actors.rollouts.evaluate import evaluate
from actors.world_config import world_spec
from envs.episodes.clips import ClipStore
from envs.episodes.episode import Episode
from envs.episodes.filming import side_by_side, write_film
from envs.episodes.formats.lerobot.dataset import LeRobotDataset
from envs.episodes.formats.lerobot.writer import LeRobotWriter
from envs.episodes.splits import write_splits
from envs.episodes.write_behind import WriteBehind
from envs.files import write_text
from envs.manifest import check_whole, keep_whole
from envs.physics.suite import task_names
from envs.physics.worker import Track
from envs.rng import Purpose, episode_seeds, order_generator
from envs.targets import ConfigError
from pipeline.evaluation.by_task import START, by_task, tasks_of_episodes, tasks_of_seeds
from pipeline.evaluation.statistics import rate_entry
from pipeline.graph.stage import Inputs, stage
from pipeline.stages.given import DATASETS, PHYSICS, ROBOT, Cfg

_SIDE_BY_SIDE = 64  # deployed episodes
_FILMED = 3  # failures of each task's expert, at most
LEAST = 0.9  # share of its episodes in which an expert must succeed to be one
SPLITS = ("train", "held_out", "calibration")  # in the order of their episodes


@stage(reads=(*ROBOT, "collect"))
def collect(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Scripted episodes into a LeRobot data set, in the order of its splits; goes on after the last shard."""
    section = cfg["collect"]
    task, robot, jobs = cfg["task"], world_spec(cfg).embodiment, scripted_jobs(cfg)
    check_whole(folder)
    writer = LeRobotWriter(folder / "dataset", robot)
    sealed = partial(_seal_shards, folder, writer)
    if writer.shards:
        sealed()  # one that was whole when the last try was cut off
    pool = build_pool(cfg)
    done = _next_job(writer, jobs)
    try:
        with (
            tqdm(total=len(jobs), initial=done, desc="collect", unit="ep", dynamic_ncols=True) as bar,
            WriteBehind(writer, sealed) as behind,
        ):
            for begin in range(done, len(jobs), section["shard"]):
                mine = jobs[begin : begin + section["shard"]]
                tracks = pool.script([(seed, level) for seed, level, _ in mine], task["chunk"])
                sources = {seed: source for seed, _, source in mine}
                behind.write([Episode.from_track(track, sources[track.seed], robot) for track in tracks])
                bar.update(len(mine))
    finally:
        pool.close()
    made, planned = _recorded_seeds(writer), iter(jobs)
    splits = {name: list(islice(planned, section["episodes"][name])) for name in SPLITS}
    write_splits(
        writer.root, {name: sum(seed in made for seed, _, _ in part) for name, part in splits.items()}
    )
    store = open_clips(cfg, [writer.root])
    return {
        "episodes": len(store),
        "dropped": len(jobs) - len(store),
        "held_out": len(store.split("held_out")),
        "frames": int(store.length.sum()),
        "successes": sum(bool(row["success"]) for row in store.episodes),
        **_failures(cfg, store, folder),
        "physics_episodes": {"scripted": len(store)},
    }


def _recorded_seeds(writer: LeRobotWriter) -> list[int]:
    """Seeds of the episodes that are written, in their order."""
    return LeRobotDataset(writer.root).seeds() if writer.shards else []


def _next_job(writer: LeRobotWriter, jobs: list[tuple[int, float, str]]) -> int:
    """Where to go on: after the last job that left an episode; some before may have been dropped."""
    made = _recorded_seeds(writer)
    return 1 + [seed for seed, _, _ in jobs].index(made[-1]) if made else 0


def _seal_shards(folder: Path, writer: LeRobotWriter) -> None:
    """Remember what finished shards are, so that one that is spoiled before the stage ends is found."""
    keep_whole(folder, writer.shard_files())


def _failures(cfg: Cfg, store: ClipStore, folder: Path) -> dict[str, Any]:
    """expert_failures, task and seed of every episode in which the expert itself failed, some of each task
    saved as videos; alarm, if an expert fails so often that there is little to learn from.
    """
    tried, failed = store.select(["expert"]), store.select(["expert"], succeeded=False)
    counts, shown = Counter(tasks_of_episodes(cfg, store, tried)), Counter[str]()
    names, tasks = list[str](), tasks_of_episodes(cfg, store, failed)
    for task, n in zip(tasks, failed.tolist(), strict=True):
        names.append(f"{task}-{store.episodes[n]['seed']}")
        shown[task] += 1
        if shown[task] <= _FILMED:
            frames = store.frames(store.rows(torch.tensor([n]))).numpy()
            write_film(folder / "media" / f"expert-{names[-1]}.mp4", side_by_side(frames), store.fps)
    if not names:
        return {"expert_failures": names}
    told = ", ".join(f"{task} {n} of {counts[task]}" for task, n in shown.most_common())
    text = f"the expert fails ({told} episodes); videos of some are in {folder / 'media'}"
    tqdm.write(f"collect: {text}")
    bad = [task for task, n in shown.items() if n > (1 - LEAST) * counts[task]]
    alarm = f"{text}; `worldloop bench experts` tells more, a longer task.horizon or another rate may help"
    return {"expert_failures": names, **({"alarm": alarm} if bad else {})}


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
    order = torch.randperm(100, generator=order_generator(0)).tolist()
    low, high = section["noise_level"]
    turns, jobs = len(task_names(cfg["task"]["name"])), []
    for number, seed in enumerate(episode_seeds(cfg["seed"], Purpose.COLLECT, total)):
        source = names[order[number // turns % 100]]  # the same mix in each task
        drawn = low + (high - low) * ((number * 0.618) % 1.0)
        jobs.append((seed, {"expert": 0.0, "random": 1.0}.get(source, drawn), source))
    return jobs


@stage(reads=(*ROBOT, "extra_starts.episodes", "task.variants.{variant}"))
def first_frames(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """How episodes of a variant of the task begin, as a data set of single frames: physics lays them out and
    is asked for no step.

    Settings: variant, its name in task.variants.
    """
    seeds = episode_seeds(cfg["seed"], Purpose.STARTS, cfg["extra_starts"]["episodes"])
    changes, robot = cfg["task"]["variants"][inputs.settings["variant"]], world_spec(cfg).embodiment
    data = folder / "dataset"
    shutil.rmtree(data, ignore_errors=True)
    pool = build_pool(cfg, changes, horizon=0)
    try:
        tracks = pool.script([(seed, 0.0) for seed in seeds], cfg["task"]["chunk"])
    finally:
        pool.close()
    LeRobotWriter(data, robot).write([Episode.from_track(track, START, robot) for track in tracks])
    return {
        "starts": len(open_clips(cfg, [data])),
        "dropped": len(seeds) - len(tracks),
        "physics_episodes": {"first frames": len(tracks)},
    }


@stage(reads=(*ROBOT, "extra_starts.data"))
def recorded_starts(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Recorded data sets whose episodes' first frames are starts; nothing is copied.

    Settings: fingerprint of the data sets.
    """
    paths = [Path(path).resolve() for path in cfg["extra_starts"]["data"]]
    write_text(folder / DATASETS, json.dumps([str(path) for path in paths]))
    return {"starts": len(open_clips(cfg, paths))}


@stage(reads=(*PHYSICS, "rounds.splits"))
def deploy(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Episodes of the current stochastic policy in physics, recorded whole.

    Settings: number of the round, episodes.
    """
    number, episodes = inputs.settings["number"], inputs.settings["episodes"]
    prepare_process(cfg["seed"], cfg["threads"])
    policy, robot = build_policy(cfg, inputs.weights("policy")), world_spec(cfg).embodiment
    seeds = episode_seeds(cfg["seed"], Purpose.DEPLOY, episodes, offset=100_000 * number)
    data = folder / "dataset"
    shutil.rmtree(data, ignore_errors=True)  # a deployment is short; half of one is begun anew
    won, played = list[bool](), list[int]()
    with WriteBehind(LeRobotWriter(data, robot)) as behind:
        for tracks in run_recorded(cfg, policy, seeds):
            behind.write([Episode.from_track(track, f"policy-{number}", robot) for track in tracks])
            won += [bool(track.rows["success"][-1]) for track in tracks]
            played += [track.seed for track in tracks]
    counts = split_counts(len(won), cfg["rounds"]["splits"])
    write_splits(data, counts)
    success = torch.tensor(won)
    return {
        "round": number,
        "episodes": len(success),
        "dropped": episodes - len(success),
        "held_out": counts["held_out"],
        "true_stochastic": rate_entry(success),
        "tasks": by_task(tasks_of_seeds(cfg, played), rate_entry, success),
        "success": float(success.float().mean()),
        "physics_episodes": {"own": len(success)},
    }


def split_counts(episodes: int, shares: Mapping[str, float]) -> dict[str, int]:
    """Episodes per split, in the order of SPLITS: the first one is for learning, those in `shares` get at
    least one of the others as far as they go, and train the rest.
    """
    left, counts = max(0, episodes - 1), dict[str, int]()
    for name in SPLITS:
        if name in shares:
            counts[name] = min(left, max(1, round(shares[name] * episodes)))
            left -= counts[name]
    return {"train": episodes - sum(counts.values()), **counts}


def run_recorded(cfg: Cfg, policy: Any, seeds: list[int], stochastic: bool = True) -> Iterator[list[Track]]:
    """Recorded episodes of a policy in physics, in the order of the seeds, as many at once as run side by
    side; those in which physics crashes again and again are missing.
    """
    env = build_physics(cfg, batch=at_once(cfg, min(_SIDE_BY_SIDE, len(seeds))), record=True)
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
            # Slots beyond the last episode play it again; the first one counts, as it does in `evaluate`.
            tracks = {track.seed: track for track in reversed(env.pop_tracks())}
            yield [tracks[seed] for seed in part if seed in tracks]
    finally:
        env.close()


@stage(reads=ROBOT)
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
