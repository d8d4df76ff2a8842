"""Shared fixtures: material outside the repository, and small data made once per session."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from envs.episodes import Episode, LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.physics.pool import BenchPool
from envs.physics.tabletop.bench import BenchConfig
from envs.simulators.base import WorldShape
from envs.simulators.unet.engine import UNetConfig, UNetSimulator

BENCH = BenchConfig()
HORIZON = 16


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with real episodes and golden outputs, beside the repository or at $WORLDLOOP_SHARED."""
    path = Path(os.environ.get("WORLDLOOP_SHARED", Path(__file__).resolve().parent.parent.parent / "shared"))
    if not (path / "golden").exists():
        pytest.skip(f"{path} is not here; set WORLDLOOP_SHARED")
    return path


@pytest.fixture(scope="session")
def episodes() -> list[Episode]:
    """Eight short true episodes of every behaviour."""
    pool = BenchPool(BENCH, 1, HORIZON, workers=1)
    noise_levels = [0.0, 0.3, 0.6, 1.0] * 2
    names = ["expert", "noisy", "noisy", "random"] * 2
    tracks = pool.script([(seed, noise_level) for seed, noise_level in enumerate(noise_levels)])
    pool.close()
    return [
        Episode.from_track(track, name, BENCH.views, 10.0) for track, name in zip(tracks, names, strict=True)
    ]


@pytest.fixture(scope="session")
def dataset(episodes: list[Episode], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Those episodes as a LeRobot data set of two shards."""
    root = tmp_path_factory.mktemp("data") / "dataset"
    writer = LeRobotWriter(root, BENCH.views, BENCH.size, 10.0)
    writer.write(episodes[:4])
    writer.write(episodes[4:])
    return root


@pytest.fixture(scope="session")
def store(dataset: Path) -> ClipStore:
    """The data set behind its cache."""
    return ClipStore([dataset])


@pytest.fixture
def simulator() -> UNetSimulator:
    """A tiny untrained simulator whose output is not trivial."""
    torch.manual_seed(0)
    model = UNetSimulator(WorldShape(chunk=4), UNetConfig(width=16, blocks=(1, 1)))
    with torch.no_grad():
        for head in model.heads:
            head[-1].weight.normal_(std=0.05)
    return model.eval()
