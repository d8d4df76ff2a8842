"""Adapters learn, the rest stays, and the end is a network under its old names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from learners.stages.simulator import SimulatorFitConfig, train_simulator
from learners.training.fit import FitConfig
from learners.training.lora import TARGETS
from tests.embodiments import ARM_DELTAS
from tests.learners.models import simulator_of

Stores = Callable[[Embodiment], ClipStore]
ADAPTERS = SimulatorFitConfig(single_chunk_fraction=1.0, unroll=1, strides=(1,), recent_fraction=0.0, lora=2)


def test_adapters_learn_and_are_folded_in(tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(ARM_DELTAS)
    world = simulator_of("dit_small", store.spec)
    before = {name: value.clone() for name, value in world.state_dict().items()}
    learning = {name: p.requires_grad for name, p in world.named_parameters()}
    options = FitConfig(4, 2, 1e-2, warmup=1, bf16=False)
    train_simulator(world, store, torch.arange(4), ADAPTERS, options, tmp_path, fresh=False)
    after = world.state_dict()
    assert list(after) == list(before)
    assert {name: p.requires_grad for name, p in world.named_parameters()} == learning
    changed = {name for name in after if not torch.equal(after[name], before[name])}
    assert changed and all(name.removesuffix(".weight").endswith(TARGETS) for name in changed)
    name = sorted(changed)[0]
    assert int(torch.linalg.matrix_rank(after[name] - before[name], tol=1e-4)) <= 2


def test_only_transformers_take_adapters(tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(ARM_DELTAS)
    world = simulator_of("unet_small", store.spec)
    with pytest.raises(ValueError, match="lora=2 adapts the projections of transformers"):
        train_simulator(
            world, store, torch.arange(2), ADAPTERS, FitConfig(1, 2, 1e-3, bf16=False), tmp_path, fresh=False
        )
