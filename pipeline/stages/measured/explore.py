"""Stage that finds in physics how widely, and in how many decisions, the first policy may try things.

RL learns from how differently episodes go, so exploration should be wide; but what a task forgives differs: a
push still works under noise with which nothing can be grasped. Where most of what the policy can do is lost,
rewards are too rare to learn from, and simulator and judge see little but failures. Episodes survive wide
departures where only some decisions are drawn at random, and the policy's mode takes the others.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from actors.factory import build_policy
from actors.process import prepare_process
from actors.world_config import world_spec
from envs.episodes.episode import Episode
from envs.episodes.formats.lerobot.writer import LeRobotWriter
from envs.episodes.splits import TRAIN, write_splits
from envs.episodes.write_behind import WriteBehind
from envs.rng import Purpose, episode_seeds
from pipeline.evaluation.by_task import tasks_of_seeds
from pipeline.evaluation.statistics import rate_entry
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import Inputs, stage
from pipeline.stages.collect import SPLITS, run_recorded
from pipeline.stages.given import PHYSICS, Cfg

Rates = dict[str, dict[str, Any]]  # a rate entry (statistics.py) by task
Level = tuple[float, float]  # how widely decisions are drawn, and the share of them that is


@stage(reads=(*PHYSICS, "explore"))
def explore(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The policy, exploring by the first of explore.levels that keeps the share explore.keep of what its mode
    succeeds in, or by the last.

    All are tried from the same explore.episodes starts. What is recorded is learned from as other episodes of
    the policy are.

    Returns:
        level, which was chosen, with its name, width and share (the first if the mode never succeeds, for
        then nothing can be told); mode and levels, the successes of those that were tried, with the same by
        task under tasks; alarm, if no level keeps enough; episodes, of all of them together, and how many
        more were dropped.
    """
    section = cfg["explore"]
    prepare_process(cfg["seed"], cfg["threads"])
    seeds = episode_seeds(cfg["seed"], Purpose.DEPLOY, section["episodes"])
    choices = [(float(width), float(share)) for width, share in section["levels"]]
    data = folder / "dataset"
    shutil.rmtree(data, ignore_errors=True)
    with WriteBehind(LeRobotWriter(data, world_spec(cfg).embodiment)) as behind:
        found = find_level(choices, section["keep"], partial(_tried, cfg, inputs, seeds, behind))
    level, mode, tried = found
    levels = {level_name(one): _summed(rates) for one, rates in tried.items()}
    total = _summed(mode)
    trials = {"mode": total, **levels}
    episodes = sum(entry["episodes"] for entry in trials.values())
    dropped = len(trials) * len(seeds) - episodes
    seen = ", ".join(f"{name} {entry['successes']}/{entry['episodes']}" for name, entry in trials.items())
    tqdm.write(f"explore: successes {seen}; {dropped} dropped")
    # Levels share starts, so no episode is fit to be held out.
    write_splits(data, {name: episodes if name == TRAIN else 0 for name in SPLITS})
    save_weights(_scaled(cfg, inputs, level), folder)
    return {
        "level": {"name": level_name(level), "width": level[0], "share": level[1]},
        "mode": total,
        "levels": levels,
        **_alarm(mode, tried, section["keep"]),
        "episodes": episodes,
        "dropped": dropped,
        "physics_episodes": {"own": episodes},
    }


def find_level(
    levels: Sequence[Level], keep: float, trial: Callable[[Level | None], Rates]
) -> tuple[Level, Rates, dict[Level, Rates]]:
    """The first level that keeps the share `keep` of the mode's successes; see `explore` and `kept`.

    Args:
        levels: in the order in which they are tried, the boldest first.
        trial: success of the policy at a level, or of its mode for None, by task.

    Returns:
        The level, the mode's success, and that of each level that was tried.
    """
    level, mode, tried = levels[0], trial(None), dict[Level, Rates]()
    for level in levels if _summed(mode)["successes"] else ():
        tried[level] = trial(level)
        if kept(tried[level], mode) >= keep:
            break
    return level, mode, tried


def level_name(level: Level) -> str:
    """A level as tables name it, such as x0.5 on 50%."""
    width, share = level
    return f"x{width:g} on {100 * share:g}%"


def kept(rates: Rates, mode: Rates) -> float:
    """The share of its mode's successes that a policy keeps, 0..1.

    It is the mean over tasks of min(1, its rate over the mode's), so that what a hard task loses is not made
    up for by an easy one, over the mean of min(1, the mode's rate over its), for chance takes as much from
    either. Tasks in which neither succeeds say nothing, nor do those all of whose episodes were dropped on
    either side; half a success and half a failure more on both sides let single episodes decide little. 0 if
    no task says anything.
    """
    ratios = [
        _shrunk(rates[task]) / _shrunk(mode[task])
        for task in mode
        if task in rates and (rates[task]["successes"] or mode[task]["successes"])
    ]
    if not ratios:
        return 0.0
    return min(1.0, sum(min(1.0, one) for one in ratios) / sum(min(1.0, 1 / one) for one in ratios))


def _shrunk(entry: Mapping[str, Any]) -> float:
    return (entry["successes"] + 0.5) / (entry["episodes"] + 1)


def _tried(cfg: Cfg, inputs: Inputs, seeds: list[int], behind: WriteBehind, level: Level | None) -> Rates:
    """Record episodes of the policy that explores so, or of its mode if `level` is None."""
    policy = _scaled(cfg, inputs, (1.0, 1.0) if level is None else level)
    robot, won, played = world_spec(cfg).embodiment, list[bool](), list[int]()
    for tracks in run_recorded(cfg, policy, seeds, stochastic=level is not None):
        behind.write([Episode.from_track(track, "policy-0", robot) for track in tracks])
        won += [bool(track.rows["success"][-1]) for track in tracks]
        played += [track.seed for track in tracks]
    tasks, success = tasks_of_seeds(cfg, played), torch.tensor(won)
    return {
        task: rate_entry(success[torch.tensor([one == task for one in tasks])])
        for task in dict.fromkeys(tasks)
    }


def _summed(rates: Rates) -> dict[str, Any]:
    """The rate entry of all tasks together, with theirs under tasks if there are several."""
    won = sum(entry["successes"] for entry in rates.values())
    episodes = sum(entry["episodes"] for entry in rates.values())
    whole = rate_entry(torch.arange(episodes) < won)
    return {**whole, **({"tasks": rates} if len(rates) > 1 else {})}


def _scaled(cfg: Cfg, inputs: Inputs, level: Level) -> Any:
    """The policy with its exploration scaled."""
    policy = build_policy(cfg, inputs.weights("policy"))
    policy.scale_exploration(*level)
    return policy


def _alarm(mode: Rates, tried: Mapping[Level, Rates], keep: float) -> dict[str, str]:
    """What the user must know if no level keeps enough."""
    if not tried:
        return {
            "alarm": f"by its mode the policy succeeds in none of {_summed(mode)['episodes']} episodes, so"
            " how widely it may explore is not known; give imitation more demonstrations or steps (imitation)"
        }
    *_, last = tried
    if kept(tried[last], mode) >= keep:
        return {}
    return {
        "alarm": f"even {level_name(last)} keeps less than {keep:g} of the mode's successes; add more"
        " cautious ones to explore.levels"
    }
