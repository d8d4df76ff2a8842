"""Adapters learn, the rest stays, and the end is a network under its old names; augmentation spoils memory
alone.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from envs.episodes.clips import ClipStore
from envs.simulators.base import WorldShape
from envs.simulators.dit.augment import augment_memory_frames, augment_memory_latents, chosen_clips
from envs.simulators.dit.engine import DiTConfig, DiTSimulator
from envs.simulators.state_experts.flow import disturb_history
from envs.simulators.unet.engine import UNetSimulator
from learners.stages.vision import VisionConfig, train_vision
from learners.training.fit import FitConfig


def test_adapters_learn_and_are_folded_in(store: ClipStore, tmp_path: Path) -> None:
    torch.manual_seed(0)
    world = DiTSimulator(
        WorldShape(chunk=4), DiTConfig(layers=3, heads=2, adaln_rank=8, codec_width=16, steps=2)
    )
    before = {name: value.clone() for name, value in world.state_dict().items()}
    train_vision(
        world,
        store,
        torch.arange(4),
        VisionConfig(alone=1.0, unroll=1, lora=2),
        FitConfig(4, 2, 1e-2, warmup=1, bf16=False),
        tmp_path,
    )
    after = world.state_dict()
    assert list(after) == list(before) and all(p.requires_grad for name, p in world.named_parameters())
    changed = {name for name in after if not torch.equal(after[name], before[name])}
    assert changed and all(
        any(part in name for part in ("attn1", "attn2", "ff", "draft.")) for name in changed
    )
    delta = (
        after["net.transformer_blocks.0.attn1.to_q.weight"]
        - before["net.transformer_blocks.0.attn1.to_q.weight"]
    )
    assert int(torch.linalg.matrix_rank(delta, tol=1e-4)) <= 2


def test_only_transformers_take_adapters(simulator: UNetSimulator, store: ClipStore, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="adapts transformers"):
        train_vision(
            simulator, store, torch.arange(2), VisionConfig(lora=2), FitConfig(1, 2, bf16=False), tmp_path
        )


def test_memory_augmentation_spoils_chosen_clips_alone_and_all_views_alike() -> None:
    generator = torch.Generator().manual_seed(3)
    frames = torch.rand(64, 4, 3, 3, 16, 16)
    chosen = chosen_clips(64, 0.5, generator)
    spoilt = augment_memory_frames(frames, chosen, generator)
    assert torch.equal(spoilt[~chosen], frames[~chosen]) and spoilt.min() >= 0 and spoilt.max() <= 1
    assert 0.3 < (spoilt[chosen] != frames[chosen]).flatten(1).any(1).float().mean() < 0.95
    grey = torch.full((64, 2, 3, 3, 16, 16), 0.5)
    shifted = augment_memory_frames(grey, torch.ones(64, dtype=torch.bool), generator)
    assert torch.equal(shifted[:, 0, 0], shifted[:, 1, 2])  # one shift for all views and frames of a clip
    latents = torch.randn(64, 3, 16, 4, 2, 2)
    noisy = augment_memory_latents(latents, chosen, generator)
    assert torch.equal(noisy[~chosen], latents[~chosen]) and 0.02 < (noisy - latents)[chosen].std() < 0.4


def test_history_is_shifted_and_smoothed() -> None:
    past = torch.arange(8.0)[None, :, None].expand(256, -1, 2)
    out = disturb_history(past, torch.Generator().manual_seed(0))
    assert out.shape == past.shape and out.min() >= 0 and out.max() <= 7
    same = (out == past).flatten(1).all(1).float().mean()
    assert 0.15 < same < 0.35  # neither, by chance a quarter
