"""Stages that let physics decide: each round's policy is tried, and left behind if it got worse.

RL believes its simulator, and its policies explore in it as in their deployments. One may look ever better
there while what it does by its mode, which is what people use, gets worse. So the modes are tried, from the
same starts; after a loss the next round goes on from the policy before, in a simulator that has seen more.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from torch import Tensor
from tqdm import tqdm

from actors.factory import at_once, build_physics, build_policy
from actors.process import prepare_process
from actors.rollouts.evaluate import evaluate
from envs.files import atomic
from envs.rng import Purpose, episode_seeds
from pipeline.evaluation.by_task import by_task, tasks_of_seeds
from pipeline.evaluation.result import OUTCOMES, outcomes, write_outcomes
from pipeline.evaluation.statistics import mcnemar, rate_entry, rate_line
from pipeline.graph.stage import WEIGHTS, Inputs, Place, stage
from pipeline.stages.given import PHYSICS, Cfg, deployed_in

_SIDE_BY_SIDE = 100  # episodes
# By how many standard errors of the paired difference the newer policy must have succeeded less often. The
# best trial so far is the luckiest, too: by one, of policies that are all as good as each other a third would
# be left behind in the fourth round, by two a twentieth.
_DOUBT = 2.0
_CHANCE = 0.01  # below it a task's loss is told, whatever the others gained


@stage(reads=(*PHYSICS, "rounds.trial"), place=Place.EVALUATOR)
def trial(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Success in physics of a round's policy by its mode, from the same rounds.trial starts in all rounds.
    Nothing learns from them, and no evaluation begins there.

    Settings: number of the round.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    policy = build_policy(cfg, inputs.weights("policy"))
    seeds = episode_seeds(cfg["seed"], Purpose.TRIAL, cfg["rounds"]["trial"])
    env = build_physics(cfg, at_once(cfg, min(_SIDE_BY_SIDE, len(seeds))))
    try:
        outcome = evaluate(env, policy, seeds, label="trial")
    finally:
        env.close()
    write_outcomes(folder, outcome)
    seeds, (success,) = outcomes(folder)
    return {
        "round": inputs.settings["number"],
        **rate_entry(success),
        "dropped": int((~outcome.counted).sum()),
        "tasks": by_task(tasks_of_seeds(cfg, seeds), rate_entry, success),
        "physics_episodes": {"own": len(outcome.seeds)},
    }


@stage(reads=("task.name",))
def keep(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The policy `candidate`, unless by its trial `tried` it got worse, else the `incumbent`.

    It is held against the best trial so far, which the role `best` has (the first trial or an earlier
    choice), and not against that of the incumbent, or small losses would add up from round to round.

    Returns:
        Whether the candidate was kept; rate entries of its trial (tried) and of the best before (best), on
        the starts that count in both, and how many of them were gained and lost, with the same by task
        under tasks if there are several; the round in which the kept policy was tried; alarms, of tasks that
        lost.
    """
    seeds, (before, after) = outcomes(inputs.folder("best"), inputs.folder("tried"))
    kept = not got_worse(before, after)
    with atomic(folder / WEIGHTS) as part:
        shutil.copyfile(inputs.folder("candidate" if kept else "incumbent") / WEIGHTS, part)
    best = "tried" if after.sum() > before.sum() else "best"
    with atomic(folder / OUTCOMES) as part:
        shutil.copyfile(inputs.folder(best) / OUTCOMES, part)
    found, tasks = _compared(before, after), by_task(tasks_of_seeds(cfg, seeds), _compared, before, after)
    tqdm.write(
        f"keep: by its mode {rate_line(found['tried'])}, the best before {rate_line(found['best'])};"
        f" {found['gained']} gained, {found['lost']} lost: {'kept' if kept else 'left behind'}"
    )
    return {
        "kept": kept,
        **found,
        "tasks": tasks,
        "round": deployed_in(inputs, "tried" if kept else "best"),
        "alarms": [_lost(task, entry) for task, entry in tasks.items() if kept and _beyond_chance(entry)],
    }


def got_worse(before: Tensor, after: Tensor) -> bool:
    """Whether of paired outcomes bool [N] more are lost than gained, by over two standard errors."""
    gained, lost = int((after & ~before).sum()), int((before & ~after).sum())
    return lost - gained > _DOUBT * (gained + lost) ** 0.5


def _compared(before: Tensor, after: Tensor) -> dict[str, Any]:
    return {"tried": rate_entry(after), "best": rate_entry(before), **mcnemar(before, after)}


def _beyond_chance(entry: dict[str, Any]) -> bool:
    return bool(entry["lost"] > entry["gained"] and entry["p"] < _CHANCE)


def _lost(task: str, entry: dict[str, Any]) -> str:
    return (
        f"{task} lost {entry['lost']} and gained {entry['gained']} of {entry['tried']['episodes']} episodes,"
        " and the policy was kept for all tasks together; explore less (a higher explore.keep), deploy more"
        " episodes (rounds.deploy), or hold the policy nearer to what worked (rl.anchor)"
    )
