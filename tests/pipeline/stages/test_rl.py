"""What RL's stage lets a critic, and then PPO, learn of what physics has told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from actors.factory import build_algorithm, build_policy, open_clips
from envs.embodiment import Embodiment
from pipeline.config import load_config
from pipeline.stages import rl as stages
from pipeline.stages.given import rl_options
from tests.embodiments import ARM_DELTAS

SETTINGS = {"imagined": 0.0, "iterations": 1, "seed": 0, "lr": 1e-4}
SQUARE = ("task=lerobot", "task.size=[32,32]", "task.chunk=4", "task.horizon=12", "task.mode=absolute")


@pytest.mark.parametrize("judge", ["learned", "golden_goal", "vlm"])
def test_true_decisions_are_learned_from_whether_a_judge_learns_by_a_discount_or_not(
    judge: str, tiny_data: Callable[[Embodiment], Path]
) -> None:
    data = tiny_data(ARM_DELTAS)
    words = ("experiment=smoke", f"judge={judge}", "algorithm=ppo", *SQUARE, f"task.data=[{data}]")
    cfg = load_config([*words, "launch.device=cpu"])
    view = stages.rl.view("rl-1", cfg, {"number": 1})
    store = open_clips(view, [data])
    for row in store.episodes:
        row["source"] = "policy-1"
    torch.manual_seed(0)
    policy = build_policy(view)
    algorithm = build_algorithm(view, policy)
    figures, decisions = stages._warm_up(view, policy, algorithm, store, 0, 1)
    assert decisions is not None and figures["recorded_decisions"] == len(decisions) > 10
    assert "critic_knew" in figures and float(decisions.known["advantage"].std()) > 0.05
    learning = rl_options(cfg, **SETTINGS)
    assert not stages.nothing_left(learning, decisions)
    (alarm,) = stages.nothing_left(
        rl_options({**cfg, "rl": {**cfg["rl"], "recorded": 0}}, **SETTINGS), decisions
    )
    assert "nothing but the anchor" in alarm and stages.nothing_left(learning, None) == [alarm]
    assert not stages.nothing_left(rl_options(cfg, **{**SETTINGS, "imagined": 1.0}), None)
