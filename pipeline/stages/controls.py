"""Stages of `worldloop controls` that the loop itself has not: the same data without a simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import POLICY, Cfg, demonstrations, learning_episodes, open_store
from pipeline.stages.imitation import cloned


@stage(reads=(*POLICY, "imitation", "microbatches"), place=Place.LEARNERS)
def filtered_bc(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """A policy from nothing, trained as the stage imitation trains the first one, on the demonstrations and
    every success of the deployed policies.
    """
    store = open_store(cfg, inputs)
    demos = demonstrations(cfg, store)
    own = store.select(["policy-*"], succeeded=True)
    own = own[torch.isin(own, learning_episodes(store))]
    stats = cloned(cfg, folder, store, torch.cat([demos, own]))
    return {**stats, "demos": len(demos), "own_successes": len(own)}
