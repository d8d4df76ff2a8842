"""The stage that teaches the robot's states: features are computed once, and it learns."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from learners.stages.state import StatePace, _Kept, clips_kept, train_state
from learners.training.fit import FitConfig
from tests.embodiments import ARM_JOINTS, EMBODIMENTS
from tests.learners.models import decoder_of, simulator_of

Stores = Callable[[Embodiment], ClipStore]


@pytest.mark.parametrize("robot", EMBODIMENTS.values(), ids=EMBODIMENTS)
def test_a_state_expert_learns_of_any_robot(robot: Embodiment, tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(robot)
    simulator = simulator_of("unet_small", store.spec)
    decoder = decoder_of("unet_small", simulator)
    options = FitConfig(steps=80, batch=16, lr=3e-3, warmup=5, bf16=False)
    before = {name: value.clone() for name, value in simulator.state_dict().items()}
    train_state(decoder, simulator, store, store.split("train"), options, tmp_path)
    losses = [json.loads(line)["state/loss"] for line in (tmp_path / "metrics.jsonl").open()]
    assert sum(losses[-5:]) < 0.5 * sum(losses[:5])
    assert all(torch.equal(value, before[name]) for name, value in simulator.state_dict().items())
    assert all(parameter.requires_grad for parameter in simulator.parameters())


def test_features_are_computed_once_unless_they_are_too_large(
    tiny_store: Stores, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tiny_store(ARM_JOINTS)
    simulator = simulator_of("unet_small", store.spec)
    shown, features = [], simulator.features

    def counted(inputs: TensorDict) -> Tensor:
        shown.append(len(inputs))
        return features(inputs)

    monkeypatch.setattr(simulator, "features", counted)
    every, options = torch.arange(len(store)), FitConfig(steps=100, batch=32, lr=1e-3, bf16=False)
    told = train_state(decoder_of("unet_small", simulator), simulator, store, every, options, tmp_path)
    assert told["features_clips"] == clips_kept(options, int(told["features_bytes"]), 6000) == 200
    assert sum(shown) == 1 + 200  # one to know its size; of the 3200 clips that were learned from
    shown.clear()
    train_state(
        decoder_of("unet_small", simulator), simulator, store, every, options, tmp_path / "few", clips=20
    )
    assert sum(shown) == 1 + 20  # fewer than a batch
    monkeypatch.setattr("learners.stages.state._KEPT", 1000)  # bytes
    shown.clear()
    options = FitConfig(steps=3, batch=32, lr=1e-3, bf16=False)
    train_state(decoder_of("unet_small", simulator), simulator, store, every, options, tmp_path / "anew")
    assert sum(shown) == 1 + 3 * 32


@pytest.mark.parametrize(
    ("sample_ms", "clip_ms", "fits"),
    [(0.15, 4.0, True), (0.6, 5.0, True), (0.2, 405.0, True), (12.0, 330.0, True), (12.0, 0.0, False)],
)
@pytest.mark.parametrize("seconds", [0.001, 2.0, 54.0, 600.0])
def test_as_many_steps_as_fit_into_the_time_are_taken(
    sample_ms: float, clip_ms: float, fits: bool, seconds: float
) -> None:
    """However slow the simulator, at least half of the time is learned in."""
    cost = StatePace(sample_ms / 1000, clip_ms / 1000, 10 if fits else 2**32)
    options = FitConfig(steps=20, batch=128, lr=1e-3)
    steps, most = cost.within(seconds, options, 6000)

    def taken(steps: int) -> tuple[float, float]:
        clips = clips_kept(replace(options, steps=steps), cost.clip_bytes, most)
        return clips * cost.clip_seconds, 128 * steps * cost.sample_seconds

    assert 1 <= most <= 6000
    features, learning = taken(steps)
    assert features <= max(seconds / 2, cost.clip_seconds)
    if steps > 1:
        assert 0.8 * seconds < features + learning <= seconds
    else:
        assert sum(taken(2)) > seconds


def test_a_slow_simulator_leaves_time_to_learn_in() -> None:
    """As `tokens` on a core, whose state expert had one step of 54 s when a batch of clips was the least."""
    options = FitConfig(steps=20, batch=128, lr=1e-3)
    steps, clips = StatePace(2e-4, 0.405, 10_000).within(54.0, options, 6000)
    assert steps > 500 and clips == 66


def test_what_a_step_costs_is_as_training_tells() -> None:
    options = FitConfig(steps=20, batch=48, lr=1e-3)
    measured = {"features_clips": 100, "features_seconds": 2.0, "features_bytes": 10}
    spent = {"data_seconds": 1.0, "compute_seconds": 8.6}
    assert StatePace.of(options, {**measured, **spent}) == StatePace(0.01, 0.02, 10)


@pytest.mark.parametrize(("features", "at_hand"), [(4, True), (100_000, False)])
def test_few_rows_of_kept_clips_are_picked_without_a_thread(features: int, at_hand: bool) -> None:
    history = TensorDict({"states": torch.rand(10, 3)}, [10])
    clips = TensorDict({"shown": torch.rand(10, features), "history": history}, [10])
    kept = _Kept(clips, 8)
    picked = kept(0, torch.Generator().manual_seed(0))
    same = clips[torch.randint(10, (8,), generator=torch.Generator().manual_seed(0))]
    assert kept.at_hand is at_hand and picked.batch_size == same.batch_size
    assert bool((picked == same).all())


def test_only_transformers_take_adapters(tiny_store: Stores, tmp_path: Path) -> None:
    store = tiny_store(ARM_JOINTS)
    simulator = simulator_of("unet_small", store.spec)
    with pytest.raises(ValueError, match=r"lora=2.*StateHead has none"):
        train_state(
            decoder_of("unet_small", simulator),
            simulator,
            store,
            torch.arange(4),
            FitConfig(1, 2, 1e-3, bf16=False),
            tmp_path,
            lora=2,
        )
