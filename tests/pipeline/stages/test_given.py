"""What stages collect, and how it is split."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from actors.factory import open_clips
from envs.episodes import LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.episodes.splits import write_splits
from envs.manifest import DamagedArtefact, write_manifest
from envs.physics.suite import Observation
from envs.rng import Purpose, episode_seeds
from envs.targets import ConfigError
from learners.training.fit import TrainingDiverged, fit
from pipeline.config import load_config
from pipeline.evaluation.by_task import (
    evenly,
    tasks_of_episodes,
    tasks_of_first_frames,
    tasks_of_seeds,
    tasks_told,
)
from pipeline.graph.stage import Inputs
from pipeline.stages import pace
from pipeline.stages.collect import collect, first_frames, scripted_jobs, split_counts
from pipeline.stages.given import (
    DATASETS,
    datasets,
    demonstrations,
    fit_options,
    imagined_chunks,
    newest_episodes,
)
from pipeline.stages.variant import variant_episodes
from tests.embodiments import ARM_DELTAS, world_spec
from tests.moving_square import moving_square
from tests.suites.counting import Counting


def test_splits_add_up_and_none_is_empty() -> None:
    assert split_counts(16, {"held_out": 0.125, "calibration": 0.25}) == {
        "train": 10,
        "held_out": 2,
        "calibration": 4,
    }
    assert split_counts(3, {"calibration": 0.1, "held_out": 0.1}) == {
        "train": 1,
        "held_out": 1,
        "calibration": 1,
    }


def test_few_episodes_are_first_of_all_for_learning() -> None:
    shares = {"held_out": 0.125, "calibration": 0.25}
    for episodes, due in ((0, (0, 0, 0)), (1, (1, 0, 0)), (2, (1, 1, 0)), (4, (2, 1, 1))):
        assert tuple(split_counts(episodes, shares).values()) == due
    assert split_counts(4, {"held_out": 0.9, "calibration": 0.1})["train"] == 1


def test_a_shard_that_is_spoiled_before_the_stage_ends_is_found(tmp_path: Path) -> None:
    cfg = load_config(["experiment=soak", "collect.episodes={train: 1, held_out: 1, calibration: 1}"])
    cfg["collect"]["shard"], cfg["launch"]["workers"] = 2, 1
    view = collect.view("collect", cfg, {})
    collect.run(view, tmp_path, Inputs())  # what a run would seal now
    (video, *_) = sorted((tmp_path / "dataset").rglob("*.mp4"))
    content = bytearray(video.read_bytes())
    content[len(content) // 2] ^= 1
    video.write_bytes(content)
    for go_on in (
        lambda: write_manifest(tmp_path, {"stage": "collect", "result": {}}),
        lambda: collect.run(view, tmp_path, Inputs()),
    ):
        with pytest.raises(DamagedArtefact, match=video.name):
            go_on()
    content[len(content) // 2] ^= 1
    video.write_bytes(content)
    sealed = write_manifest(tmp_path, {"stage": "collect", "result": {}})["files"]
    assert video.relative_to(tmp_path).as_posix() in sealed


@pytest.mark.long
def test_an_episode_that_crashes_physics_is_left_out_of_its_split(tmp_path: Path) -> None:
    cfg = load_config(["experiment=soak", "launch.workers=2"])
    cfg["task"] |= {"suite": {"_target_": "tests.suites.counting.Counting", "fault": "exit"}}
    cfg["task"] |= {"name": "count", "size": [4, 4], "horizon": 4, "mode": "absolute"}
    cfg["collect"] |= {
        "shard": 2,
        "mix": {"expert": 0.93, "random": 0.07},
    }  # it is the random ones that crash
    cfg["collect"]["episodes"] = {"train": 2, "held_out": 2, "calibration": 2}
    sources = [source for _, _, source in scripted_jobs(cfg)]
    assert sources.count("random") == 1
    for _ in range(2):  # the second goes on after the last episode, so there is nothing to do
        said = collect.run(collect.view("collect", cfg, {}), tmp_path, Inputs())
        assert (said["episodes"], said["dropped"], said["held_out"]) == (
            5,
            1,
            2 - sources[2:4].count("random"),
        )


@pytest.mark.parametrize(
    ("stage", "settings", "made"),
    [
        (first_frames, {}, "starts"),
        (variant_episodes, {"episodes": 3}, "episodes"),
    ],
)
def test_starts_that_crash_physics_are_dropped_and_counted(
    stage: Any, settings: dict[str, Any], made: str, tmp_path: Path
) -> None:
    cfg = load_config(["experiment=soak", "launch.workers=2", "extra_starts.episodes=3"])
    suite = {"_target_": "tests.suites.counting.Startless", "fault": ""}
    cfg["task"] |= {"suite": suite, "variants": {"odd": {}}}
    cfg["task"] |= {"name": "count", "size": [4, 4], "horizon": 4, "mode": "absolute"}
    asked = {"variant": "odd", **settings}
    said = stage.run(stage.view("odd", cfg, asked), tmp_path, Inputs(settings=asked))
    assert (said[made], said["dropped"]) == (2, 1)
    assert said.get("physics_episodes", {"first frames": 2}) == {"first frames": 2}


def test_starts_and_random_episodes_need_no_expert(tmp_path: Path) -> None:
    cfg = load_config(["experiment=soak", "launch.workers=1", "extra_starts.episodes=3"])
    suite = {"_target_": "tests.suites.counting.Scriptless", "fault": ""}
    cfg["task"] |= {"suite": suite, "variants": {"odd": {}}}
    cfg["task"] |= {"name": "count", "size": [4, 4], "horizon": 4, "mode": "absolute"}
    asked = {"variant": "odd"}
    said = first_frames.run(first_frames.view("odd", cfg, asked), tmp_path, Inputs(settings=asked))
    assert (said["starts"], said["dropped"]) == (3, 0)
    cfg["collect"]["mix"] = {"expert": 0, "noisy": 0, "random": 1}
    cfg["collect"]["episodes"] = {"train": 2, "held_out": 1, "calibration": 1}
    assert collect.run(collect.view("collect", cfg, {}), tmp_path / "random", Inputs())["episodes"] == 4


def test_any_prefix_of_the_scripted_episodes_is_mixed() -> None:
    cfg = load_config(["experiment=smoke"])
    jobs = scripted_jobs(cfg)
    assert len(jobs) == sum(cfg["collect"]["episodes"].values()) and len(
        {seed for seed, _, _ in jobs}
    ) == len(jobs)
    assert {source for _, _, source in jobs[:20]} == {"expert", "noisy", "random"}
    assert all(level == 0 for _, level, source in jobs if source == "expert")
    low, high = cfg["collect"]["noise_level"]
    assert all(low <= level <= high for _, level, source in jobs if source == "noisy")


def test_every_task_of_several_has_the_same_mix() -> None:
    cfg = load_config(["experiment=smoke", "task=metaworld", "task.name=[drawer-open-v3,door-open-v3]"])
    cfg["collect"]["episodes"] = {"train": 200, "held_out": 0, "calibration": 0}
    jobs = scripted_jobs(cfg)
    mixes = [Counter(source for _, _, source in jobs[turn::2]) for turn in range(2)]
    assert mixes[0] == mixes[1]
    assert tasks_of_seeds(cfg, [seed for seed, _, _ in jobs[:3]]) == [
        "drawer-open-v3",
        "door-open-v3",
        "drawer-open-v3",
    ]


def test_seeds_of_purposes_and_experiments_never_meet() -> None:
    drawn = [
        set(episode_seeds(seed, purpose, 1000))
        for seed in (0, 1)
        for purpose in Purpose
        if purpose is not Purpose.EVALUATE
    ]
    evaluation = set(episode_seeds(0, Purpose.EVALUATE, 1000))
    assert len(set().union(*drawn, evaluation)) == 11000
    assert evaluation == set(episode_seeds(1, Purpose.EVALUATE, 1000))


def test_recordings_that_stand_task_by_task_are_shared_out_evenly(tmp_path: Path) -> None:
    def told(order: str) -> tuple[Any, ClipStore]:
        made = [
            replace(moving_square(ARM_DELTAS, seed), instruction=f"do {word}")
            for seed, word in enumerate(order)
        ]
        LeRobotWriter(tmp_path / order, made[0].embodiment).write(made)
        write_splits(tmp_path / order, {"train": len(order), "held_out": 0, "calibration": 0})
        cfg = load_config(
            [
                *("experiment=smoke", "task=lerobot", f"task.data=[{tmp_path / order}]", "task.size=[32,32]"),
                *("imitation.demos=7", "imitation.sources=['*']"),
            ]
        )
        return cfg, open_clips(cfg, cfg["task"]["data"])

    cfg, store = told("aaaaaaaabbbbc")
    chosen = demonstrations(cfg, store)
    assert chosen.tolist() == [0, 1, 2, 8, 9, 10, 12]
    everything = torch.arange(len(store))
    assert evenly(cfg, store, everything, 3).tolist() == [0, 8, 12]
    assert evenly(cfg, store, everything, 99).tolist() == everything.tolist()
    assert evenly(cfg, store, everything[:0], 3).tolist() == []
    for order in ("aaaaaaaaa", "abcabcabcabc"):  # the first ones are that already
        assert demonstrations(*told(order)).tolist() == list(range(7))
    suite = {"_target_": "tests.suites.counting.Counting", "fault": "", "tasks": ["do b", "do a"]}
    physics = {**cfg, "task": {**cfg["task"], "suite": suite, "name": "do b"}}
    assert tasks_of_episodes(physics, store, everything) == [f"do {word}" for word in "aaaaaaaabbbbc"]


@pytest.mark.parametrize(
    ("succeed", "told"),
    [
        (
            set(),
            "0 successful episodes of imitation.sources=['expert'] for learning (3 of these sources failed);"
            " record more that succeed, or correct next.success",
        ),
        (
            {0, 1, 3, 6},
            "1 successful episodes of imitation.sources=['expert'] for learning (2 of these sources failed; 2"
            " successful ones are of other sources, ['random']; 1 are held out); say"
            " \"imitation.sources=['*']\" for all, or name others; or hold out fewer (splits); or lower"
            " imitation.demos to 1 at most; or record more that succeed",
        ),
    ],
)
def test_too_few_demonstrations_are_told_with_what_helps(
    succeed: set[int], told: str, tmp_path: Path
) -> None:
    made = [moving_square(ARM_DELTAS, seed, "random" if seed % 2 else "expert") for seed in range(8)]
    made = [replace(one, success=np.full(len(one), seed in succeed)) for seed, one in enumerate(made)]
    LeRobotWriter(tmp_path / "set", made[0].embodiment).write(made)
    write_splits(tmp_path / "set", {"train": 5, "held_out": 2, "calibration": 1})
    words = ("task=lerobot", f"task.data=[{tmp_path / 'set'}]", "task.size=[32,32]", "imitation.demos=4")
    cfg = load_config(["experiment=smoke", *words, "imitation.sources=[expert]"])
    with pytest.raises(ConfigError, match=f"^{re.escape(f'imitation.demos=4, but the data hold {told}')}$"):
        demonstrations(cfg, open_clips(cfg, cfg["task"]["data"]))


class Wordy(Counting):
    """Says of each task something else at every third seed, after what it says first."""

    def __init__(self, fault: str, tasks: tuple[str, ...] = ("count",), first: str = ""):
        super().__init__(fault, tasks=tasks)
        self.first = first

    def observe(self) -> Observation:
        return replace(super().observe(), instruction=f"{self.first}{self.task} {self.count % 3:g}")


def test_tasks_are_those_that_physics_says_the_recorded_words_of() -> None:
    suite = Wordy("", tasks=("count", "recount", "uncount"))
    told = [(0, "uncount 0"), (1, "count 1"), (2, "recount 2"), (3, "uncount 0"), (4, "count 2"), (5, "")]
    assert tasks_told(suite, ["count", "recount"], told) == [
        *("uncount", "count", "recount", "uncount", None, None)
    ]
    assert tasks_told(suite, ["recount"], told[:3]) == ["uncount", "count", "recount"]


@pytest.mark.long
def test_first_frames_have_the_task_whose_turn_it_was(tmp_path: Path) -> None:
    """A variant with other scenes says other words at a seed than the task does."""
    cfg = load_config(["experiment=soak", "launch.workers=1", "extra_starts.episodes=6"])
    wordy = {"_target_": "tests.pipeline.stages.test_given.Wordy", "fault": ""}
    cfg["task"] |= {"suite": {**wordy, "tasks": ["count", "recount"]}, "name": ["count", "recount"]}
    cfg["task"] |= {
        "variants": {"odd": {"first": "please "}},
        "size": [4, 4],
        "horizon": 4,
        "mode": "absolute",
    }
    asked = {"variant": "odd"}
    first_frames.run(first_frames.view("odd", cfg, asked), tmp_path, Inputs(settings=asked))
    store = open_clips(cfg, [tmp_path / "dataset"])
    assert tasks_of_episodes(cfg, store, torch.arange(6)) == store.instructions
    assert tasks_of_first_frames(cfg, store) == 3 * ["count", "recount"]


@pytest.mark.parametrize(
    ("horizon", "chunk", "chunks"), [(8, 4, 2), (8, 2, 4), (8, 25, 1), (9, 4, 3), (60, 4, 5), (None, 4, 5)]
)
def test_imagined_episodes_are_as_long_whatever_a_chunk_has(
    horizon: int | None, chunk: int, chunks: int
) -> None:
    cfg = {"rl": {"horizon": horizon}, "task": {"chunk": chunk, "horizon": 20 if chunk < 20 else 100}}
    assert imagined_chunks(cfg) == chunks


def test_of_sets_that_a_user_lists_none_is_newer_than_the_others(tmp_path: Path) -> None:
    robot = ARM_DELTAS.at((32, 32))
    folders = [tmp_path / "one", tmp_path / "two", tmp_path / "deploy/dataset"]
    for folder in folders:
        LeRobotWriter(folder, robot).write([moving_square(ARM_DELTAS, seed) for seed in range(2)])
    listed = tmp_path / "recordings"
    listed.mkdir()
    (listed / DATASETS).write_text(json.dumps([str(folder) for folder in folders[:2]]))
    spec, stages = world_spec(robot), (listed, tmp_path / "deploy")
    for count, newest in ((1, [0, 1, 2, 3]), (2, [4, 5])):
        store = ClipStore(datasets(stages[:count]), spec)
        found = newest_episodes(store, Inputs({"data": stages[:count]}), torch.arange(len(store)))
        assert found.tolist() == newest


@pytest.mark.parametrize(
    "key",
    [
        *("tokenizer_fit", "simulator_fit.first.fit", "state_fit.refresh.fit", "judge_fit.first.fit"),
        *("text_world_fit.tokenizer", "imitation.perception", "imitation.fit", "clone.fit"),
        *("distill.first.fit", "finetune.state.fit"),
    ],
)
def test_what_helps_training_that_diverges_is_in_the_config(key: str, tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke", f"++{key}.bf16=true"])
    section = reduce(lambda part, name: part[name], key.split("."), cfg)
    net = torch.nn.Linear(1, 1)
    with pytest.raises(TrainingDiverged) as error:
        fit(
            "part",
            net,
            lambda *_: torch.full((1, 1), torch.nan),
            lambda data, _: (net(data).sum(), {}),
            fit_options(cfg, section, key),
            tmp_path,
        )
    said = re.search(r"lower (\S+) or say (\S+)$", str(error.value))
    assert said is not None
    cfg = load_config(["experiment=smoke", f"{said[1]}=1e-7", said[2]])
    section = reduce(lambda part, name: part[name], key.split("."), cfg)
    assert section["lr"] == 1e-7 and section["bf16"] is False


def test_parts_that_are_timed_know_where_their_options_are() -> None:
    fits = pace.fits_of(load_config(["experiment=soak", "simulator=dit_small", "state_fit.first.fit.lr=0.5"]))
    assert {part: fit.key for part, fit in fits.items()} == {
        "tokenizer": "tokenizer_fit",
        "simulator": "simulator_fit.first.fit",
        "state": "state_fit.first.fit",
    }
    assert fits["state"].lr == 0.5
