"""Stage that lets physics decide: of two policies, the newer one, unless its trial says it got worse.

RL believes its simulator, and learns to succeed under its exploration. A policy that has learned to exploit
the one or the other may look ever better, in imagination and in its deployments, while what it does by its
mode, which is what people use, gets worse. So the modes are tried, from the same starts; after a loss the
next round goes on from the policy before, in a simulator that has seen the exploit.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from torch import Tensor
from tqdm import tqdm

from envs.files import atomic
from pipeline.evaluation.by_task import by_task, tasks_of_seeds
from pipeline.evaluation.result import OUTCOMES, outcomes
from pipeline.evaluation.statistics import mcnemar, rate_entry, rate_line
from pipeline.graph.stage import WEIGHTS, Inputs, stage
from pipeline.stages.given import Cfg, deployed_in

# By how many standard errors of the paired difference the newer policy must have succeeded less often. Trials
# are short and RL mostly gains: whoever takes the better count goes back to the older policy by chance too
# often.
_DOUBT = 1.0
_CHANCE = 0.01  # below it a task's loss is told, whatever the others gained


@stage(reads=("task.name",))
def keep(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The policy `candidate`, unless by its trial `tried` it got worse, else the `incumbent`.

    It is held against the best trial so far, which the role `known` has (the first trial or an earlier
    choice), and not against that of the incumbent, or small losses would add up from round to round.

    Returns:
        Whether the candidate was kept; rate entries of its trial (tried) and of the best before (best), on
        the starts that count in both, and how many of them were gained and lost, with the same by task
        under tasks if there are several; the round in which the kept policy was tried; alarms, of tasks that
        lost.
    """
    seeds, (before, after) = outcomes(inputs.folder("known"), inputs.folder("tried"))
    kept = not got_worse(before, after)
    with atomic(folder / WEIGHTS) as part:
        shutil.copyfile(inputs.folder("candidate" if kept else "incumbent") / WEIGHTS, part)
    best = "tried" if after.sum() > before.sum() else "known"
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
        "round": deployed_in(inputs, "tried" if kept else "known"),
        "alarms": [_lost(task, entry) for task, entry in tasks.items() if kept and _beyond_chance(entry)],
    }


def got_worse(before: Tensor, after: Tensor) -> bool:
    """Whether of paired outcomes bool [N] more are lost than gained, by over one standard error."""
    gained, lost = int((after & ~before).sum()), int((before & ~after).sum())
    return lost - gained > _DOUBT * (gained + lost) ** 0.5


def _compared(before: Tensor, after: Tensor) -> dict[str, Any]:
    return {"tried": rate_entry(after), "best": rate_entry(before), **mcnemar(before, after)}


def _beyond_chance(entry: dict[str, Any]) -> bool:
    return bool(entry["lost"] > entry["gained"] and entry["p"] < _CHANCE)


def _lost(task: str, entry: dict[str, Any]) -> str:
    return (
        f"{task} lost {entry['lost']} and gained {entry['gained']} of {entry['tried']['episodes']} episodes,"
        " though all tasks together did not; explore less (a higher explore.keep), deploy more episodes"
        " (rounds.deploy), or hold the policy nearer to what worked (rl.anchor)"
    )
