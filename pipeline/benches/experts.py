"""worldloop bench experts: how often the scripted experts of a suite succeed, task by task."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from actors.factory import available_cores
from envs.episodes.video import write_video
from envs.physics.pool import TaskPool
from envs.physics.suite import task_names
from envs.physics.worker import Track
from pipeline.evaluation.by_task import tasks_of_seeds
from pipeline.evaluation.statistics import rate, rate_entry, rate_line
from pipeline.stages.seeds import Purpose, episode_seeds

LEAST = 0.9  # share of episodes in which an expert must succeed
SHOWN = 3  # failures of a task that are saved as videos
_ZOOM = 4


class ExpertFails(RuntimeError):
    """A scripted expert fails too often on its own task; the message names the seeds and their videos."""


def experts(cfg: dict[str, Any]) -> None:
    """Print each task's success on evaluate.episodes unseen seeds, with Wilson intervals: of the expert, in
    the suite as it is and in each of task.variants, and of behaviour as noisy as collect.noise_level says,
    and random.

    Raises:
        ExpertFails: if an expert succeeds in less than LEAST of its episodes.
    """
    folder, task = Path(cfg["runs"]) / cfg["name"] / "experts", cfg["task"]
    low, high = cfg["collect"]["noise_level"]
    rows = [("expert", {}, 0.0)]
    rows += [(f"expert, {name}", changes, 0.0) for name, changes in task.get("variants", {}).items()]
    rows += [(f"noise {low:g}", {}, low), (f"noise {high:g}", {}, high), ("random", {}, 1.0)]
    wrong = []
    for title, changes, level in rows:
        print(title)
        for name, tracks in _play(cfg, changes, level).items():
            entry = rate_entry(torch.tensor([bool(track.rows["success"][-1]) for track in tracks]))
            steps = [len(track) - 1 for track in tracks if track.rows["success"][-1]]
            print(
                f"  {name:<24} {rate_line(entry)}, {np.median(steps) if steps else 0:.0f} actions", flush=True
            )
            if level == 0.0 and rate(entry) < LEAST:
                wrong.append(_complaint(f"{title}: {name}", tracks, folder, cfg["task"]))
    if wrong:
        raise ExpertFails("; ".join(wrong))


def _play(cfg: Mapping[str, Any], changes: Mapping[str, Any], level: float) -> dict[str, list[Track]]:
    """Scripted episodes by task."""
    task, names = cfg["task"], task_names(cfg["task"]["name"])
    seeds = episode_seeds(0, Purpose.EVALUATE, cfg["evaluate"]["episodes"] * len(names))
    workers = cfg["launch"]["workers"] or available_cores()
    pool = TaskPool({**task["suite"], **changes}, task["name"], workers, task["horizon"], workers)
    try:
        tracks = pool.script([(seed, level) for seed in seeds], task["chunk"])
    finally:
        pool.close()
    of = tasks_of_seeds(cfg, seeds)
    return {name: [track for track, its in zip(tracks, of, strict=True) if its == name] for name in names}


def _complaint(title: str, tracks: list[Track], folder: Path, task: Mapping[str, Any]) -> str:
    failed = [track for track in tracks if not track.rows["success"][-1]]
    paths = list(_videos(title, failed[:SHOWN], folder))
    seeds = ", ".join(str(track.seed) for track in failed[:10]) + (", ..." if len(failed) > 10 else "")
    return (
        f"{title}: the expert fails in {len(failed)} of {len(tracks)} episodes of {task['horizon']} actions"
        f" (seeds {seeds}); see {paths[0].parent}/{paths[0].stem}.mp4"
        + (f" and {len(paths) - 1} more" if len(paths) > 1 else "")
    )


def _videos(title: str, tracks: list[Track], folder: Path) -> Iterator[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    name = "".join(letter if letter.isalnum() else "-" for letter in title)
    for track in tracks:
        rows = [np.concatenate(list(views.transpose(0, 2, 3, 1)), 1) for views in track.rows["frames"]]
        path = folder / f"{name}-{track.seed}.mp4"
        write_video(path, [row.repeat(_ZOOM, 0).repeat(_ZOOM, 1) for row in rows], 5.0, crf=20, browser=True)
        yield path
