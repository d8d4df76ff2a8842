"""Episodes beside those of the loop: scripted ones under a variant of the task, such as scenes that nothing
has learned from, and a part of the loop's own, for learning from fewer.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from actors.factory import build_pool
from actors.world_config import world_spec
from envs.episodes.episode import Episode
from envs.episodes.formats.lerobot.writer import LeRobotWriter
from envs.episodes.splits import NAMES, keep_in_splits, read_splits
from envs.rng import Purpose, episode_seeds
from pipeline.graph.stage import Inputs, stage
from pipeline.stages.collect import scripted_jobs
from pipeline.stages.given import ROBOT, Cfg, datasets


@stage(reads=(*ROBOT, "collect", "task.variants.{variant}"))
def variant_episodes(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Scripted episodes of evaluation seeds, of the sources and in the mix of the section collect.

    Settings: variant, of task.variants; episodes.
    """
    task, count = cfg["task"], inputs.settings["episodes"]
    suite = {**task["suite"], **task["variants"][inputs.settings["variant"]]}
    section = {**cfg["collect"], "episodes": {"held_out": count}}
    jobs = scripted_jobs({**cfg, "collect": section})
    seeds = episode_seeds(cfg["seed"], Purpose.EVALUATE, count)
    data, robot = folder / "dataset", world_spec(cfg).embodiment
    shutil.rmtree(data, ignore_errors=True)
    pool = build_pool({**cfg, "task": {**task, "suite": suite}})
    try:
        levels = [level for _, level, _ in jobs]
        tracks = pool.script(list(zip(seeds, levels, strict=True)), task["chunk"])
    finally:
        pool.close()
    sources = dict(zip(seeds, (source for *_, source in jobs), strict=True))
    made = [Episode.from_track(track, sources[track.seed], robot) for track in tracks]
    LeRobotWriter(data, robot).write(made)
    return {
        "episodes": len(made),
        "dropped": count - len(made),
        "successes": sum(bool(track.rows["success"][-1]) for track in tracks),
    }


@stage(reads=())
def fewer_episodes(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """The data set of the role `data` with a share of the episodes that are learned from, the first ones,
    which mix all sources as the whole does; the held-out ones are the same.

    Settings: share.
    """
    (whole,), data = datasets(inputs.folders("data")), folder / "dataset"
    shutil.rmtree(data, ignore_errors=True)
    shutil.copytree(whole, data)
    ranges = read_splits(whole)
    for name in ("train", "calibration"):
        ranges[name] = ranges[name][: max(1, round(inputs.settings["share"] * len(ranges[name])))]
    keep_in_splits(data, ranges)
    return {name: len(ranges[name]) for name in NAMES}
