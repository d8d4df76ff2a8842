"""Stages of `worldloop finetune`: a simulator, its student and its state expert on recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from actors.factory import build_simulator, build_state_decoder, open_clips
from actors.process import prepare_process
from envs.targets import options
from learners.stages.simulator import SimulatorFitConfig, train_simulator
from learners.stages.state import train_state
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import TASK, Cfg, fit_options
from pipeline.stages.world import distil

_READS = ("seed", "threads", *TASK, "simulator", "microbatches")


@stage(reads=(*_READS, "finetune.simulator", "finetune.weights"), place=Place.LEARNERS)
def simulator(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The simulator, all of it or its adapters, from finetune.weights or as simulator.checkpoint has it.

    Settings: fingerprint of the data.
    """
    section, weights = dict(cfg["finetune"]["simulator"]), cfg["finetune"]["weights"]
    fit = fit_options(cfg, section.pop("fit"), "finetune.simulator.fit")
    how = options(SimulatorFitConfig, section, "finetune.simulator")
    store = open_clips(cfg, cfg["task"]["data"])
    prepare_process(cfg["seed"], cfg["threads"])
    model = build_simulator(cfg, Path(weights) if weights else None)
    fresh = not (weights or cfg["simulator"].get("checkpoint"))
    stats = train_simulator(model, store, torch.arange(len(store)), how, fit, folder, fresh=fresh)
    save_weights(model, folder)
    return dict(stats)


@stage(reads=(*_READS, "distill.steps", "distill.method", "distill.first"), place=Place.LEARNERS)
def student(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The few-step student of that simulator, as section distill says.

    Settings: fingerprint of the data.
    """
    store = open_clips(cfg, cfg["task"]["data"])
    return distil(cfg, folder, inputs, "distill.first", store, torch.arange(len(store)))


@stage(reads=(*_READS, "finetune.state"), place=Place.LEARNERS)
def state(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The state expert on that simulator, which stays as it is.

    Settings: fingerprint of the data.
    """
    section = cfg["finetune"]["state"]
    store = open_clips(cfg, cfg["task"]["data"])
    prepare_process(cfg["seed"], cfg["threads"])
    model = build_simulator(cfg, inputs.weights("simulator"))
    decoder = build_state_decoder(cfg, model)
    fit = fit_options(cfg, section["fit"], "finetune.state.fit")
    stats = train_state(decoder, model, store, torch.arange(len(store)), fit, folder, section["lora"])
    save_weights(decoder, folder)
    return dict(stats)
