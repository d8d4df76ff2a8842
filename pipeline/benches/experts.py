"""worldloop bench experts: how often the scripted experts of a suite succeed, task by task."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from actors.factory import build_pool
from actors.world_config import embodiment_of
from envs.episodes.filming import side_by_side, write_film
from envs.physics.suite import task_names
from envs.physics.worker import Track
from envs.rng import Purpose, episode_seeds
from pipeline.evaluation.by_task import tasks_of_seeds
from pipeline.evaluation.statistics import rate, rate_entry, rate_line
from pipeline.loop import check_physics
from pipeline.stages.collect import LEAST

SHOWN = 3  # failures of a task that are saved as videos
_AT_ONCE = 64  # episodes, whose frames are held in memory


class ExpertFails(RuntimeError):
    """A scripted expert fails too often on its own task; the message names the seeds and their videos."""


@dataclass
class Outcomes:
    """What came of the scripted episodes of one task.

    Args:
        success: of each episode.
        actions: of those that succeeded.
        failed: some of the others, recorded.
        seeds: of all others.
        dropped: episodes that physics did not bring to an end; they count for nothing.
    """

    success: list[bool] = field(default_factory=list)
    actions: list[int] = field(default_factory=list)
    failed: list[Track] = field(default_factory=list)
    seeds: list[int] = field(default_factory=list)
    dropped: int = 0

    def add(self, track: Track) -> None:
        """Count an episode."""
        self.success.append(bool(track.rows["success"][-1]))
        if self.success[-1]:
            self.actions.append(len(track) - 1)
        else:
            self.seeds.append(track.seed)
            self.failed = [*self.failed, track][:SHOWN]


def experts(cfg: dict[str, Any]) -> None:
    """Print each task's success on evaluate.episodes unseen seeds, with Wilson intervals, and how many were
    dropped: of the expert, in the suite as it is and in each of task.variants, and of behaviour as noisy as
    collect.noise_level says, and random.

    Raises:
        ConfigError: if the task has no physics.
        ExpertFails: if an expert succeeds in less than LEAST of its episodes.
    """
    check_physics(cfg, "bench experts")
    low, high = cfg["collect"]["noise_level"]
    rows: list[tuple[str, Mapping[str, Any], float]] = [("expert", {}, 0.0)]
    rows += [(f"expert, {name}", changes, 0.0) for name, changes in cfg["task"].get("variants", {}).items()]
    rows += [(f"noise {low:g}", {}, low), (f"noise {high:g}", {}, high), ("random", {}, 1.0)]
    wrong = []
    for title, changes, level in rows:
        print(title)
        for name, outcomes in _play(cfg, changes, level).items():
            entry = rate_entry(torch.tensor(outcomes.success))
            actions = f", {np.median(outcomes.actions):.0f} actions" if outcomes.actions else ""
            print(f"  {name:<24} {rate_line(entry)}, {outcomes.dropped} dropped{actions}", flush=True)
            if level == 0.0 and (rate(entry) or 0.0) < LEAST:
                wrong.append(_complaint(f"{title}: {name}", outcomes, cfg))
    if wrong:
        raise ExpertFails("; ".join(wrong))


def _play(cfg: Mapping[str, Any], changes: Mapping[str, Any], level: float) -> dict[str, Outcomes]:
    """Scripted episodes by task."""
    task, names = cfg["task"], task_names(cfg["task"]["name"])
    seeds = episode_seeds(0, Purpose.EVALUATE, cfg["evaluate"]["episodes"] * len(names))
    pool = build_pool(cfg, changes)
    out = {name: Outcomes() for name in names}
    try:
        for begin in range(0, len(seeds), _AT_ONCE):
            part = seeds[begin : begin + _AT_ONCE]
            tracks = pool.script([(seed, level) for seed in part], task["chunk"])
            played = tasks_of_seeds(cfg, (track.seed for track in tracks))
            for name, track in zip(played, tracks, strict=True):
                out[name].add(track)
        for name in tasks_of_seeds(cfg, pool.lost):
            out[name].dropped += 1
    finally:
        pool.close()
    return out


def _complaint(title: str, outcomes: Outcomes, cfg: Mapping[str, Any]) -> str:
    """Which seeds fail, after their videos are saved."""
    folder = Path(cfg["runs"]) / cfg["name"] / "experts"
    name = re.sub(r"\W+", "-", title)
    paths = [folder / f"{name}-{track.seed}.mp4" for track in outcomes.failed]
    fps = embodiment_of(cfg).fps
    for path, track in zip(paths, outcomes.failed, strict=True):
        write_film(path, side_by_side(np.stack(track.rows["frames"])), fps)
    seeds = ", ".join(map(str, outcomes.seeds[:10])) + (", ..." if len(outcomes.seeds) > 10 else "")
    return (
        f"{title}: the expert fails in {len(outcomes.seeds)} of {len(outcomes.success)} episodes of"
        f" {cfg['task']['horizon']} actions (seeds {seeds}); watch {', '.join(map(str, paths))}"
    )
