"""How fast a world learns is measured when all it does has been done once: compiled, and tuned to shapes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes import LeRobotWriter
from envs.simulators.unet.engine import UNetSimulator
from pipeline.config import load_config
from pipeline.graph.stage import Inputs
from pipeline.stages.given import DATASETS
from pipeline.stages.pace import pace
from tests.embodiments import ARM_DELTAS
from tests.moving_square import SIZE, moving_square

MEASURED = 8


class Watched(UNetSimulator):
    """A world that remembers what it was asked to learn from: frames of the clips of each step."""

    asked: ClassVar[list[int]] = []

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """See Simulator.loss."""
        self.asked.append(clip["future", "frames"].shape[1])
        return super().loss(clip, generator)


def test_what_is_measured_has_been_done_before(tmp_path: Path) -> None:
    Watched.asked.clear()
    data = tmp_path / "data"
    LeRobotWriter(data, ARM_DELTAS.at(SIZE)).write([moving_square(ARM_DELTAS, seed) for seed in range(4)])
    (tmp_path / DATASETS).write_text(json.dumps([str(data)]))
    words = ("task=lerobot", f"task.data=[{data}]", "task.size=[32,32]", "task.chunk=4", "task.horizon=8")
    cfg = load_config(
        ["experiment=smoke", *words, "simulator._target_=tests.pipeline.study.test_pace.Watched"]
        + [f"equal_time={{seconds: 5, measured: {MEASURED}}}", "launch.device=cpu"]
    )
    out = pace.run(pace.view("pace", cfg, {}), tmp_path, Inputs({"data": (tmp_path,)}))
    assert out["simulator_speed"] > 0 and out["state_sample_seconds"] > 0
    before, measured = Watched.asked[:MEASURED], Watched.asked[MEASURED:]
    assert measured == before and len(set(before)) == 2  # some unroll
