"""What `rl` begins with, in a world that has learned nothing."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from envs.episodes import LeRobotWriter
from pipeline.config import load_config
from pipeline.graph.kept import Tensors
from pipeline.graph.stage import Inputs
from pipeline.stages.given import DATASETS
from pipeline.stages.rl import Imagination, begin, rl
from tests.embodiments import ARM_DELTAS
from tests.moving_square import SIZE, moving_square
from tests.worlds import untrained_world

SQUARE = ("experiment=smoke", "task=lerobot", "task.size=[32,32]", "task.chunk=4", "task.horizon=12")
OPTIONS = ("task.mode=absolute", "launch.device=cpu", "imitation.demos=4")


def begun(folder: Path, *words: str) -> tuple[dict[str, Any], Imagination]:
    """What `rl` begins with in a world that has learned nothing, whose policy was deployed in 24 episodes of
    two tasks.
    """
    data, robot = folder / "dataset", ARM_DELTAS
    made = [moving_square(robot, seed, "expert" if seed < 8 else "policy-0") for seed in range(32)]
    told = [replace(one, instruction=f"{one.instruction}, {seed % 2}") for seed, one in enumerate(made)]
    LeRobotWriter(data, robot.at(SIZE)).write(told)
    cfg: dict[str, Any] = load_config([*SQUARE, *OPTIONS, f"task.data=[{data}]", *words])
    untrained_world(cfg, folder)
    (folder / "recordings").mkdir()
    (folder / "recordings" / DATASETS).write_text(json.dumps([str(data)]))
    roles: dict[str, Any] = {name: folder / name for name in ("policy", "simulator", "state", "judge")}
    settings = {"number": 1, "iterations": 1}
    inputs = Inputs({**roles, "data": (folder / "recordings",)}, settings)
    return cfg, begin(rl.view("rl-1", cfg, settings), inputs)


def anew(name: str, about: Mapping[str, Any], make: Callable[[], Tensors]) -> Tensors:
    """Keeps nothing of what is measured."""
    return make()
