"""Stages that make the imagined world: the simulator, its tokenizer, its state expert, and the judge."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch import Tensor
from tqdm import tqdm

from actors.factory import build_simulator, build_state_decoder
from actors.process import prepare_process
from envs.episodes.clips import ClipStore
from envs.targets import ConfigError, options
from learners.stages.distill.stage import train_student
from learners.stages.film import Film
from learners.stages.simulator import ClipBatches, SimulatorFitConfig, train_simulator
from learners.stages.state import train_state
from learners.stages.tokenizer import train_tokenizer
from learners.training.parallel import leads
from pipeline.acting import acting
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import (
    SIMULATOR,
    Cfg,
    fit_options,
    learning_episodes,
    learns,
    newest_episodes,
    open_store,
)
from pipeline.stages.pace import in_time, state_in_time


@stage(reads=(*SIMULATOR, "tokenizer_fit"), place=Place.LEARNERS)
def tokenizer(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The video autoencoder of a simulator that works on latents; of it, as of the simulator and the state
    expert, the role `pace` says how many steps take the seconds that settings may ask for.
    """
    store = open_store(cfg, inputs)
    return train_codec(cfg, folder, inputs, store, learning_episodes(store))


def train_codec(cfg: Cfg, folder: Path, inputs: Inputs, store: ClipStore, episodes: Tensor) -> dict[str, Any]:
    """A simulator whose autoencoder was trained on some episodes; nothing else of it was."""
    prepare_process(cfg["seed"], cfg["threads"])
    model = build_simulator(cfg)
    fit = in_time(inputs, "tokenizer", fit_options(cfg, cfg["tokenizer_fit"], "tokenizer_fit"))
    stats = train_tokenizer(model, store, episodes, fit, folder)
    save_weights(model, folder)
    return {**stats, "steps": fit.steps}


@stage(reads=(*SIMULATOR, "simulator_fit.{phase}"), place=Place.LEARNERS)
def simulator(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The simulator, going on from the role `warm` (its tokenizer or its predecessor) if there is one.

    Settings: phase, first or refresh.
    """
    phase = inputs.settings["phase"]
    section = dict(cfg["simulator_fit"][phase])
    fit = in_time(inputs, "simulator", fit_options(cfg, section.pop("fit"), f"simulator_fit.{phase}.fit"))
    how = options(SimulatorFitConfig, section, f"simulator_fit.{phase}")
    store, episodes = _lessons(cfg, inputs)
    prepare_process(cfg["seed"], cfg["threads"])
    model = build_simulator(cfg, inputs.weights("warm"))
    stats = (
        train_simulator(
            *(model, store, episodes, how, fit, folder),
            newest=newest_episodes(store, inputs, episodes),
            fresh=phase == "first",
            look=Film(model, store, folder, cfg["simulator"]["bf16"]),
        )
        if learns(model)
        else {}
    )
    save_weights(model, folder)
    return {**stats, "steps": fit.steps, "parameters": sum(p.numel() for p in model.parameters())}


@stage(
    reads=(*SIMULATOR, "distill.steps", "distill.method", "distill.{phase}", "simulator_fit.{phase}.strides"),
    place=Place.LEARNERS,
)
def student(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The few-step student of the role `simulator`, going on from the role `warm`, the student before, if
    there is one. Later stages meet it by the config of `acting`.

    Settings: phase, first or refresh.
    """
    phase = inputs.settings["phase"]
    store, episodes = _lessons(cfg, inputs)
    newest = newest_episodes(store, inputs, episodes)
    key, taught = f"distill.{phase}", cfg["simulator_fit"][phase]["strides"]
    told = lacking_strides(key, cfg["distill"][phase]["strides"], f"simulator_fit.{phase}", taught)
    return {**distil(cfg, folder, inputs, key, store, episodes, newest), **told}


def _lessons(cfg: Cfg, inputs: Inputs) -> tuple[ClipStore, Tensor]:
    """The role `data`, and which of its episodes a simulator learns from, int64 [N]: the same ones whatever
    the engine. In which frames of the calibration split the task is done is not told: what a world says of
    that is calibrated there.
    """
    store = open_store(cfg, inputs)
    store.arrays["labelled"][store.split("calibration")] = False
    return store, learning_episodes(store)


def lacking_strides(key: str, known: Sequence[int], teacher: str, taught: Sequence[int]) -> dict[str, str]:
    """{"alarm"}: strides that a student is not taught although its teacher was, also printed before it
    learns; {} if there are none.

    Args:
        key, teacher: of the sections that hold their strides, `known` and `taught`.
    """
    lacking = [stride for stride in taught if stride not in known]
    if not lacking:
        return {}
    text = (
        f"{key}.strides={list(known)} lacks {lacking} of {teacher}.strides: at these the student is not"
        f" taught to take few steps; say {key}.strides={list(taught)}"
    )
    if leads():
        tqdm.write(f"student: {text}")
    return {"alarm": text}


def distil(
    cfg: Cfg,
    folder: Path,
    inputs: Inputs,
    key: str,
    store: ClipStore,
    episodes: Tensor,
    newest: Tensor | None = None,
) -> dict[str, Any]:
    """A student trained on some episodes as the section at `key`, such as distill.first, says."""
    section = dict(cfg["distill"][key.rpartition(".")[2]])
    fit = fit_options(cfg, section.pop("fit"), f"{key}.fit")
    how = options(SimulatorFitConfig, section, key)
    prepare_process(cfg["seed"], cfg["threads"])
    teacher = build_simulator(cfg, inputs.weights("simulator"))
    weights = inputs.weights("warm") or inputs.weights("simulator")
    model = build_simulator(acting(cfg), weights)
    method = dict(cfg["distill"]["method"])
    clips = ClipBatches(model, store, episodes, how, fit, newest)
    look = Film(model, store, folder, cfg["simulator"]["bf16"])
    try:
        stats = train_student(teacher, method, clips, folder, look)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    save_weights(model, folder)
    return {**stats, "evaluations": cfg["distill"]["steps"]}


@stage(reads=(*SIMULATOR, "state_fit.{phase}"), place=Place.LEARNERS)
def state(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The state expert on the frozen simulator.

    Settings: phase, first or refresh.
    """
    phase = inputs.settings["phase"]
    store = open_store(cfg, inputs)
    prepare_process(cfg["seed"], cfg["threads"])
    model = build_simulator(cfg, inputs.weights("simulator"))
    decoder = build_state_decoder(cfg, model, inputs.weights("warm"))
    section = cfg["state_fit"][phase]
    fit = fit_options(cfg, section["fit"], f"state_fit.{phase}.fit")
    fit, clips = state_in_time(inputs, fit, section["clips"])
    episodes = learning_episodes(store)
    how = {"lora": section["lora"], "fresh": phase == "first", "clips": clips}
    stats = train_state(decoder, model, store, episodes, fit, folder, **how) if learns(decoder) else {}
    save_weights(decoder, folder)
    return {**stats, "steps": fit.steps}
