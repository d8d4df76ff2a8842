"""Stages for people: paired videos, and the report."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import torch

from actors.factory import build_policy, build_simulator, open_clips, prepare_process, world_spec
from envs.episodes.clips import ClipStore
from envs.episodes.episode import Episode
from envs.episodes.formats.lerobot_writer import LeRobotWriter
from envs.files import write_text
from envs.simulators.base import Simulator
from envs.simulators.replay import replay
from pipeline.evaluation.media import paired_frames, paired_video, write_gif
from pipeline.evaluation.report import build_report
from pipeline.evaluation.result import build_result
from pipeline.graph.stage import Inputs, stage
from pipeline.stages.collect import run_recorded
from pipeline.stages.given import EVERYTHING, TASK, WORLD, Cfg, open_store
from pipeline.stages.seeds import Purpose, episode_seeds


@stage(reads=(*WORLD, "policy", "measure.videos"))
def videos(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Paired videos of the policies in the roles before and after: in physics, and the same actions in the
    simulator.
    """
    prepare_process(cfg["seed"])
    simulator, robot = build_simulator(cfg, inputs.weights("simulator")), world_spec(cfg).embodiment
    seeds = episode_seeds(cfg["seed"], Purpose.EVALUATE, cfg["measure"]["videos"])
    names = []
    for label in ("before", "after"):
        policy = build_policy(cfg, inputs.weights(label))
        tracks = [track for some in run_recorded(cfg, policy, seeds, stochastic=False) for track in some]
        data = folder / f"dataset-{label}"
        shutil.rmtree(data, ignore_errors=True)
        LeRobotWriter(data, robot).write([Episode.from_track(t, f"policy-{label}", robot) for t in tracks])
        store = open_clips(cfg, [data])
        names += _paired(cfg, folder / "media", simulator, store, torch.arange(len(store)), label)
    return {"videos": names}


@stage(reads=("seed", *TASK, "simulator", "measure.videos"))
def replays(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """Paired videos without physics: recordings, held-out ones if there are any, and their actions in the
    simulator.
    """
    prepare_process(cfg["seed"])
    simulator, store = build_simulator(cfg, inputs.weights("simulator")), open_store(cfg, inputs)
    held = store.split("held_out")
    label, episodes = ("held-out", held) if len(held) else ("learned-from", torch.arange(len(store)))
    chosen = episodes[: cfg["measure"]["videos"]]
    return {"videos": _paired(cfg, folder / "media", simulator, store, chosen, label)}


def _paired(
    cfg: Cfg, folder: Path, simulator: Simulator, store: ClipStore, episodes: torch.Tensor, label: str
) -> list[str]:
    """Write a paired video of each episode, and a GIF of the first; returns the videos' names."""
    names = []
    made = replay(simulator, store, episodes, bf16=cfg["simulator"]["bf16"])
    for number, episode in enumerate(episodes.tolist()):
        row = store.episodes[episode]
        outcome = {True: "success", False: "failure", None: "not labelled"}[row["success"]]
        path = folder / f"{label}-{row['seed']}-{episode}.mp4"
        paired_video(path, paired_frames(store, episodes, made, number, f"{label}: {outcome}"), store.fps)
        names.append(path.name)
        if number == 0:
            frames = paired_frames(store, episodes, made, number, "the same actions")
            write_gif(folder / f"{label}.gif", [*frames, *[frames[-1]] * 8], store.fps)
    return names


@stage(reads=EVERYTHING)
def report(cfg: Cfg, folder: Path, inputs: Inputs) -> dict[str, Any]:
    """result.json and report.html of the whole run, in the run's folder; controls of an older one go."""
    root = folder.parent.parent
    (root / "controls.json").unlink(missing_ok=True)
    result = build_result(cfg, inputs)
    write_text(root / "result.json", json.dumps(result, indent=1, default=float))
    write_text(root / "report.html", build_report(cfg, inputs, result))
    shutil.copy(root / "report.html", folder / "report.html")
    return {"verdict": result["verdict"]}
