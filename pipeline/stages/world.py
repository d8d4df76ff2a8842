"""Stages that make the imagined world: the simulator, its tokenizer, its state expert, and the judge."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from actors.factory import build_judge, build_simulator, build_state_decoder, build_text_world
from actors.process import prepare_process
from actors.weights import load
from envs.episodes.clips import ClipStore
from envs.judges.base import Judge
from envs.rng import order_generator
from envs.simulators.base import Simulator
from envs.simulators.features import features_of_episodes
from envs.targets import ConfigError, options
from learners.stages.distill.stage import train_student
from learners.stages.film import Film
from learners.stages.generated import generated_frames, recorded_features
from learners.stages.judge import calibrate, judge_recordings, train_judge
from learners.stages.simulator import ClipBatches, SimulatorFitConfig, train_simulator
from learners.stages.state import train_state
from learners.stages.text_world import calibrate_ending, train_text_world
from learners.stages.tokenizer import train_tokenizer
from learners.training.parallel import leads
from pipeline.acting import acting
from pipeline.evaluation.judging import episode_success, labelled
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import (
    ROBOT,
    SIMULATOR,
    WORLD,
    Cfg,
    fit_options,
    imagined_chunks,
    learning_episodes,
    learns,
    newest_episodes,
    open_store,
)
from pipeline.stages.judge_cost import priced
from pipeline.stages.pace import in_time


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
    store = open_store(cfg, inputs)
    episodes = learning_episodes(store)
    prepare_process(cfg["seed"], cfg["threads"])
    model = build_simulator(cfg, inputs.weights("warm"))
    stats = (
        train_simulator(
            *(model, store, episodes, how, fit, folder),
            newest=newest_episodes(store, episodes),
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
    store = open_store(cfg, inputs)
    episodes = learning_episodes(store)
    newest = newest_episodes(store, episodes)
    key, taught = f"distill.{phase}", cfg["simulator_fit"][phase]["strides"]
    told = lacking_strides(key, cfg["distill"][phase]["strides"], f"simulator_fit.{phase}", taught)
    return {**distil(cfg, folder, inputs, key, store, episodes, newest), **told}


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
    fit = in_time(inputs, "state", fit_options(cfg, section["fit"], f"state_fit.{phase}.fit"))
    episodes, how = learning_episodes(store), {"lora": section["lora"], "fresh": phase == "first"}
    stats = train_state(decoder, model, store, episodes, fit, folder, **how) if learns(decoder) else {}
    save_weights(decoder, folder)
    return {**stats, "steps": fit.steps}


@stage(reads=(*ROBOT, "threads", "judge.text_world", "text_world_fit", "microbatches"), place=Place.LEARNERS)
def text_world(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The text world of a judge that asks for one, with its tokenizer, going on from the role `warm` if there
    is one; the threshold that ends its trajectories on recorded video that neither it nor judges learn from.

    Settings: phase, first or refresh.
    """
    phase, section = inputs.settings["phase"], cfg["text_world_fit"]
    store = open_store(cfg, inputs)
    prepare_process(cfg["seed"], cfg["threads"])
    model = build_text_world(cfg, inputs.weights("warm"))
    fit = fit_options(cfg, section[phase], f"text_world_fit.{phase}")
    tokenizer = fit_options(cfg, section["tokenizer"], "text_world_fit.tokenizer")
    stats = train_text_world(
        *(model, store, store.split("train"), section["stride"], fit, folder),
        tokenizer=tokenizer if phase == "first" else None,
    )
    calibrated = calibrate_ending(model, store, store.split("calibration"), section["stride"])
    save_weights(model, folder)
    return {**stats, "ending_threshold": float(model.threshold), "ending_calibrated": calibrated}


