"""Stages of `worldloop finetune`: a simulator, its tokenizer, student and state expert on recordings.

Held-out episodes are left out: by those `fidelity` and `policy-value` measure what came of it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from actors.factory import build_simulator, build_state_decoder, open_clips
from actors.process import prepare_process
from envs.targets import options
from learners.stages.film import Film
from learners.stages.simulator import SimulatorFitConfig, train_simulator
from learners.stages.state import train_state
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import TASK, Cfg, fit_options, learning_episodes
from pipeline.stages.world import distil, lacking_strides, train_codec

_READS = ("seed", "threads", *TASK, "simulator", "microbatches")


@stage(reads=(*_READS, "tokenizer_fit"), place=Place.LEARNERS)
def tokenizer(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The autoencoder of a simulator that works on latents or tokens and begins from nothing.

    Settings: fingerprint of the data.
    """
    store = open_clips(cfg, cfg["task"]["data"])
    return train_codec(cfg, folder, inputs, store, learning_episodes(store))


@stage(reads=(*_READS, "finetune.simulator", "finetune.weights"), place=Place.LEARNERS)
def simulator(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The simulator, all of it or its adapters, going on from finetune.weights, from the role `warm` (its
    tokenizer), or from simulator.checkpoint.

    Settings: fingerprint of the data.
    """
    section, weights = dict(cfg["finetune"]["simulator"]), cfg["finetune"]["weights"]
    fit = fit_options(cfg, section.pop("fit"), "finetune.simulator.fit")
    how = options(SimulatorFitConfig, section, "finetune.simulator")
    store = open_clips(cfg, cfg["task"]["data"])
    prepare_process(cfg["seed"], cfg["threads"])
    model = build_simulator(cfg, Path(weights) if weights else inputs.weights("warm"))
    fresh = not (weights or cfg["simulator"].get("checkpoint"))
    look = Film(model, store, folder, cfg["simulator"]["bf16"])
    stats = train_simulator(model, store, learning_episodes(store), how, fit, folder, fresh=fresh, look=look)
    save_weights(model, folder)
    return dict(stats)


@stage(
    reads=(*_READS, "distill.steps", "distill.method", "distill.first", "finetune.simulator.strides"),
    place=Place.LEARNERS,
)
def student(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The few-step student of that simulator, as section distill says.

    Settings: fingerprint of the data.
    """
    store, taught = open_clips(cfg, cfg["task"]["data"]), cfg["finetune"]["simulator"]["strides"]
    told = lacking_strides("distill.first", cfg["distill"]["first"]["strides"], "finetune.simulator", taught)
    return {**distil(cfg, folder, inputs, "distill.first", store, learning_episodes(store)), **told}


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
    parts = (decoder, model, store, learning_episodes(store), fit, folder)
    stats = train_state(*parts, lora=section["lora"], clips=section["clips"])
    save_weights(decoder, folder)
    return dict(stats)
