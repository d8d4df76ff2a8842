"""Values of policies as an imagined world estimates them, beside their true ones."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from actors.factory import build_judge, build_simulator, build_state_decoder
from actors.process import prepare_process
from envs.files import write_atomically, write_text
from pipeline.evaluation.value.agreement import agreement
from pipeline.evaluation.value.candidates import action_spread, candidates
from pipeline.evaluation.value.estimate import Comparison, starts_of
from pipeline.graph.kept import Kept, Tensors
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import PHYSICS, WORLD, Cfg, datasets, mode_of, open_store
from pipeline.stages.judging.cost import priced

TRUE = "true.pt"  # outcomes by task and candidate
CELLS = "cells.json"
_VALUES = tuple(f"policy_value.{key}" for key in ("noise", "experts", "starts", "stochastic"))


@stage(reads=(*PHYSICS, "evaluate.envs", *_VALUES), place=Place.EVALUATOR)
def true_values(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Success in physics of the role `policy`, of the same under noise on its actions, and of scripted
    experts, from the starts of held-out episodes; no imagined world has a part in it.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    found = _comparison(cfg, inputs).true({}, Kept(folder / "tried"))
    kept: dict[str, dict[str, Tensors]] = {}
    for (task, name), outcome in found.items():
        kept.setdefault(task, {})[name] = outcome
    write_atomically(folder / TRUE, lambda path: torch.save(kept, path))
    return {"cells": len(found)}


@stage(
    reads=(*WORLD, "policy", *_VALUES, "policy_value.repeats", "policy_value.judged"), place=Place.EVALUATOR
)
@priced
def estimated_values(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The same candidates from the same starts in the imagined world of the roles simulator, state and judge,
    and how far these values agree with the role `true`; cells.json has each of them.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    kept: Mapping[str, Mapping[str, Tensors]] = torch.load(inputs.folder("true") / TRUE, weights_only=True)
    true = {(task, name): outcome for task, some in kept.items() for name, outcome in some.items()}
    simulator = build_simulator(cfg, inputs.weights("simulator"))
    parts = (
        simulator,
        build_state_decoder(cfg, simulator, inputs.weights("state")),
        build_judge(cfg, inputs.weights("judge")),
    )
    cells = _comparison(cfg, inputs).imagined(parts, {}, Kept(folder / "tried"), true)
    write_text(folder / CELLS, json.dumps([cell.row() for cell in cells], indent=1))
    return agreement(cells)


def _comparison(cfg: Cfg, inputs: Inputs) -> Comparison:
    """Everybody that is compared, on held-out episodes of the role `data`."""
    store, section = open_store(cfg, inputs), cfg["policy_value"]
    policy = {"policy": (cfg["policy"], inputs.weights("policy"))}
    everybody = candidates(policy, section["noise"], section["experts"])
    spread = action_spread(store, mode_of(cfg))
    starts = starts_of(cfg, store, store.split("held_out"))
    return Comparison(cfg, datasets(inputs.folders("data")), store, starts, everybody, spread)
