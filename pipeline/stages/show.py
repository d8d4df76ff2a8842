"""Stages for people: paired videos, and the report."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from actors.factory import build_judge, build_policy, build_simulator, open_clips
from actors.process import prepare_process
from actors.world_config import world_spec
from envs.episodes.clips import ClipStore
from envs.episodes.episode import Episode
from envs.episodes.filming import write_film, write_gif
from envs.episodes.formats.lerobot.writer import LeRobotWriter
from envs.files import write_json, write_text
from envs.judges.base import Judge
from envs.physics.suite import task_names
from envs.rng import Purpose, episode_seeds
from envs.simulators.base import Simulator
from envs.simulators.replay import replay
from pipeline.evaluation.by_task import evenly
from pipeline.evaluation.disagreement import compared, curves, worst
from pipeline.evaluation.judging import judge_both
from pipeline.evaluation.measurement import followed
from pipeline.evaluation.media import REST, paired_frames
from pipeline.evaluation.report import VIDEOS, build_report
from pipeline.evaluation.result import build_result
from pipeline.graph.stage import Inputs, stage
from pipeline.stages.collect import run_recorded
from pipeline.stages.given import EVERYTHING, WORLD, Cfg, open_store
from pipeline.stages.judging.cost import priced
from pipeline.stages.prove import EPISODES

WORST = "worst"  # the label of episodes chosen for their disagreement


@dataclass
class Studio:
    """What makes paired videos.

    Args:
        cfg: the stage's view of the config.
        folder: of the stage.
        simulator, judge: of the run's last imagined world.
    """

    cfg: Cfg
    folder: Path
    simulator: Simulator
    judge: Judge

    @classmethod
    def of(cls, cfg: Cfg, folder: Path, inputs: Inputs) -> Studio:
        """That of a stage with the roles simulator and judge."""
        shutil.rmtree(folder / "media", ignore_errors=True)
        return cls(
            cfg,
            folder,
            build_simulator(cfg, inputs.weights("simulator")).eval(),
            build_judge(cfg, inputs.weights("judge")).eval(),
        )

    def paired(self, store: ClipStore, episodes: Tensor, label: str) -> Iterator[dict[str, Any]]:
        """Write a paired video of each episode, and a GIF of the first; yields what the report says of each:
        file, label, fps, the row of `compared`, the frames from which on the recording is a success, and
        curves.
        """
        if not len(episodes):
            return
        bf16 = self.cfg["simulator"]["bf16"]
        made = replay(self.simulator, store, episodes, bf16=bf16)
        views = judge_both(self.judge, self.simulator, store, episodes, made, bf16)
        rows = compared(self.cfg, self.judge, store, episodes, made, views)
        for n, row in enumerate(rows):
            path = self.folder / "media" / f"{label}-{row['seed']}-{row['episode']}.mp4"
            frames = paired_frames(store, episodes, made, n)
            write_film(path, frames, store.fps, rest=REST)
            done = store.arrays["success"][made.rows[n]][made.valid[n]].tolist() if row["success"] else []
            yield {
                "file": path.name,
                "label": label,
                "fps": store.fps,
                **row,
                "done": done.index(True) if True in done else None,
                "curves": curves(views, made, n),
            }
            if n == 0:
                write_gif(self.folder / "media" / f"{label}.gif", [*frames, *[frames[-1]] * 8], store.fps)

    def worst(self, inputs: Inputs, store: ClipStore) -> Iterator[dict[str, Any]]:
        """`paired` of those held-out episodes in which imagination and truth disagreed most."""
        rows = json.loads((inputs.folder("measured") / EPISODES).read_text())
        chosen = [row["episode"] for row in worst(rows, self.cfg["measure"]["worst"])]
        return self.paired(store, torch.tensor(chosen, dtype=torch.int64), WORST)

    def keep(self, made: list[dict[str, Any]]) -> dict[str, Any]:
        """Leave what the report says of each video beside them."""
        write_text(self.folder / VIDEOS, json.dumps(made))
        return {"videos": [row["file"] for row in made]}


@stage(reads=(*WORLD, "policy", "measure.videos", "measure.worst"))
@priced
def videos(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Paired videos: held-out episodes in which imagination and truth disagreed most, and of each task some
    of the policies in the roles before and after, in physics, and the same actions in the simulator.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    studio, robot = Studio.of(cfg, folder, inputs), world_spec(cfg).embodiment
    made = list(studio.worst(inputs, open_store(cfg, inputs)))
    count = cfg["measure"]["videos"] * len(task_names(cfg["task"]["name"]))
    seeds = episode_seeds(cfg["seed"], Purpose.EVALUATE, count)
    for label in ("before", "after"):
        policy = build_policy(cfg, inputs.weights(label))
        tracks = [track for some in run_recorded(cfg, policy, seeds, stochastic=False) for track in some]
        data = folder / f"dataset-{label}"
        shutil.rmtree(data, ignore_errors=True)
        LeRobotWriter(data, robot).write([Episode.from_track(t, f"policy-{label}", robot) for t in tracks])
        store = open_clips(cfg, [data])
        made += studio.paired(store, torch.arange(len(store)), label)
    return studio.keep(made)


@stage(reads=(*WORLD, "measure.videos", "measure.worst"))
@priced
def replays(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Paired videos without physics: recordings, held-out ones if there are any, and their actions in the
    simulator, shared out over tasks; first those in which imagination and truth disagreed most.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    studio, store = Studio.of(cfg, folder, inputs), open_store(cfg, inputs)
    held = followed(store, store.split("held_out"))
    every = followed(store, torch.arange(len(store)))
    label, episodes = ("held-out", held) if len(held) else ("learned-from", every)
    made = list(studio.worst(inputs, store))
    made += studio.paired(store, evenly(cfg, store, episodes, cfg["measure"]["videos"]), label)
    return studio.keep(made)


@stage(reads=EVERYTHING)
def report(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """result.json and report.html of the whole run, in the run's folder; controls of an older one go."""
    root = folder.parent.parent
    (root / "controls.json").unlink(missing_ok=True)
    result = build_result(cfg, inputs)
    write_json(root / "result.json", result)
    write_text(root / "report.html", build_report(cfg, inputs, result))
    shutil.copy(root / "report.html", folder / "report.html")
    return {"verdict": result["verdict"]}
