"""Recordings of a single frame, in which nothing happens: whatever is generated or judged goes without."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from actors.factory import open_clips
from envs.episodes import LeRobotWriter
from envs.episodes.splits import write_splits
from learners.stages.generated import generated_frames
from pipeline.config import load_config
from pipeline.evaluation.measurement import followed
from pipeline.graph.stage import Inputs
from pipeline.stages import prove, show
from pipeline.stages.given import DATASETS
from pipeline.stages.judging import stage as judging
from tests.embodiments import ARM_DELTAS
from tests.learners.models import simulator_of
from tests.moving_square import SIZE, moving_square

SPLITS = {"train": 4, "held_out": 4, "calibration": 4}


def recorded(folder: Path, short: set[int], *words: str) -> Any:
    """The smallest loop on twelve recordings, of which the `short` ones have a single frame."""
    made = [
        moving_square(
            ARM_DELTAS, seed, "expert" if seed % 2 else "random", length=1 if seed in short else 13 - seed % 3
        )
        for seed in range(12)
    ]
    LeRobotWriter(folder / "set", ARM_DELTAS.at(SIZE)).write(made)
    write_splits(folder / "set", SPLITS)
    (folder / DATASETS).write_text(json.dumps([str(folder / "set")]))
    data = ("task=lerobot", f"task.data=[{folder / 'set'}]", "task.size=[32,32]", "launch.device=cpu")
    return load_config(["experiment=smoke", *data, "task.chunk=4", "task.horizon=8", *words])


@pytest.mark.parametrize("short", [{4, 6}, {4, 5, 6, 7}], ids=["all of a source", "all that are held out"])
@pytest.mark.long
def test_held_out_ones_are_not_replayed(
    short: set[int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cfg, data = recorded(tmp_path, short), {"data": tmp_path}
    measured = prove.measure.run(prove.measure.view("measure", cfg, {}), tmp_path, Inputs(data))
    assert list(measured["rollout"]) == (["expert"] if len(short) == 2 else [])
    rows = json.loads((tmp_path / prove.EPISODES).read_text())
    assert {row["episode"] for row in rows} == {4, 5, 6, 7} - short
    view = show.replays.view("videos", cfg, {})
    videos = show.replays.run(view, tmp_path, Inputs({**data, "measured": tmp_path}))["videos"]
    assert any(name.startswith("held-out" if rows else "learned-from") for name in videos)
    told = f"{len(short)} episodes of a single frame are left out ({tmp_path / 'set'})"
    assert capsys.readouterr().out.splitlines().count(told) == 1


def test_judges_are_taught_and_calibrated_without(tmp_path: Path) -> None:
    fit = ("judge_fit.first.fit.steps=2", "judge_fit.first.imagined=4")
    cfg, settings = recorded(tmp_path, {0, 1, 2, 8, 9, 10, 11}, "judge=learned", *fit), {"phase": "first"}
    view = judging.judge.view("judge-1", cfg, settings)
    made = judging.judge.run(view, tmp_path, Inputs({"data": tmp_path}, settings))
    assert "auc" not in made and made["generated_frames"] == 12


def test_nothing_is_generated_of_them(tmp_path: Path) -> None:
    cfg = recorded(tmp_path, {0, 1})
    store = open_clips(cfg, [tmp_path / "set"])
    simulator = simulator_of("unet_small", store.spec)
    made = generated_frames(simulator, store, torch.tensor([0, 2]), bf16=False)
    assert made["episode"].unique().tolist() == [2] and len(made) == int(store.length[2]) - 1
    assert not len(generated_frames(simulator, store, torch.tensor([0, 1]), bf16=False))
    assert followed(store, torch.arange(4)).tolist() == [2, 3]
