"""The RL stage in two processes under Ray Train, fed by a Ray actor, writes what one process writes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import ray
import torch
from safetensors.torch import load_file

from envs.targets import ConfigError
from pipeline.commands.demo_world import demo_recipe
from pipeline.config import load_config
from pipeline.graph.stage import Inputs
from pipeline.graph.workers import run_stage
from pipeline.loop import build_loop
from pipeline.stages import prove, rl

WORDS = [
    "experiment=smoke",
    "launch=ray",
    "microbatches=2",
    "launch.cpus=4",
    "launch.object_store_mb=200",
    "launch.learners=2",
    "threads=1",
    "rl.shards=1",
    "imitation.demos=3",
    "evaluate.episodes=4",
    "evaluate.envs=4",
]


@pytest.fixture
def cluster() -> Iterator[None]:
    yield
    ray.shutdown()


def losses(folder: Path, name: str) -> list[float]:
    return [json.loads(line)[name] for line in (folder / "metrics.jsonl").read_text().splitlines()]


@pytest.mark.long
def test_two_learners_and_an_evaluator_do_what_one_process_does(cluster: None, tmp_path: Path) -> None:
    cfg: dict[str, Any] = load_config([*WORDS, "rl.epochs=1", "launch.actors=1"])
    recipe = demo_recipe(cfg, tmp_path / "world", cfg["rl"]["envs"])
    folders = {
        role: Path(path).parent
        for role, path in (
            ("policy", recipe.policy),
            ("simulator", recipe.simulator),
            ("state", recipe.decoder),
            ("judge", recipe.judge),
        )
    }
    settings = {"number": 1, "iterations": 1}
    inputs = Inputs({**folders, "data": (Path(recipe.data[0]).parent,)}, settings)
    alone, both = tmp_path / "alone", tmp_path / "both"
    for folder in (alone, both):
        folder.mkdir()
    single = load_config([*WORDS, "rl.epochs=1", "launch.actors=1", "launch.learners=1"])
    one = run_stage(rl.rl, "rl", single, alone, inputs)
    two = run_stage(rl.rl, "rl", cfg, both, inputs)
    assert two.keys() == one.keys()
    assert losses(both, "rl/loss") == pytest.approx(losses(alone, "rl/loss"), rel=1e-3, abs=1e-5)
    weights = load_file(alone / "weights.safetensors")
    for name, value in load_file(both / "weights.safetensors").items():
        torch.testing.assert_close(value, weights[name], rtol=1e-3, atol=2e-4)
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir(), there.mkdir()
    policy = Inputs({"policy": folders["policy"]})
    cfg = {**cfg, "threads": 2}  # Ray would have it computed with one
    placed = run_stage(prove.evaluate_physics, "evaluate", cfg, there, policy)
    local = {**cfg, "launch": {**cfg["launch"], "backend": "local"}}
    near = run_stage(prove.evaluate_physics, "evaluate", local, here, policy)
    assert placed["successes"] == near["successes"]
    one_by_one = [torch.load(folder / "outcomes.pt", weights_only=True) for folder in (here, there)]
    assert torch.equal(one_by_one[0]["progress"], one_by_one[1]["progress"])  # to the last bit


def test_microbatches_must_fit_the_learners(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="microbatches=2"):
        build_loop(load_config([*WORDS, "microbatches=1"]), tmp_path)
