"""Success of a policy from the command line, in physics and its variants."""

from __future__ import annotations

from pathlib import Path

import pytest

from envs.targets import ConfigError
from pipeline.commands.evaluate import evaluate_policy
from pipeline.config import load_config

SMALL = ["experiment=smoke", "task=tabletop", "task.suite.cameras=[head]", "task.size=[32,32]"]
FEW = ["evaluate.episodes=4", "evaluate.envs=4", "launch.workers=1", "task.horizon=4"]


def test_a_variant_is_tried_task_by_task(tmp_path: Path) -> None:
    cfg = load_config([*SMALL, *FEW, "task.name=[push,pull]"])
    plain, unseen = (evaluate_policy(cfg, tmp_path, variant=name) for name in ("", "out_of_domain"))
    whole, *tasks = unseen.splitlines()
    assert whole.startswith("actors.policies.vla.ChunkPolicy in physics, out_of_domain: 0/4")
    assert [line.split(":")[0] for line in tasks] == ["  pull", "  push"]
    assert all("0/2" in line and "0 dropped" in line for line in tasks)
    assert plain.startswith("actors.policies.vla.ChunkPolicy in physics: 0/4")


def test_a_variant_that_does_not_exist_is_told_before_anything_starts(tmp_path: Path) -> None:
    cfg = load_config([*SMALL, *FEW])
    with pytest.raises(ConfigError, match=r"variant=out_of_domian .*out_of_domain"):
        evaluate_policy(cfg, tmp_path, variant="out_of_domian")
    with pytest.raises(ConfigError, match=r"variant=swapped is known in physics alone"):
        evaluate_policy(cfg, tmp_path, world="imagined", variant="swapped")
