"""Teaching a text world: from successes alone, the tokenizer first."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from learners.stages.text_world import SuccessfulClips, train_text_world
from learners.training.fit import FitConfig
from tests.embodiments import ARM_DELTAS
from tests.envs.simulators.test_text_world import world
from tests.moving_square import INSTRUCTION

Stores = Callable[[Embodiment], ClipStore]


def test_it_learns_from_successes_and_then_goes_where_they_go(tiny_store: Stores, tmp_path: Path) -> None:
    store, model = tiny_store(ARM_DELTAS), world(window=6, ending={"max_frames": 3})
    every = torch.arange(len(store))
    short = FitConfig(30, 8, 5e-3, warmup=3, ema=0.8, bf16=False)
    stats = train_text_world(model, store, every, 2, short, tmp_path, tokenizer=short)
    assert stats["successes"] == len(store.select(succeeded=True)) < len(store)
    assert stats["tokenizer_alarm"] == "" and stats["tokenizer_perplexity"] > 1
    kept = [json.loads(line)["tokenizer/psnr"] for line in (tmp_path / "tokenizer/metrics.jsonl").open()]
    rows = [json.loads(line)["text_world/loss"] for line in (tmp_path / "metrics.jsonl").open()]
    assert sum(kept[-5:]) > sum(kept[:5]) + 10 and sum(rows[-5:]) < 0.8 * sum(rows[:5])
    first = store.frames(store.start[:2])
    golden = model.imagine(first, [INSTRUCTION] * 2, torch.arange(2))
    assert golden.frames.shape[0] == 2 and golden.frames.shape[1] <= 3


def test_clips_rest_at_the_end_where_the_task_is_done(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    good = store.select(succeeded=True)
    clips = SuccessfulClips(store, good, frames=8, stride=3).sample(64, torch.Generator().manual_seed(0))
    assert clips["frames"].shape[:2] == (64, 8) and clips["valid"].all()
    assert bool((clips["success"][:, -1] == 1).all()) and bool((clips["success"][:, 0] == 0).any())
    assert torch.equal(clips["frames"][:, -1], clips["frames"][:, -2])


def test_data_without_successes_are_refused(tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(ARM_DELTAS)
    failed = store.select(succeeded=False)
    with pytest.raises(ValueError, match="no episode of the data is labelled a success"):
        train_text_world(world(), store, failed, 1, FitConfig(1, 1, 1e-3), tmp_path)
