"""Learned weights are a better beginning; the benchmarks' own code at few steps."""

from __future__ import annotations

import pytest

from envs.targets import ConfigError
from pipeline.benches.training import overfit, pretrained
from pipeline.config import load_config


@pytest.mark.slow
def test_learned_weights_are_a_better_beginning() -> None:
    found = pretrained(
        load_config(["experiment=smoke", "simulator=dit_small"]), learned=80, steps=20, seeds=(0,)
    )
    assert found["from learned weights"][0] < found["from nothing"][0]


def test_overfit_wants_recordings() -> None:
    with pytest.raises(ConfigError, match=r"task\.data"):
        overfit(load_config([]))
