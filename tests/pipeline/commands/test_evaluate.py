"""Success of a policy from the command line, in physics and its variants."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from envs.manifest import write_manifest
from envs.rng import Purpose, episode_seeds
from envs.targets import ConfigError
from pipeline.commands.evaluate import evaluate_policy
from pipeline.config import load_config
from pipeline.loop import build_loop

SMALL = ["experiment=smoke", "task=tabletop", "task.suite.cameras=[head]", "task.size=[32,32]"]
FEW = ["evaluate.episodes=4", "evaluate.envs=4", "launch.workers=1", "task.horizon=4"]


@pytest.mark.long
def test_a_variant_is_tried_task_by_task(tmp_path: Path) -> None:
    cfg = load_config([*SMALL, *FEW, "task.name=[push,pull]"])
    plain, unseen = (evaluate_policy(cfg, tmp_path, variant=name) for name in ("", "out_of_domain"))
    whole, *tasks = unseen.splitlines()
    assert whole.startswith("actors.policies.vla.ChunkPolicy in physics, out_of_domain: 0/4")
    assert [line.split(":")[0] for line in tasks[:-1]] == ["  pull", "  push"]
    assert all("0/2" in line and "0 dropped" in line for line in tasks[:-1])
    assert plain.startswith("actors.policies.vla.ChunkPolicy in physics: 0/4")
    assert "beside the first" not in plain
    kept = Path(unseen.splitlines()[-1])
    assert kept == tmp_path / "evaluations/built-physics-out_of_domain.json"
    found = json.loads(kept.read_text())
    assert (found["successes"], found["episodes"], found["variant"]) == (0, 4, "out_of_domain")
    assert {row["task"] for row in found["each"]} == {"push", "pull"} and found["each"][0]["counted"] is True


def test_it_stands_beside_the_first_policy_on_the_same_episodes(tmp_path: Path) -> None:
    cfg = load_config([*SMALL, *FEW, "task.name=[push,pull]"])
    graph = build_loop(cfg, tmp_path)
    folder, seeds = graph.folder("evaluate-before"), episode_seeds(cfg["seed"], Purpose.EVALUATE, 4)
    folder.mkdir(parents=True)
    first = {"success": torch.tensor([True, False, True, True]), "counted": torch.tensor([1, 1, 1, 0]).bool()}
    torch.save({**first, "seeds": torch.tensor(seeds)}, folder / "outcomes.pt")
    write_manifest(folder, {"stage": "evaluate-before", "key": graph.key("evaluate-before"), "result": {}})
    said = evaluate_policy(cfg, tmp_path)
    assert "beside the first policy on the same 3 episodes: -66.7 points, p 0.5 (0 won, 2 lost)" in said
    other = evaluate_policy({**cfg, "seed": 1}, tmp_path)  # episodes, too
    assert "beside the first" not in other


def test_a_variant_that_does_not_exist_is_told_before_anything_starts(tmp_path: Path) -> None:
    cfg = load_config([*SMALL, *FEW])
    with pytest.raises(ConfigError, match=r"variant=out_of_domian .*out_of_domain"):
        evaluate_policy(cfg, tmp_path, variant="out_of_domian")
    with pytest.raises(ConfigError, match=r"variant=swapped is known in physics alone"):
        evaluate_policy(cfg, tmp_path, world="imagined", variant="swapped")


def test_a_policy_that_was_not_learned_yet_is_told_with_the_command_that_learns_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"policy=rl-1: .* holds none .*first `worldloop stage rl-1` with"):
        evaluate_policy(load_config([*SMALL, *FEW]), tmp_path, "rl-1")
