"""Stages of `worldloop controls` that the loop itself has not: the same data without a simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from actors.factory import build_policy
from actors.process import prepare_process
from learners.stages.imitation import Cloning, train_imitation
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import (
    POLICY,
    Cfg,
    demonstrations,
    fit_options,
    learning_episodes,
    mode_of,
    open_store,
)


@stage(reads=(*POLICY, "imitation", "microbatches"), place=Place.LEARNERS)
def filtered_bc(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """A policy from nothing, cloned from the demonstrations and every success of the deployed policies."""
    store = open_store(cfg, inputs)
    demos = demonstrations(cfg, store)
    own = store.select(["policy-*"], succeeded=True)
    own = own[torch.isin(own, learning_episodes(store))]
    prepare_process(cfg["seed"], cfg["threads"])
    policy = build_policy(cfg)
    fit = fit_options(cfg, cfg["imitation"]["fit"], "imitation.fit")
    stats = train_imitation(Cloning(policy, store, torch.cat([demos, own]), mode_of(cfg)), fit, folder)
    save_weights(policy, folder)
    return {**stats, "demos": len(demos), "own_successes": len(own)}
