"""What the stage simulator learns from: the same episodes whatever the engine, and no ends that calibrate."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from envs.episodes import Episode, LeRobotWriter
from envs.episodes.splits import write_splits
from pipeline.config import load_config
from pipeline.graph.stage import Inputs
from pipeline.stages import world
from pipeline.stages.given import DATASETS
from tests.embodiments import ARM_DELTAS
from tests.moving_square import SIZE, moving_square

TRAIN, CALIBRATION = range(4), range(4, 8)  # of nine episodes, the last of which is held out


def taught(folder: Path, episodes: Sequence[Episode]) -> dict[str, Tensor]:
    """What a world of tokens learns of some episodes."""
    LeRobotWriter(folder / "data", ARM_DELTAS.at(SIZE)).write(list(episodes))
    write_splits(folder / "data", {"train": len(TRAIN), "calibration": len(CALIBRATION), "held_out": 1})
    words = ("task=lerobot", f"task.data=[{folder / 'data'}]", "task.size=[32,32]", "task.chunk=4")
    fit = ("simulator_fit.first.fit={steps: 3, batch: 16}", "simulator.bf16=false", "launch.device=cpu")
    cfg = load_config(["experiment=smoke", "simulator=tokens_small", *words, "task.horizon=8", *fit])
    (folder / DATASETS).write_text(json.dumps([str(folder / "data")]))
    settings = {"phase": "first"}
    view = world.simulator.view("simulator-1", cfg, settings)
    world.simulator.run(view, folder, Inputs({"data": (folder,)}, settings))
    return load_file(folder / "weights.safetensors")


def turned(episodes: Sequence[Episode], which: range) -> list[Episode]:
    """The episodes, with the opposite of what is recorded of success in some of them."""
    return [
        replace(episode, success=~episode.success)
        if number in which and episode.success is not None
        else episode
        for number, episode in enumerate(episodes)
    ]


@pytest.mark.long
def test_worlds_that_say_done_learn_from_calibration_but_not_when_its_tasks_are_done(tmp_path: Path) -> None:
    some = [moving_square(ARM_DELTAS, seed, "expert" if seed % 2 else "random") for seed in range(9)]
    others = [moving_square(ARM_DELTAS, 50 + n) if n in CALIBRATION else one for n, one in enumerate(some)]
    data = {
        "plain": some,
        "other_ends": turned(some, CALIBRATION),
        "train_ends": turned(some, TRAIN),
        "other_video": others,
    }
    found = {}
    for name, episodes in data.items():
        (tmp_path / name).mkdir()
        found[name] = taught(tmp_path / name, episodes)

    def same(name: str) -> bool:
        return all(torch.equal(value, found[name][key]) for key, value in found["plain"].items())

    assert {name: same(name) for name in data} == {
        "plain": True,
        "other_ends": True,
        "train_ends": False,
        "other_video": False,
    }
