"""worldloop evaluate: the success of any policy in physics or in a run's imagined world."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from actors.factory import at_once, build_physics, build_policy
from actors.rollouts.evaluate import Outcome, evaluate
from envs.files import write_json
from envs.rng import Purpose, episode_seeds
from envs.targets import ConfigError
from pipeline.evaluation.by_task import by_task, tasks_of_episodes, tasks_of_seeds, unseen_first, variant_of
from pipeline.evaluation.result import OUTCOMES
from pipeline.evaluation.statistics import mcnemar, points_line, rate_entry, rate_line
from pipeline.graph.graph import Graph
from pipeline.graph.stage import WEIGHTS
from pipeline.loop import build_loop
from pipeline.stages.given import load_world, open_store

Cfg = Mapping[str, Any]
_WORLDS = ["imagined", "physics"]
_SIDE_BY_SIDE = 64  # imagined episodes
_FIRST = "evaluate-before"


def evaluate_policy(
    cfg: Mapping[str, Any], root: Path, weights: str = "", world: str = "physics", variant: str = ""
) -> str:
    """Successes of episodes, with their interval, in one line, and one more for each of several tasks; in
    physics also beside the run's first policy, where its stage has tried that on the same episodes. What came
    of each episode is kept in evaluations/<policy>-<world>[-<variant>].json of the run's folder.

    Args:
        cfg: the resolved config.
        root: the run's folder.
        weights: a stage of the run, or a folder with weights; "" evaluates the policy as it is built.
        world: physics or imagined; the latter is the one that the run's last RL learned in.
        variant: one of task.variants, in physics; "" for the task as it is.

    Raises:
        ConfigError: for unknown weights, worlds and variants.
    """
    graph = build_loop(cfg, root)
    cfg = graph.cfg  # of the world that is acted in
    if world not in _WORLDS:
        raise ConfigError(f"world={world!r} must be one of {_WORLDS}")
    changes = variant_of(cfg, variant)
    if variant and world != "physics":
        raise ConfigError(f"variant={variant} is known in physics alone; leave world={world} out")
    actor = build_policy(cfg, _weights(graph, root, weights) if weights else None)
    env, seeds, tasks = _physics(cfg, changes) if world == "physics" else _imagined(cfg, graph)
    try:
        outcome = evaluate(env, actor, seeds, label=world)
    finally:
        env.close()
    name = f"{weights or cfg['policy']['_target_']} in {world}{', ' if variant else ''}{variant}"
    parts = by_task(tasks, _line, outcome.success, outcome.counted)
    lines = [f"{name}: {_line(outcome.success, outcome.counted)}"]
    lines += [f"  {task}: {line}" for task, line in parts.items()]
    if world == "physics" and not variant:
        lines += _beside_first(graph, seeds, outcome)
    kept = (
        root
        / "evaluations"
        / f"{'-'.join([_slug(weights or 'built'), world, *filter(None, [variant])])}.json"
    )
    rows = zip(seeds, tasks, outcome.success.tolist(), outcome.counted.tolist(), strict=True)
    each = [dict(zip(("seed", "task", "success", "counted"), row, strict=True)) for row in rows]
    about = {"policy": weights or cfg["policy"]["_target_"], "world": world, "variant": variant}
    write_json(kept, {**about, **rate_entry(outcome.success[outcome.counted]), "each": each})
    return "\n".join([*lines, str(kept)])


def _weights(graph: Graph, root: Path, name: str) -> Path:
    """The file with the weights of a stage of the run, or of a folder.

    Raises:
        ConfigError: for a stage that has not been run with these options.
    """
    if name not in graph.nodes:
        return Path(name) / WEIGHTS
    file = graph.folder(name) / WEIGHTS
    if not file.exists():
        raise ConfigError(
            f"policy={name}: {root} holds none of these options and this code yet (`worldloop stages` says"
            f" why); first `worldloop stage {name}` with the same options"
        )
    return file


def _slug(name: str) -> str:
    """A name of a file for a stage or a folder."""
    return re.sub(r"[^\w.-]+", "-", name).strip("-")


def _beside_first(graph: Graph, seeds: list[int], outcome: Outcome) -> list[str]:
    """A line on the policy that RL began with, if its stage has played the same episodes."""
    if not graph.finished(_FIRST):
        return []
    first = torch.load(graph.folder(_FIRST) / OUTCOMES, weights_only=True)
    if first["seeds"].tolist() != seeds:
        return []
    both = first["counted"] & outcome.counted
    before, after = first["success"][both], outcome.success[both]
    found = mcnemar(before, after)
    gain = points_line(float(after.float().mean() - before.float().mean()))
    return [
        f"  beside the first policy on the same {int(both.sum())} episodes: {gain} points,"
        f" p {found['p']:.2g} ({found['gained']} won, {found['lost']} lost)"
    ]


def _line(success: Tensor, counted: Tensor) -> str:
    return f"{rate_line(rate_entry(success[counted]))}, {int((~counted).sum())} dropped"


def _physics(cfg: Cfg, changes: Cfg) -> tuple[Any, list[int], list[str]]:
    section = cfg["evaluate"]
    seeds = episode_seeds(cfg["seed"], Purpose.EVALUATE, section["episodes"])
    return (
        build_physics(cfg, at_once(cfg, section["envs"]), changes=changes),
        seeds,
        tasks_of_seeds(cfg, seeds),
    )


def _imagined(cfg: Cfg, graph: Graph) -> tuple[Any, list[int], list[str]]:
    inputs = graph.inputs("evaluate-imagined")
    store = open_store(cfg, inputs)
    starts = unseen_first(cfg, store, store.select(), cfg["evaluate"]["imagined"])
    world = load_world(cfg, inputs, store, min(_SIDE_BY_SIDE, len(starts)), starts)
    return world, list(range(len(starts))), tasks_of_episodes(cfg, store, starts)
