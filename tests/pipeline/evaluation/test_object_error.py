"""Errors of an object's place in generated video: where they can be measured, and silence where they cannot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from envs.episodes import Episode, LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.simulators.replay import Replay
from pipeline.evaluation.measurement import rollout_error
from tests.embodiments import BIMANUAL_POSES, world_spec
from tests.moving_square import SIZE, moving_square

MEASURED = {"object_px", "object_cm", "object_cm_at_end", "object_lost", "locator_px"}


def store_of(folder: Path, change: Callable[[Episode], Episode]) -> ClipStore:
    """Calibrated episodes of the moving square, changed."""
    made = [change(moving_square(BIMANUAL_POSES, seed)) for seed in range(3)]
    LeRobotWriter(folder / "set", BIMANUAL_POSES.at(SIZE)).write(made)
    return ClipStore([folder / "set"], world_spec(BIMANUAL_POSES.at(SIZE), SIZE), folder / "cache")


def recorded(store: ClipStore, episodes: torch.Tensor, shift: int = 0) -> Replay:
    """The true video as if a world had made it, with every picture `shift` pixels too far right."""
    rows, valid = store.whole(episodes)
    frames = store.frames(rows).roll(shift, -1)
    return Replay(frames, rows, valid, store.arrays["states"][rows])


def test_calibrated_data_without_privileged_columns_are_measured(tmp_path: Path) -> None:
    store = store_of(tmp_path, lambda episode: replace(episode, privileged={}))
    assert store.spec.embodiment.calibrated
    episodes = torch.arange(3)
    result = rollout_error(store, episodes, recorded(store, episodes))
    assert result["psnr_last_frames"] == 80.0 and not MEASURED & result.keys()
