"""Learned weights are a better beginning; the benchmarks' own code at few steps."""

from __future__ import annotations

import math

import pytest

from envs.targets import ConfigError
from pipeline.benches.training import overfit, pretrained
from pipeline.config import load_config

SMALL = ["experiment=soak", "task.suite.cameras=[head]"]


@pytest.mark.long
def test_learned_weights_are_a_better_beginning() -> None:
    found = pretrained(load_config(SMALL), learned=80, steps=10, seeds=(0,))
    assert found["from learned weights"][0] < found["from nothing"][0] - 0.01


@pytest.mark.long
def test_latent_worlds_share_an_autoencoder() -> None:
    found = pretrained(load_config([*SMALL, "simulator=dit_small"]), learned=3, steps=1, seeds=(0,))
    assert all(math.isfinite(loss) for losses in found.values() for loss in losses)


def test_overfit_wants_recordings() -> None:
    with pytest.raises(ConfigError, match=r"task\.data"):
        overfit(load_config([]))
