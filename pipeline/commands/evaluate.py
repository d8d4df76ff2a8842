"""worldloop evaluate: the success of any policy in physics or in a run's imagined world."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from actors.factory import build_physics, build_policy
from actors.rollouts.evaluate import evaluate
from envs.rng import Purpose, episode_seeds
from envs.targets import ConfigError
from pipeline.evaluation.statistics import rate_entry, rate_line
from pipeline.graph.graph import Graph
from pipeline.loop import build_loop
from pipeline.stages.given import load_world, open_store

_SIDE_BY_SIDE = 64  # imagined episodes


def evaluate_policy(cfg: Mapping[str, Any], root: Path, weights: str = "", world: str = "physics") -> str:
    """One line: successes of episodes, with their interval.

    Args:
        cfg: the resolved config.
        root: the run's folder.
        weights: a stage of the run, or a folder with weights; "" evaluates the policy as it is built.
        world: physics or imagined; the latter is the one that the run's last RL learned in.

    Raises:
        ConfigError: for unknown weights and worlds.
    """
    graph = build_loop(cfg, root)
    cfg = graph.cfg  # of the world that is acted in
    if world not in _WORLDS:
        raise ConfigError(f"world={world!r} must be one of {sorted(_WORLDS)}")
    folder = graph.folder(weights) if weights in graph.nodes else Path(weights)
    actor = build_policy(cfg, folder / "weights.safetensors" if weights else None)
    env, seeds = _WORLDS[world](cfg, graph)
    try:
        outcome = evaluate(env, actor, seeds, label=world)
    finally:
        env.close()
    line = rate_line(rate_entry(outcome.success[outcome.counted]))
    name, dropped = weights or cfg["policy"]["_target_"], int((~outcome.counted).sum())
    return f"{name} in {world}: {line}, {dropped} dropped"


def _physics(cfg: Mapping[str, Any], graph: Graph) -> tuple[Any, list[int]]:
    section = cfg["evaluate"]
    seeds = episode_seeds(cfg["seed"], Purpose.EVALUATE, section["episodes"])
    return build_physics(cfg, section["envs"]), seeds


def _imagined(cfg: Mapping[str, Any], graph: Graph) -> tuple[Any, list[int]]:
    inputs = graph.inputs("evaluate-imagined")
    store = open_store(cfg, inputs)
    count = min(cfg["evaluate"]["imagined"], len(store))
    return load_world(cfg, inputs, store, min(_SIDE_BY_SIDE, count)), list(range(count))


_WORLDS = {"physics": _physics, "imagined": _imagined}
