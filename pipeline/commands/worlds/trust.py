"""worldloop trust: how far a run's imagined world tells better actions from worse ones."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from actors.factory import (
    at_once,
    build_judge,
    build_physics,
    build_policy,
    build_simulator,
    build_state_decoder,
    build_world,
)
from actors.policies.safe import SafePolicyWrapper
from envs.files import write_json
from envs.initial_states import DecisionPoints
from envs.rng import order_generator
from envs.targets import ConfigError
from pipeline.commands.worlds.subject import round_inputs
from pipeline.evaluation.trust.branches import Branching, agreement
from pipeline.evaluation.value.estimate import task_of
from pipeline.graph.code_version import code_of
from pipeline.graph.graph import decisive
from pipeline.graph.kept import Kept
from pipeline.graph.stage import Inputs
from pipeline.loop import build_loop, has_physics
from pipeline.markdown import markdown_table
from pipeline.stages.given import open_store

_SIDE_BY_SIDE = 100  # futures

_COLUMNS = ("imagined frames with true", "true frames with outcome", "imagined with outcome")


def trust(cfg: Mapping[str, Any], root: Path, number: int, moments: int, futures: int, depth: int) -> str:
    """A table of correlations (see branches.agreement) for the world and the deployed policy of a round.

    Args:
        cfg: the resolved config.
        root: the run's folder.
        number: of the round; its simulator, state expert, judge, and the policy deployed in it are asked.
        moments, futures: of held-out deployed episodes, and of each moment.
        depth: chunks that are imagined.

    Raises:
        ConfigError: without physics, or if the run has not come so far.
    """
    if not has_physics(cfg):
        raise ConfigError(
            "this task is known from recordings alone, and nobody can try other actions in those"
        )
    graph = build_loop(cfg, root)
    cfg = graph.cfg  # of the world that is acted in
    inputs = round_inputs(graph, root, number, "gap")
    store = open_store(cfg, inputs)
    held = store.split("held_out")
    held = held[torch.isin(held, store.select([f"policy-{number}"]))]
    points = DecisionPoints(store, held)
    whole = int(cfg["task"]["horizon"]) // int(cfg["task"]["chunk"])
    some = (points.frame // int(cfg["task"]["chunk"]) <= whole - depth).nonzero().flatten()
    order = torch.randperm(len(some), generator=order_generator(cfg["seed"]))
    which = some[order[:moments]]
    simulator = build_simulator(cfg, inputs.weights("simulator"))
    decoder = build_state_decoder(cfg, simulator, inputs.weights("state"))
    judge = build_judge(cfg, inputs.weights("judge"))
    if judge.reads_features:
        raise ConfigError(
            f"judge={cfg['judge']['_target_']} reads the simulator's features, and true frames, on which"
            " imagination is compared, have none; ask a run whose judge looks at pictures"
        )
    width = at_once(cfg, min(_SIDE_BY_SIDE, len(which) * futures))
    world = build_world(
        *(cfg, simulator, decoder, judge, points, width), horizon=depth * int(cfg["task"]["chunk"])
    )
    physics = build_physics(cfg, width, record=True)
    policy = SafePolicyWrapper(build_policy(cfg, inputs.weights("policy")), physics.spec, physics.mode)
    kept = Kept(root / "trust")
    branching = Branching(world, physics, policy, judge, cfg["seed"], kept, _identity(cfg, inputs))
    try:
        branches = branching.branches(which, futures)
    finally:
        physics.close()
    rows, compared = agreement(branches, cfg["seed"]), len(branches.outcome)
    write_json(root / f"trust-{number}.json", {"moments": compared, "depths": rows})
    return f"{_table(rows, compared, futures)}\n{kept.reused} parts were reused"


def _identity(cfg: Mapping[str, Any], inputs: Inputs) -> dict[str, Any]:
    """What futures of a round depend on, beside which they are."""
    sections = {name: decisive(name, cfg[name]) for name in ("simulator", "judge", "policy")}
    chosen = {**sections, "suite": cfg["task"]["suite"]}
    return {
        # folders of stages are named by all that they hang on, code included
        "stages": {role: [path.name for path in inputs.folders(role)] for role in inputs.found},
        "sections": sections,
        **task_of(cfg),
        "code": {**code_of(Branching.__module__, chosen), **code_of(build_world.__module__, {})},
    }


def _table(rows: list[dict[str, list[float | None]]], moments: int, futures: int) -> str:
    """Markdown; "-" where all futures of each moment are alike."""
    title = f"Correlations among {futures} futures of each of {moments} moments [95% interval]"
    lines = [[f"{number}", *map(_interval, row.values())] for number, row in enumerate(rows, 1)]
    return f"{title}\n\n{markdown_table(['chunks on', *_COLUMNS], lines)}"


def _interval(values: list[float | None]) -> str:
    numbers = [value for value in values if value is not None]
    return "{:.2f} [{:.2f}, {:.2f}]".format(*numbers) if len(numbers) == len(values) else "-"
