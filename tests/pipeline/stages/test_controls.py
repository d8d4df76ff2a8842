"""Filtered BC learns as the first policy of the loop does, from more."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from safetensors.torch import load_file

from envs.embodiment import Embodiment
from pipeline.config import load_config
from pipeline.graph.stage import Inputs
from pipeline.stages.controls import filtered_bc
from pipeline.stages.given import DATASETS
from pipeline.stages.imitation import imitation
from tests.embodiments import ARM_DELTAS

SQUARE = ("task=lerobot", "task.size=[32,32]", "task.chunk=4", "task.horizon=12", "task.mode=absolute")
SHORT = tuple(f"imitation.{part}.steps=2" for part in ("perception", "fit"))


def test_without_own_successes_filtered_bc_is_the_first_policy(
    tiny_data: Callable[[Embodiment], Path], tmp_path: Path
) -> None:
    data = tiny_data(ARM_DELTAS)
    words = ("experiment=smoke", "imitation.sources=['*']", f"task.data=[{data}]", "launch.device=cpu")
    cfg = load_config([*words, *SQUARE, *SHORT])
    gathered = tmp_path / "recordings"
    gathered.mkdir()
    (gathered / DATASETS).write_text(f'["{data}"]')
    weights, results = {}, {}
    for stage in (imitation, filtered_bc):
        folder = tmp_path / stage.run.__name__
        folder.mkdir()
        view = stage.view(stage.run.__name__, cfg, {})
        results[stage] = stage.run(view, folder, Inputs({"data": (gathered,)}))
        weights[stage] = load_file(folder / "weights.safetensors")
    assert "perception_samples_per_second" in results[filtered_bc]
    assert results[filtered_bc]["own_successes"] == 0
    same = [torch.equal(value, weights[imitation][name]) for name, value in weights[filtered_bc].items()]
    assert all(same)
