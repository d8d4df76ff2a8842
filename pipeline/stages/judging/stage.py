"""The stages that make the judge, and the text world of one that imagines goals."""

from __future__ import annotations

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
from envs.targets import ConfigError
from learners.stages.generated import generated_frames, recorded_features
from learners.stages.judge import calibrate, judge_recordings, train_judge
from learners.stages.text_world import calibrate_ending, train_text_world
from pipeline.evaluation.judging import episode_success, labelled
from pipeline.evaluation.measurement import followed
from pipeline.evaluation.rewards.figures import auc
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import ROBOT, WORLD, Cfg, fit_options, imagined_chunks, learns, open_store
from pipeline.stages.judging.cost import priced

_TOLD = 0.8  # AUC below which a judge's word is little to learn from
_ENOUGH = 8  # successes, and failures, by which it is told


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
    ending = {"ending_threshold": float(model.threshold), "ending_calibrated": calibrated}
    return {**stats, **ending, "ending_max_frames": model.max_frames}


@stage(reads=(*WORLD, "judge_fit.{phase}", "rl.starts", "rl.horizon", "microbatches"), place=Place.LEARNERS)
@priced
def judge(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The judge on recorded and on generated frames; its threshold on recorded video that no judge learns
    from. A judge without weights is only calibrated. One that reads features sees those that the role `state`
    makes of the simulator's, if there is one. One with a text world takes over what the role
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
    if state := inputs.weights("state"):
        build_state_decoder(cfg, world, state)
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
    told = _calibrate(cfg, model, store, world, bf16)
    save_weights(model, folder)
    found = {**stats, **told, "threshold": float(model.threshold), **model.facts()}
    return {**found, **_doubts(cfg, model, store, told)}


def _doubts(cfg: Cfg, model: Judge, store: ClipStore, told: dict[str, float]) -> dict[str, str]:
    """{"alarm"}: the judge hardly tells success from failure where both are recorded; it is blind to the
    words, and there are several; or most goals that it imagined for calibration never end, whatever stands in
    for them. {} otherwise.

    Args:
        told: what _calibrate found.
    """
    facts, said = model.facts(), set(store.instructions)
    goals, unfinished = facts.get("goals", 0), facts.get("goals_unfinished", 0)
    doubts = []
    rare = min(told.get("calibration_successes", 0), told.get("calibration_failures", 0))
    if rare >= _ENOUGH and told["auc"] < _TOLD:
        doubts.append(
            f"the judge hardly tells success from failure: AUC {told['auc']:.2f} on recorded episodes that it"
            " has not learned from, where .5 is chance, so what it rewards in imagination is little to learn"
            " from; teach it for longer (judge_fit.*.fit.steps), let it look through more cameras"
            " (judge.cameras), or use larger pictures (task.size)"
        )
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


def _calibrate(cfg: Cfg, model: Judge, store: ClipStore, world: Simulator, bf16: bool) -> dict[str, float]:
    """Set the judge's threshold on the calibration split, where its scores tell success; a judge that says
    (judge.votes.calibrate=false) that its answers need none is not asked. Where nobody said of any episode
    there whether it succeeded, all count as demonstrations, as they do for imitation: each shows success at
    its end, and its first half alone, which counts as another episode, does not. A judge that charges is not
    asked for that.

    Returns:
        auc of its confidence against recorded success, over calibration_successes and calibration_failures
        episodes, or halves of as many calibration_demonstrations; {} if there are none of either.

    Raises:
        ConfigError: if it gives no judgement on any episode there.
    """
    if not model.calibrates:
        return {}
    there = followed(store, store.split("calibration"))
    unseen = labelled(store, there)
    demonstrated = not len(unseen) and not model.charges
    unseen = there if demonstrated else unseen
    if not len(unseen):
        return {}
    features = features_of_episodes(world, store, unseen, bf16) if model.reads_features else None
    score = judge_recordings(model, store, unseen, features)
    succeeded = episode_success(store, unseen)
    judged = torch.isfinite(score).all(1)
    blank = int((~judged).sum())
    if blank:
        why = (
            f"judge={cfg['judge']['_target_']} gives no judgement on {blank} of {len(unseen)} recorded"
            f" calibration episodes; {type(model).remedy(cfg['judge'])}"
        )
        if blank == len(unseen):  # nor would it on generated ones, which RL would drop one after the other
            raise ConfigError(why)
        tqdm.write(why)
    if demonstrated:
        half = torch.arange(score.shape[1]) < (store.length[unseen] // 2)[:, None]
        score, judged = torch.cat([score, score.where(half, 0.0)]), judged.repeat(2)
        succeeded = torch.arange(len(score)) < len(unseen)
    won, sure = succeeded[judged], model.confidence(score[judged].double())
    if not calibrate(model, score, succeeded):
        why = "its scores do not tell which"
        if won.all() or not won.any():
            why = f"one that {'failed' if won.all() else 'succeeded'} is needed beside them; record some"
        seen = "halves of demonstrations show an end" if demonstrated else "calibration episodes succeeded"
        tqdm.write(
            f"judge: {int(won.sum())} of {len(won)} {seen}, and {why}; threshold left at"
            f" {float(model.threshold):.3f}"
        )
    if won.all() or not won.any():
        return {}
    told = {
        "auc": auc(sure, won),
        "calibration_successes": float(won.sum()),
        "calibration_failures": float((~won).sum()),
    }
    return told | ({"calibration_demonstrations": float(won.sum())} if demonstrated else {})
