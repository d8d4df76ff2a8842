"""An imagined world on disk, for hosts to be built from."""

from __future__ import annotations

from typing import Any

import pytest

from actors.rollouts.recipe import Recipe
from pipeline.commands.demo_world import demo_recipe
from pipeline.config import load_config


@pytest.fixture(scope="session")
def cfg() -> dict[str, Any]:
    """The smoke experiment on Ray, on more CPUs than there may be."""
    return load_config(["experiment=smoke", "launch=ray", "launch.cpus=8", "launch.object_store_mb=200"])


@pytest.fixture(scope="session")
def recipe(cfg: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Recipe:
    """An imagined world of untrained networks: what it shows is poor, but it shows the same to everybody."""
    return demo_recipe(cfg, tmp_path_factory.mktemp("world"), 4, starts=8)
