"""The stage that teaches joint states: what it looks at, and that it learns."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.simulators.state_experts.head import StateHead
from envs.simulators.unet.engine import UNetSimulator
from learners.stages.state import train_state
from learners.training.fit import FitConfig


def test_a_decoder_looks_once_and_learns(
    simulator: UNetSimulator, store: ClipStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = []
    features = simulator.features

    def counted(inputs: TensorDict) -> Tensor:
        shown.append(len(inputs))
        return features(inputs)

    monkeypatch.setattr(simulator, "features", counted)
    torch.manual_seed(0)
    head = StateHead(simulator.feature_shape[0], simulator.shape.chunk, simulator.shape.memory)
    head.normalise(store.arrays["states"])
    train_state(
        head,
        simulator,
        store,
        torch.arange(len(store)),
        FitConfig(steps=100, batch=32, lr=3e-3, bf16=False),
        tmp_path,
    )
    assert sum(shown) == 1 + 200  # one to know its size; of the 3200 clips that were learned from
    monkeypatch.setattr("learners.stages.state._KEPT", 1000)  # of a simulator that says more than can be kept
    shown.clear()
    train_state(
        head,
        simulator,
        store,
        torch.arange(len(store)),
        FitConfig(steps=3, batch=32, lr=3e-3, bf16=False),
        tmp_path / "anew",
    )
    assert sum(shown) == 1 + 3 * 32
    losses = [
        json.loads(line)["state/loss"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()
    ]
    assert sum(losses[-5:]) < 0.5 * sum(losses[:5])
    assert all(parameter.requires_grad for parameter in simulator.parameters())
