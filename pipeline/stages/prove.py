"""Stages that prove: imagined against true success, policies in physics, the world on held-out episodes."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from actors.factory import (
    at_once,
    build_judge,
    build_physics,
    build_policy,
    build_simulator,
    build_state_decoder,
)
from actors.process import prepare_process
from actors.rollouts.evaluate import evaluate
from envs.episodes.filming import side_by_side, write_film
from envs.files import write_text
from envs.rng import Purpose, episode_seeds
from envs.simulators.replay import replay
from pipeline.evaluation import measurement
from pipeline.evaluation.by_task import (
    by_scene,
    by_task,
    scenes_of_episodes,
    tasks_of_episodes,
    tasks_of_seeds,
    unseen_first,
)
from pipeline.evaluation.disagreement import compared
from pipeline.evaluation.judging import episode_success, judge_both, judge_frames, judge_table
from pipeline.evaluation.media import REST, paired_frames
from pipeline.evaluation.result import write_outcomes
from pipeline.evaluation.statistics import mean, rate, rate_entry
from pipeline.graph.stage import Inputs, Place, stage
from pipeline.stages.given import PHYSICS, WORLD, Cfg, load_world, open_store
from pipeline.stages.judging.cost import priced

EPISODES = "episodes.json"  # of the stage measure
_SIDE_BY_SIDE = 64  # imagined episodes
_TOO_KIND = 0.2  # so far apart lie the confidence intervals of imagined and true success


@stage(reads=(*WORLD, "policy", "measure"), place=Place.EVALUATOR)
@priced
def gap(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """How far imagination and truth lie apart for the policy just deployed: same starts, same stochastic
    policy; held-out episodes first. Leaves a video of an imagined episode, and one of a held-out true one
    above which its actions are imagined.

    Settings: number of the round.
    """
    number = inputs.settings["number"]
    store = open_store(cfg, inputs)
    mine = unseen_first(cfg, store, store.select([f"policy-{number}"]), cfg["measure"]["starts"])
    prepare_process(cfg["seed"], cfg["threads"])
    policy = build_policy(cfg, inputs.weights("policy"))
    truth = episode_success(store, mine)
    world = load_world(cfg, inputs, store, min(_SIDE_BY_SIDE, len(mine)), mine)
    seeds = list(range(len(mine)))
    outcome = evaluate(world, policy, seeds, stochastic=True, label="gap", sampling_seed=cfg["seed"])
    write_film(folder / "media/imagined.mp4", side_by_side(world.base_env.video(0).numpy()), store.fps)
    tasks, judge = tasks_of_episodes(cfg, store, mine), world.transform[-1].judge
    held = measurement.followed(store, store.split("held_out"))
    sides = (truth, outcome.success, outcome.counted, torch.isin(mine, held))
    result = {"round": number, **_gap(*sides), "tasks": by_task(tasks, _gap, *sides)}
    held = held[torch.isin(held, store.select(["policy-*"]))]
    if len(held):
        simulator = world.base_env.simulator
        decoder = build_state_decoder(cfg, simulator, inputs.weights("state"))
        made = replay(simulator, store, held, decoder, bf16=cfg["simulator"]["bf16"])
        scores = judge_frames(judge, made.frames, made.valid, store, held, made.features)
        write_film(folder / "media/held-out.mp4", paired_frames(store, held, made, 0), store.fps, rest=REST)
        result["replayed"] = judge_table(judge, scores, made.valid, store, held)
    return {**result, "judged_by": judge.facts(), "alarms": too_kind(result)}


def too_kind(result: Mapping[str, Any]) -> list[str]:
    """What to know of those tasks of a gap in which imagined success lies far above the true one, beyond what
    chance does: that an imagined episode succeeds says little there.
    """
    out = []
    for task, entry in (result["tasks"] or {"": result}).items():
        imagined, true = entry["imagined"], entry["true"]
        if imagined["low"] - true["high"] > _TOO_KIND:
            seen, so = (f"{one['successes']} of {one['episodes']}" for one in (imagined, true))
            out.append(
                f"{task or 'the task'} succeeds in {seen} imagined and {so} true episodes from the same"
                f" starts, {entry['unseen']} of them held out, so that it succeeds in imagination says"
                " little; deploy more episodes"
                " (rounds.deploy), or train simulator and judge for longer (simulator_fit, judge_fit)"
            )
    return out


@stage(reads=(*PHYSICS, "evaluate"), place=Place.EVALUATOR)
def evaluate_physics(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Deterministic success in physics on the evaluation seeds."""
    return _true_success(cfg, folder, inputs, {})


