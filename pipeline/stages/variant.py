"""Scripted episodes under a variant of the task, such as scenes that nothing has learned from."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from actors.factory import build_pool
from actors.world_config import world_spec
from envs.episodes.episode import Episode
from envs.episodes.formats.lerobot_writer import LeRobotWriter
from envs.rng import Purpose, episode_seeds
from pipeline.graph.stage import Inputs, stage
from pipeline.stages.collect import scripted_jobs
from pipeline.stages.given import ROBOT, Cfg


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
    return {"episodes": len(made), "successes": sum(bool(track.rows["success"][-1]) for track in tracks)}