@stage(reads=(*WORLD, "judge_fit.{phase}", "rl.starts", "rl.horizon", "microbatches"), place=Place.LEARNERS)
@priced
def judge(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The judge on recorded and on generated frames; its threshold on recorded video that no judge learns
    from. A judge without weights is only calibrated. One with a text world takes over what the role
    `text_world` has learned, and leaves it as it is.

    Settings: phase, first or refresh.
    """
    phase = inputs.settings["phase"]
    section = cfg["judge_fit"][phase]
    store = open_store(cfg, inputs)
    prepare_process(cfg["seed"], cfg["threads"])
    model, world = build_judge(cfg, inputs.weights("warm")), build_simulator(cfg, inputs.weights("simulator"))
    if golden := inputs.weights("text_world"):
        load(model.text_world, golden).requires_grad_(False)
    model.attach(world)
    stats: dict[str, Any] = {}
    bf16 = cfg["simulator"]["bf16"]
    if learns(model):
        train = labelled(store, store.split("train"))
        if not len(train):
            raise ConfigError(
                f"judge={cfg['judge']['_target_']} learns from success, which no training episode of the data"
                " says; record next.success, or choose a judge that needs none (judge=...)"
            )
        shuffled = torch.randperm(len(train), generator=order_generator(cfg["seed"]))
        pick = train[shuffled[: section["imagined"]]]
        generated = _as_imagined(cfg, world, store, pick)
        recorded = recorded_features(world, store, train, bf16) if model.reads_features else None
        fit = fit_options(cfg, section["fit"], f"judge_fit.{phase}.fit")
        stats = dict(train_judge(model, store, train, fit, folder, generated, recorded))
        stats["generated_frames"] = len(generated)
    _calibrate(cfg, model, store, world, bf16)
    save_weights(model, folder)
    return {**stats, "threshold": float(model.threshold), **model.facts(), **_doubts(cfg, model, store)}


def _doubts(cfg: Cfg, model: Judge, store: ClipStore) -> dict[str, str]:
    """{"alarm"}: the judge is blind to the words, and there are several; or most goals that it imagined for
    calibration never end, whatever stands in for them. {} otherwise.
    """
    facts, said = model.facts(), set(store.instructions)
    goals, unfinished = facts.get("goals", 0), facts.get("goals_unfinished", 0)
    doubts = []
    if not model.reads_instruction and len(said) > 1:
        doubts.append(
            f"{type(model).__name__} reads no instruction, and recordings hold {len(said)} different ones: it"
            " cannot tell what was asked for; where words decide, choose judge=learned"
        )
    if 2 * unfinished > goals:
        doubts.append(f"{unfinished} of {goals} imagined goals never end; {type(model).remedy(cfg['judge'])}")
    return {"alarm": "; ".join(doubts)} if doubts else {}


def _as_imagined(cfg: Cfg, world: Simulator, store: ClipStore, episodes: Tensor) -> TensorDict:
    """Generated frames of episodes: of half of them as RL will see them, if it begins inside recorded ones
    and does not go far; of the others whole episodes, by which the world is measured.
    """
    rl, bf16 = cfg["rl"], cfg["simulator"]["bf16"]
    if rl["starts"] == "first" or rl["horizon"] is None:
        return generated_frames(world, store, episodes, bf16)
    near = generated_frames(world, store, episodes[::2], bf16, imagined_chunks(cfg))
    return torch.cat([near, generated_frames(world, store, episodes[1::2], bf16)])


def _calibrate(cfg: Cfg, model: Judge, store: ClipStore, world: Simulator, bf16: bool) -> None:
    """Set the judge's threshold on the calibration split, where its scores tell success; a judge that says
    (judge.votes.calibrate=false) that its answers need none is not asked.

    Raises:
        ConfigError: if it gives no judgement on any episode there.
    """
    if not model.calibrates:
        return
    unseen = labelled(store, store.split("calibration"))
    if not len(unseen):
        return
    features = features_of_episodes(world, store, unseen, bf16) if model.reads_features else None
    score = judge_recordings(model, store, unseen, features)
    succeeded = episode_success(store, unseen)
    blank = int((~torch.isfinite(score).all(1)).sum())
    if blank:
        why = (
            f"judge={cfg['judge']['_target_']} gives no judgement on {blank} of {len(unseen)} recorded"
            f" calibration episodes; {type(model).remedy(cfg['judge'])}"
        )
        if blank == len(unseen):  # nor would it on generated ones, which RL would drop one after the other
            raise ConfigError(why)
        tqdm.write(why)
    if not calibrate(model, score, succeeded):
        tqdm.write(
            f"judge: {int(succeeded.sum())} of {len(succeeded)} calibration episodes succeeded, and its"
            f" scores do not tell which; threshold left at {float(model.threshold):.3f}"
        )