@stage(reads=(*PHYSICS, "evaluate", "task.variants.{variant}"), place=Place.EVALUATOR)
def evaluate_variant(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The same on the same seeds in a variant of the task: other scenes, other words.

    Settings: variant, its name in task.variants.
    """
    return _true_success(cfg, folder, inputs, cfg["task"]["variants"][inputs.settings["variant"]])


def _true_success(cfg: Cfg, folder: Path, inputs: Inputs, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Deterministic success in physics, the suite's options changed; outcomes.pt has that of each seed."""
    section = cfg["evaluate"]
    prepare_process(cfg["seed"], cfg["threads"])
    policy = build_policy(cfg, inputs.weights("policy"))
    env = build_physics(cfg, at_once(cfg, section["envs"]), changes=changes)
    began = time.perf_counter()
    try:
        seeds = episode_seeds(cfg["seed"], Purpose.EVALUATE, section["episodes"])
        outcome = evaluate(env, policy, seeds, label="physics")
    finally:
        env.close()
    write_outcomes(folder, outcome)
    entry = _counted(outcome.success, outcome.counted)
    return {
        "rate": rate(entry),
        **entry,
        "tasks": by_task(tasks_of_seeds(cfg, seeds), _counted, outcome.success, outcome.counted),
        "progress": mean(outcome.progress[outcome.counted]),
        "evaluation_seconds": time.perf_counter() - began,
    }


@stage(reads=(*WORLD, "policy", "evaluate"), place=Place.EVALUATOR)
@priced
def evaluate_imagined(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Deterministic success in the last imagined world, of the policies in the roles before and after, from
    the starts of held-out episodes first, shared out over tasks, of which those count where both could be
    judged; leaves a video of an episode of each.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    store = open_store(cfg, inputs)
    starts = unseen_first(cfg, store, store.select(), cfg["evaluate"]["imagined"])
    world = load_world(cfg, inputs, store, min(_SIDE_BY_SIDE, len(starts)), starts)
    tasks, scenes = (of(cfg, store, starts) for of in (tasks_of_episodes, scenes_of_episodes))
    won, known = {}, torch.ones(len(starts), dtype=torch.bool)
    for label in ("before", "after"):
        policy = build_policy(cfg, inputs.weights(label))
        outcome = evaluate(world, policy, list(range(len(starts))), label=f"imagined {label}")
        write_film(folder / f"media/{label}.mp4", side_by_side(world.base_env.video(0).numpy()), store.fps)
        won[label], known = outcome.success, known & outcome.counted
    rates = {
        label: {
            **_counted(success, known),
            "tasks": by_task(tasks, _counted, success, known),
            "scenes": by_scene(tasks, scenes, _counted, success, known),
        }
        for label, success in won.items()
    }
    return {**rates, "judged_by": world.transform[-1].judge.facts()}


def _counted(success: Tensor, counted: Tensor) -> dict[str, Any]:
    """A rate entry of the episodes that count, and how many were dropped."""
    return {**rate_entry(success[counted]), "dropped": int((~counted).sum())}


def _gap(truth: Tensor, success: Tensor, counted: Tensor, unseen: Tensor) -> dict[str, Any]:
    """True and imagined rates of those starts whose imagined episodes could be judged; how far they lie
    apart, None where there are none; and how many of these starts nothing has learned from.
    """
    true, imagined = truth[counted], success[counted]
    apart = float(imagined.float().mean() - true.float().mean()) if len(true) else None
    rates = {"true": rate_entry(true), "imagined": rate_entry(imagined)}
    return {**rates, "gap": apart, "unseen": int(unseen[counted].sum())}


@stage(reads=(*WORLD, "measure"), place=Place.EVALUATOR)
@priced
def measure(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Rollout error, state error, speed and the judge's tables on held-out episodes of every source; and
    episodes.json, how far imagination and truth disagree in each of them (see disagreement.py).
    """
    prepare_process(cfg["seed"], cfg["threads"])
    simulator = build_simulator(cfg, inputs.weights("simulator"))
    decoder = build_state_decoder(cfg, simulator, inputs.weights("state"))
    judge = build_judge(cfg, inputs.weights("judge"))
    store = open_store(cfg, inputs)
    bf16 = cfg["simulator"]["bf16"]
    result: dict[str, Any] = {"rollout": {}, "judge": {}}
    rows: list[dict[str, Any]] = []
    held = measurement.followed(store, store.split("held_out"))
    for name, episodes in measurement.groups(store, held).items():
        made = replay(simulator, store, episodes, decoder, bf16=bf16)
        result["rollout"][name] = measurement.rollout_error(store, episodes, made)
        views = judge_both(judge, simulator, store, episodes, made, bf16)
        tables = {
            video: judge_table(judge, scores, made.valid, store, episodes)
            for video, scores in views._asdict().items()
        }
        if all(tables.values()):
            result["judge"][name] = tables
        rows += compared(cfg, judge, store, episodes, made, views)
    write_text(folder / EPISODES, json.dumps(rows))
    result["frames_per_second"] = {
        f"batch {n}": measurement.speed(simulator, store, n, cfg["measure"]["speed_chunks"], bf16)
        for n in (1, 32)
    }
    return {**result, "judged_by": judge.facts()}
