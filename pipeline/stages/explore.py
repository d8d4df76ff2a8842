"""Stage that finds in physics how widely the first policy may try things.

RL learns from how differently episodes go, so exploration should be wide; but what a task forgives differs: a
push still works under noise with which nothing can be grasped. Where most of what the policy can do is lost,
rewards are too rare to learn from, and simulator and judge see little but failures.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from actors.factory import build_policy
from actors.process import prepare_process
from actors.world_config import world_spec
from envs.episodes.episode import Episode
from envs.episodes.formats.lerobot_writer import LeRobotWriter
from envs.episodes.splits import write_splits
from envs.episodes.write_behind import WriteBehind
from envs.rng import Purpose, episode_seeds
from pipeline.evaluation.statistics import rate, rate_entry
from pipeline.graph.artefact import save_weights
from pipeline.graph.stage import Inputs, stage
from pipeline.stages.collect import run_recorded
from pipeline.stages.given import PHYSICS, Cfg

Rate = dict[str, Any]  # see rate_entry


@stage(reads=(*PHYSICS, "explore"))
def explore(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The policy, drawing its actions as widely as it can while it keeps the share explore.keep of what its
    mode succeeds in: of explore.levels the first that does so, from the widest on, or the narrowest.

    All are tried from the same explore.episodes starts. What is recorded is learned from as other episodes of
    the policy are.

    Returns:
        level, which was chosen (the widest if the mode never succeeds, for then nothing can be told); mode
        and levels, the successes of those that were tried; alarm, if no level keeps enough.
    """
    section = cfg["explore"]
    prepare_process(cfg["seed"], cfg["threads"])
    seeds = episode_seeds(cfg["seed"], Purpose.DEPLOY, section["episodes"])
    data = folder / "dataset"
    shutil.rmtree(data, ignore_errors=True)
    widest_first = sorted(section["levels"], reverse=True)
    level, tried = widest_first[0], dict[float, Rate]()
    with WriteBehind(LeRobotWriter(data, world_spec(cfg).embodiment)) as behind:
        mode = _tried(cfg, inputs, seeds, None, behind)
        for level in widest_first if mode["successes"] else ():
            tried[level] = _tried(cfg, inputs, seeds, level, behind)
            if rate(tried[level]) >= section["keep"] * rate(mode):
                break
    seen = [
        f"mode {mode['successes']}",
        *(f"x{factor:g} {one['successes']}" for factor, one in tried.items()),
    ]
    tqdm.write(f"explore: successes of {mode['episodes']} episodes each: {', '.join(seen)}")
    episodes = sum(one["episodes"] for one in (mode, *tried.values()))
    write_splits(data, {"train": episodes})  # levels share starts, so none of them is fit to be held out
    save_weights(_scaled(cfg, inputs, level), folder)
    return {
        "level": level,
        "mode": mode,
        "levels": {f"{factor:g}": one for factor, one in tried.items()},
        **_alarm(mode, tried, section["keep"]),
        "episodes": episodes,
        "physics_episodes": {"own": episodes},
    }


def _tried(cfg: Cfg, inputs: Inputs, seeds: list[int], level: float | None, behind: WriteBehind) -> Rate:
    """Record episodes of the policy that explores so widely, or of its mode if `level` is None."""
    policy = _scaled(cfg, inputs, 1.0 if level is None else level)
    robot, won = world_spec(cfg).embodiment, list[bool]()
    for tracks in run_recorded(cfg, policy, seeds, stochastic=level is not None):
        behind.write([Episode.from_track(track, "policy-0", robot) for track in tracks])
        won += [bool(track.rows["success"][-1]) for track in tracks]
    return rate_entry(torch.tensor(won))


def _scaled(cfg: Cfg, inputs: Inputs, level: float) -> Any:
    """The policy with its exploration scaled."""
    policy = build_policy(cfg, inputs.weights("policy"))
    policy.scale_exploration(level)
    return policy


def _alarm(mode: Rate, tried: Mapping[float, Rate], keep: float) -> dict[str, str]:
    """What the user must know if no level keeps enough."""
    if not tried:
        return {
            "alarm": f"by its mode the policy succeeds in none of {mode['episodes']} episodes, so how widely"
            " it may explore is not known; give imitation more demonstrations or steps (imitation)"
        }
    narrowest = min(tried)
    if rate(tried[narrowest]) >= keep * rate(mode):
        return {}
    return {
        "alarm": f"even x{narrowest:g} keeps less than {keep:g} of the mode's successes; add narrower ones to"
        " explore.levels"
    }
