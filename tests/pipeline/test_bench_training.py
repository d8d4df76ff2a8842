"""What was released frozen learns, and learned weights are a better beginning; the benchmarks' own code at
few steps.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from actors.factory import ConfigError
from pipeline.benches.training import overfit, pretrained
from pipeline.config import load_config


@pytest.mark.slow
def test_vision_adapters_and_states_learn_a_recording(shared: Path) -> None:
    found = overfit(
        load_config(
            ["simulator=gesim", f"finetune.data=[{shared / 'data/gesim_v2'},{shared / 'data/bridge'}]"]
        ),
        steps=40,
    )
    for part, share in (("vision", 0.8), ("adapters", 1.0), ("state", 0.7)):
        assert found[f"{part}_after"] < share * found[f"{part}_before"], (part, found)


@pytest.mark.slow
def test_learned_weights_are_a_better_beginning() -> None:
    found = pretrained(
        load_config(["experiment=smoke", "simulator=dit_small"]), learned=80, steps=20, seeds=(0,)
    )
    assert found["from learned weights"][0] < found["from nothing"][0]


def test_overfit_wants_two_folders() -> None:
    with pytest.raises(ConfigError, match="bench overfit finetune"):
        overfit(load_config(["simulator=gesim"]))
