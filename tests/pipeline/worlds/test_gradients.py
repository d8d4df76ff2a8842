"""worldloop gradients measures what the stage `rl` would learn from, and learns nothing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from envs.episodes import LeRobotWriter
from envs.targets import ConfigError
from pipeline.commands.worlds.gradients import LAMS, compared, gradients, measured, table
from pipeline.config import load_config
from pipeline.graph.stage import Inputs
from pipeline.stages.given import DATASETS
from pipeline.stages.rl import Imagination, begin, rl
from tests.embodiments import ARM_DELTAS
from tests.moving_square import SIZE, moving_square
from tests.worlds import untrained_world

SQUARE = ("experiment=smoke", "task=lerobot", "task.size=[32,32]", "task.chunk=4", "task.horizon=12")
OPTIONS = ("task.mode=absolute", "launch.device=cpu", "imitation.demos=4")


def begun(folder: Path, *words: str) -> Imagination:
    """What `rl` begins with in a world that has learned nothing, whose policy was deployed in 24 episodes."""
    data, robot = folder / "dataset", ARM_DELTAS
    made = [moving_square(robot, seed, "expert" if seed < 8 else "policy-0") for seed in range(32)]
    LeRobotWriter(data, robot.at(SIZE)).write(made)
    cfg: dict[str, Any] = load_config([*SQUARE, *OPTIONS, f"task.data=[{data}]", *words])
    untrained_world(cfg, folder)
    (folder / "recordings").mkdir()
    (folder / "recordings" / DATASETS).write_text(json.dumps([str(data)]))
    roles: dict[str, Any] = {name: folder / name for name in ("policy", "simulator", "state", "judge")}
    settings = {"number": 1, "iterations": 1}
    inputs = Inputs({**roles, "data": (folder / "recordings",)}, settings)
    return begin(rl.view("rl-1", cfg, settings), inputs)


def test_imagined_and_recorded_decisions_by_lambda(tmp_path: Path) -> None:
    ready = begun(tmp_path)
    before = {name: value.clone() for name, value in ready.policy.state_dict().items()}
    found = measured(ready, 3)
    used = ready.algorithm.config.lam  # type: ignore[attr-defined]
    assert list(found.imagined) == list(found.recorded) == sorted({*LAMS, used})
    decisions = ready.true.decisions
    assert decisions is not None and found.recorded_decisions == len(decisions) // 16 >= 2
    for kind, count in ((found.imagined, 3), (found.recorded, 16)):
        assert all(len(some) == count and some.isfinite().all() and some.any() for some in kind.values())
        assert not torch.equal(kind[0.0], kind[0.95])
    assert all(torch.equal(value, before[name]) for name, value in ready.policy.state_dict().items())
    text = table(compared(found), 3, found.decisions, used)
    assert text.count("(in use)") == 1 and "half signal" in text


def test_an_algorithm_without_lambda_has_one_row(tmp_path: Path) -> None:
    found = measured(begun(tmp_path, "algorithm=grpo", "algorithm.group=2"), 3)
    text = table(compared(found), 3, found.decisions, None)
    assert list(found.imagined) == [None] and not found.recorded and "| none (in use) |" in text


def test_what_cannot_be_asked_is_told(tmp_path: Path) -> None:
    cfg = load_config(["experiment=soak"])
    with pytest.raises(ConfigError, match="3 of them at least"):
        gradients(cfg, tmp_path, 1, 2)
    with pytest.raises(ConfigError, match=r"not come to round 1 .*first `worldloop run`"):
        gradients(cfg, tmp_path, 1, 4)
