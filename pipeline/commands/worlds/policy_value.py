"""worldloop policy-value: what an imagined world thinks of policies, beside what they are truly worth.

Each candidate is tried from the first frames of the same held-out episodes: in imagination, several times by
other noise of the simulator, and once in physics, where the episode's seed lays out the same start. Scripted
experts see no pictures: what they commanded in the true episode is replayed open loop. Without physics the
true column stays empty.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from actors.factory import build_world
from envs.episodes.clips import ClipStore
from envs.files import write_text
from envs.initial_states import InitialStates
from envs.targets import ConfigError
from pipeline.commands.worlds.subject import WEIGHTS, Subject, mark, weights_at
from pipeline.evaluation.by_task import tasks_of_episodes
from pipeline.evaluation.value.agreement import Cell, agreement
from pipeline.evaluation.value.candidates import Candidate, action_spread, candidates
from pipeline.evaluation.value.page import build_page, table_text
from pipeline.evaluation.value.trials import Imagination, Kept, Physics
from pipeline.graph.code_version import code_of
from pipeline.loop import has_physics
from pipeline.stages import imitation, rl
from pipeline.stages.given import mode_of

_SIDE_BY_SIDE = 64  # imagined episodes
_ACTING = (imitation.imitation, imitation.clone, rl.rl)  # stages that leave a policy
_MODULE = "pipeline.evaluation.value.trials"
OPEN_LOOP = (
    "Scripted experts do not see generated frames: what they commanded in physics is replayed open loop from"
    " the same starts."
)


def policy_value(cfg: Mapping[str, Any], root: Path) -> str:
    """Estimate values; writes policy-value.json and policy-value.html into the run's folder.

    Returns:
        The table, as Markdown.

    Raises:
        ConfigError: if what is named is not there, or there is nothing to compare.
    """
    subject, section = Subject.of(cfg, root), cfg["policy_value"]
    physics_there = has_physics(cfg)
    given = policies_of(subject)
    everybody = candidates(given, section["noise"], section["experts"] if physics_there else ())
    store = subject.store()
    starts = starts_of(cfg, subject, store)
    spread, kept = action_spread(store, mode_of(cfg)), Kept(root / "policy-value")
    world = {**subject.identity("simulator", "state", "judge"), **_task(cfg), "code": _code(cfg)}
    physics = Physics(cfg, {**_task(cfg), "code": _code(cfg)}, kept, spread) if physics_there else None
    simulator = subject.simulator()
    parts = (simulator, subject.decoder(simulator), subject.judge())
    # repeats are to draw other noise, whatever the run's episodes share
    drawn = {**cfg, "simulator": {**cfg["simulator"], "shared_noise": False}}
    cells: list[Cell] = []
    with tqdm(
        total=len(starts) * len(everybody), desc="policy-value", unit="cell", dynamic_ncols=True
    ) as bar:
        try:
            for task, episodes in starts.items():
                seeds = [int(store.episodes[n]["seed"] or 0) for n in episodes.tolist()]
                first = InitialStates.of(store, episodes)
                env = build_world(drawn, *parts, first, min(_SIDE_BY_SIDE, len(episodes)))
                where = {"data": [str(path) for path in subject.data], "episodes": episodes.tolist()}
                imagination = Imagination(cfg, env, {**world, **where}, kept, spread)
                for candidate in everybody:
                    about = identity_of(candidate, section, spread)
                    true = physics.outcome(candidate, about, seeds) if physics else None
                    made = [
                        imagination.outcome(candidate, about, repeat, true)
                        for repeat in range(section["repeats"])
                    ]
                    cells.append(
                        Cell(
                            candidate.name,
                            task,
                            candidate.inside,
                            torch.stack([one["success"] for one in made]),
                            torch.stack([one["judged"] for one in made]),
                            true["success"] if true else None,
                        )
                    )
                    bar.update()
        finally:
            if physics:
                physics.close()
    result = {
        **subject.about(),
        "starts": {task: len(episodes) for task, episodes in starts.items()},
        "repeats": section["repeats"],
        "cells": [cell.row() for cell in cells],
        "agreement": agreement(cells),
        "notes": notes(section, starts, everybody, cells),
    }
    write_text(root / "policy-value.json", json.dumps(result, indent=1))
    write_text(root / "policy-value.html", build_page(result))
    return f"{table_text(result)}\n{kept.reused} parts were reused"


def policies_of(subject: Subject) -> dict[str, tuple[Mapping[str, Any], Path | None]]:
    """Section and weights of the policies that policy_value.policies and policy_value.others name, by name.

    Raises:
        ConfigError: if weights are not there.
    """
    cfg, graph = subject.cfg, subject.graph
    section = cfg["policy_value"]
    names = list(section["policies"]) or [
        name
        for name, node in graph.nodes.items()
        if node.stage in _ACTING and (graph.folder(name) / WEIGHTS).is_file()
    ]
    short = {name: name if name in graph.nodes else Path(name).stem for name in names}
    if len(set(short.values())) < len(names):
        short = {name: name for name in names}
    found: dict[str, tuple[Mapping[str, Any], Path | None]] = {
        short[name]: (cfg["policy"], weights_at(graph, name, "policy_value.policies")) for name in names
    }
    for name, other in (section["others"] or {}).items():
        own = {key: value for key, value in other.items() if key != "weights"}
        key = f"policy_value.others.{name}"
        if name in found:
            raise ConfigError(f"{key}: policy_value.policies has that name already; choose another")
        weights = weights_at(graph, other["weights"], f"{key}.weights") if other.get("weights") else None
        found[name] = (own, weights)
    return found


def starts_of(cfg: Mapping[str, Any], subject: Subject, store: ClipStore) -> dict[str, Tensor]:
    """Numbers int64 [N] of held-out episodes by task, policy_value.starts of each at most."""
    held = subject.held_out(store)
    tasks = tasks_of_episodes(cfg, store, held)
    mine = {task: held[torch.tensor([one == task for one in tasks])] for task in sorted(set(tasks))}
    return {task: episodes[: cfg["policy_value"]["starts"]] for task, episodes in mine.items()}


def identity_of(candidate: Candidate, section: Mapping[str, Any], spread: Tensor) -> dict[str, Any]:
    """What tells a candidate's behaviour from others'; names are none of it."""
    about = {key: value for key, value in asdict(candidate).items() if key not in ("name", "weights")}
    weights = "" if candidate.weights is None else mark(candidate.weights)
    unit = [round(value, 6) for value in spread.tolist()] if candidate.noise else []
    return {**about, "weights": weights, "stochastic": section["stochastic"], "spread": unit}


def notes(
    section: Mapping[str, Any],
    starts: Mapping[str, Tensor],
    everybody: list[Candidate],
    cells: list[Cell],
) -> list[str]:
    """What must be known to read the table."""
    out = []
    if any(one.expert is not None for one in everybody):
        out.append(OPEN_LOOP)
    if cells[0].true is None:
        out.append(
            "There is no physics here: nobody knows the true values, and scripted experts are left out."
        )
    if any(one.noise for one in everybody):
        out.append("Noise is in units of each number's standard deviation in recorded chunks.")
    if section["repeats"] > 1 and not any(cell.error for cell in cells):
        out.append(
            "All repeats came out alike: neither this simulator nor these policies draw anything, so standard"
            " errors of 0 say nothing."
        )
    few = {task: len(some) for task, some in starts.items() if len(some) < section["starts"]}
    if few:
        out.append(f"Fewer held-out starts than policy_value.starts={section['starts']}: {few}.")
    return out


def _task(cfg: Mapping[str, Any]) -> dict[str, Any]:
    task = {key: cfg["task"].get(key) for key in ("suite", "name", "size", "chunk", "horizon", "mode")}
    return {"task": task, "seed": cfg["seed"]}


def _code(cfg: Mapping[str, Any]) -> dict[str, str]:
    sections = {name: cfg[name] for name in ("simulator", "judge", "policy")}
    return code_of(
        _MODULE, {**sections, "suite": cfg["task"].get("suite"), **(cfg["policy_value"]["others"] or {})}
    )
