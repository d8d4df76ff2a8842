"""worldloop policy-value: what an imagined world thinks of policies, beside what they are truly worth.

Each candidate is tried from the first frames of the same held-out episodes: in imagination, several times by
other noise of the simulator, and once in physics, where the episode's seed lays out the same start. Scripted
experts see no pictures: what they commanded in the true episode is replayed open loop. Without physics the
true column stays empty.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from envs.files import write_json, write_text
from envs.targets import ConfigError
from pipeline.commands.worlds.subject import Subject, weights_at
from pipeline.evaluation.value.agreement import ALL, Cell, agreement, overall
from pipeline.evaluation.value.candidates import Candidate, action_spread, candidates
from pipeline.evaluation.value.estimate import Comparison, starts_of, task_of
from pipeline.evaluation.value.page import build_page, table_text
from pipeline.graph.code_version import code_of, json_digest
from pipeline.graph.kept import Kept
from pipeline.graph.stage import WEIGHTS
from pipeline.loop import has_physics
from pipeline.stages import imitation, rl
from pipeline.stages.given import mode_of
from pipeline.stages.judging.cost import COST, Spending

_ACTING = (imitation.imitation, imitation.clone, rl.rl)  # stages that leave a policy
_MODULE = "pipeline.evaluation.value.trials"
OPEN_LOOP = (
    "Scripted experts do not see generated frames: what they commanded in physics is replayed open loop from"
    " the same starts."
)


def policy_value(cfg: Mapping[str, Any], root: Path) -> str:
    """Estimate values; writes policy-value.json and policy-value.html into the simulator's folder (see
    pages_of).

    Returns:
        The table, as Markdown, and where it lies.

    Raises:
        ConfigError: if what is named is not there, or there is nothing to compare.
    """
    subject, section = Subject.of(cfg, root), cfg["policy_value"]
    cfg = subject.cfg
    physics_there = has_physics(cfg)
    given = policies_of(subject)
    everybody = candidates(given, section["noise"], section["experts"] if physics_there else ())
    store = subject.store()
    starts = starts_of(cfg, store, subject.held_out(store))
    spread, kept = action_spread(store, mode_of(cfg)), Kept(root / "policy-value")
    comparison = Comparison(cfg, subject.data, store, starts, everybody, spread)
    physics = {**task_of(cfg), "code": _code(cfg)}
    true = comparison.true(physics, kept) if physics_there else {}
    simulator = subject.simulator()
    judge = subject.judge()
    parts = (simulator, subject.decoder(simulator), judge)
    world = {**subject.identity("simulator", "state", "judge"), **physics}
    # by world and judge: others have paid their own
    paid = root / "policy-value" / f"{json_digest(world)}-{COST}"
    with Spending(cfg["judge"], paid) as spending:
        cells = comparison.imagined(parts, world, kept, true)
        cost = spending.total
    result = {
        **subject.about(),
        "judged": section["judged"],
        "judged_by": {**judge.facts(), **comparison.counted},
        "judge_cost": cost,
        "starts": {task: len(episodes) for task, episodes in starts.items()},
        "repeats": section["repeats"],
        "cells": [cell.row() for cell in cells],
        "overall": [cell.row() for cell in overall(cells)],
        "agreement": agreement(cells),
        "notes": notes(section, starts, everybody, cells),
    }
    page = subject.pages / "policy-value.html"
    write_json(page.with_suffix(".json"), result)
    write_text(page, build_page(result))
    return f"{table_text(result)}\n{page}, {page.with_suffix('.json')}\n{kept.reused} parts were reused"


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


def notes(
    section: Mapping[str, Any],
    starts: Mapping[str, Tensor],
    everybody: Sequence[Candidate],
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
    if section["repeats"] > 1 and all(cell.error is None for cell in cells):
        out.append(
            "All repeats came out alike, as where neither the simulator nor the policies draw anything, or"
            " the judge always says the same: there are no standard errors."
        )
    if dropped := sum(int((~cell.judged).sum()) for cell in cells):
        of = sum(cell.judged.numel() for cell in cells)
        out.append(f"{dropped} of {of} imagined episodes could not be judged and are left out.")
    counts = {task: len(some) for task, some in starts.items()}
    if cells[0].true is None:  # words alone tell tasks apart, and all together are bounded
        counts = {ALL: sum(counts.values())}
    few = {task: count for task, count in counts.items() if count < section["starts"]}
    if few:
        out.append(f"Fewer held-out starts than policy_value.starts={section['starts']}: {few}.")
    return out


def _code(cfg: Mapping[str, Any]) -> dict[str, str]:
    sections = {name: cfg[name] for name in ("simulator", "judge", "policy")}
    return code_of(
        _MODULE, {**sections, "suite": cfg["task"].get("suite"), **(cfg["policy_value"]["others"] or {})}
    )
