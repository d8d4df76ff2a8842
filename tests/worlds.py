"""Imagined worlds for commands that look at one: untrained weights in folders, and words that name them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from actors.factory import build_judge, build_policy, build_pool, build_simulator, build_state_decoder
from actors.process import prepare_process
from actors.world_config import world_spec
from envs.episodes import Episode, LeRobotWriter
from envs.episodes.splits import write_splits
from pipeline.graph.artefact import save_weights


def untrained_world(cfg: Mapping[str, Any], root: Path) -> list[str]:
    """Weights of simulator, state expert, judge and policy of a config; words by which `imagined` names the
    first three.
    """
    prepare_process(cfg["seed"], cfg["threads"])
    simulator = build_simulator(cfg)
    with torch.no_grad():
        for parameter in simulator.parameters():
            if not parameter.any():  # what begins at zero, so that training starts gently, would show nothing
                parameter.normal_(std=0.05)
    parts = {
        "simulator": simulator,
        "state": build_state_decoder(cfg, simulator),
        "judge": build_judge(cfg),
        "policy": build_policy(cfg),
    }
    for name, part in parts.items():
        (root / name).mkdir(parents=True, exist_ok=True)
        save_weights(part, root / name)
    return [f"imagined.{name}={root / name}" for name in ("simulator", "state", "judge")]


def scripted_set(
    cfg: Mapping[str, Any], root: Path, count: int, noise_level: float = 0.6, source: str = "noisy"
) -> Path:
    """A data set of scripted episodes of the config's task, all held out, said to be of `source`."""
    robot, pool = world_spec(cfg).embodiment, build_pool(cfg)
    try:
        tracks = pool.script([(seed, noise_level) for seed in range(count)], cfg["task"]["chunk"])
    finally:
        pool.close()
    LeRobotWriter(root, robot).write([Episode.from_track(track, source, robot) for track in tracks])
    write_splits(root, {"train": 0, "held_out": count, "calibration": 0})
    return root


def written(root: Path, name: str) -> Path:
    """The file of that name which a command wrote for the one simulator that was named."""
    (found,) = root.glob(f"simulators/*/{name}")
    return found
