"""An imagined world on disk, for hosts to be built from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from actors.factory import build_judge, build_policy, build_simulator, build_state_decoder
from actors.recipe import Recipe
from pipeline.artefact import save_weights
from pipeline.config import load_config


@pytest.fixture(scope="session")
def cfg() -> dict[str, Any]:
    """The smoke experiment on Ray, on more CPUs than there may be."""
    return load_config(["experiment=smoke", "launch=ray", "launch.cpus=8", "launch.object_store_mb=200"])


@pytest.fixture(scope="session")
def recipe(cfg: dict[str, Any], dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Recipe:
    """An imagined world of untrained networks: what it shows is poor, but it shows the same to everybody."""
    torch.manual_seed(0)
    root = tmp_path_factory.mktemp("weights")
    simulator = build_simulator(cfg)
    parts = {"policy": build_policy(cfg), "simulator": simulator, "decoder": build_state_decoder(cfg, simulator), "judge": build_judge(cfg)}
    paths = {}
    for name, module in parts.items():
        (root / name).mkdir()
        save_weights(module, root / name)
        paths[name] = str(root / name / "weights.safetensors")
    return Recipe(cfg, 4, paths["policy"], paths["simulator"], paths["decoder"], paths["judge"], (str(dataset),), freeze_perception=True, threads=1)
