"""What RL learns of what physics has told, beside imagined decisions; RL in physics for comparison."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from actors.factory import build_algorithm, build_policy, open_clips
from envs.embodiment import Embodiment
from envs.episodes import LeRobotWriter
from envs.manifest import write_manifest
from pipeline.config import load_config
from pipeline.graph.stage import Inputs
from pipeline.loop import build_loop, deployed_episodes
from pipeline.stages import rl as stages
from pipeline.stages.given import DATASETS, imagined_chunks, rl_options
from pipeline.study.methods import add_rl_in_physics
from pipeline.track import read_metrics
from tests.embodiments import ARM_DELTAS
from tests.moving_square import SIZE, episodes_of
from tests.worlds import untrained_world

SETTINGS = {"imagined": 0.0, "iterations": 1, "seed": 0, "lr": 1e-4}
SQUARE = ("task=lerobot", "task.size=[32,32]", "task.chunk=4", "task.horizon=12", "task.mode=absolute")


@pytest.mark.parametrize("judge", ["learned", "golden_goal", "embedding", "vlm"])
def test_true_decisions_are_learned_from_whatever_measures_progress(
    judge: str, tiny_data: Callable[[Embodiment], Path], tmp_path: Path
) -> None:
    data = tiny_data(ARM_DELTAS)
    words = ("experiment=smoke", f"judge={judge}", "algorithm=ppo", *SQUARE, f"task.data=[{data}]")
    cfg = load_config([*words, "launch.device=cpu"])
    view = stages.rl.view("rl-1", cfg, {"number": 1})
    store = open_clips(view, [data])
    for number, row in enumerate(store.episodes):
        row["source"] = f"policy-{number // 2 % 3}"
    torch.manual_seed(0)
    policy = build_policy(view)
    algorithm = build_algorithm(view, policy)
    manifest = {"stage": "keep", "result": {"round": 1}}
    write_manifest(tmp_path, manifest)  # the policy of round 2 got worse
    inputs = Inputs({"known": tmp_path}, {"number": 2})
    _, _, own = stages._warm_up(view, inputs, policy, algorithm, store, 0)
    every = stages.rl.view("rl-1", {**cfg, "rl": {**cfg["rl"], "recorded_rounds": None}}, {"number": 1})
    figures, _, decisions = stages._warm_up(every, inputs, policy, algorithm, store, 0)
    assert decisions is not None and own is not None and 0 < len(own) < len(decisions)
    assert figures["recorded_decisions"] == len(decisions) > 10
    assert "critic_knew" in figures and float(decisions.known["advantage"].std()) > 0.05
    played = torch.searchsorted(store.start, decisions.known["row"], right=True) - 1
    sources = {store.episodes[number]["source"] for number in played.tolist()}
    assert sources == {"policy-0", "policy-1", "policy-2"}
    for rounds, wanted in ((1, {"policy-1"}), (2, {"policy-0", "policy-1"}), (9, {"policy-0", "policy-1"})):
        chosen = stages.recorded_episodes(store, 1, rounds)
        assert {store.episodes[number]["source"] for number in chosen.tolist()} == wanted
    learning = rl_options(cfg, **SETTINGS)
    assert not stages.nothing_left(learning, decisions)
    (alarm,) = stages.nothing_left(
        rl_options({**cfg, "rl": {**cfg["rl"], "recorded": 0}}, **SETTINGS), decisions
    )
    assert "nothing but the anchor" in alarm and stages.nothing_left(learning, None) == [alarm]
    assert not stages.nothing_left(rl_options(cfg, **{**SETTINGS, "imagined": 1.0}), None)


def test_what_weighs_nothing_is_not_imagined(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "deployed/dataset"
    played = [replace(episode, source="policy-0") for episode in episodes_of(ARM_DELTAS)]
    LeRobotWriter(data, ARM_DELTAS.at(SIZE)).write(played)
    words = ("experiment=smoke", "judge=learned", "algorithm=ppo", *SQUARE, "launch.device=cpu")
    cfg = load_config([*words, f"task.data=[{data}]", "imitation.sources=['*']"])
    untrained_world(cfg, tmp_path)
    roles: dict[str, Any] = {name: tmp_path / name for name in ("policy", "simulator", "state", "judge")}
    for role, result in (("known", {"round": 0}), ("worth", {"worth": {"push": {"value": 0.0}}})):
        write_manifest(tmp_path / role, {"stage": role, "result": result})
        roles[role] = tmp_path / role
    roles["data"] = (tmp_path / "deployed",)
    settings = {"number": 1, "iterations": 2}
    view = stages.rl.view("rl-1", cfg, settings)
    monkeypatch.setattr(stages, "build_fleet", None)  # nobody asks for hosts
    made = stages.rl.run(view, tmp_path / "rl", Inputs(roles, settings))
    assert made["ledger"]["requested"] == made["episodes"] == made["imagined_weight"] == 0
    assert made["recorded_decisions"] > 0 and made["last_updates"] > 0
    assert made["last_transitions"] == cfg["rl"]["envs"] * imagined_chunks(cfg)


@pytest.mark.long
def test_goals_that_hosts_imagine_are_counted(
    tiny_data: Callable[[Embodiment], Path], tmp_path: Path
) -> None:
    data = tiny_data(ARM_DELTAS)
    words = ("experiment=smoke", "judge=golden_goal", *SQUARE, f"task.data=[{data}]", "launch.device=cpu")
    cfg = load_config([*words, "judge.fallback=last_frame", "judge.text_world.ending.threshold=1.0"])
    untrained_world(cfg, tmp_path)
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / DATASETS).write_text(json.dumps([str(data)]))
    roles: dict[str, Any] = {name: tmp_path / name for name in ("policy", "simulator", "state", "judge")}
    settings = {"number": 1, "iterations": 2}
    view = stages.rl.view("rl-1", cfg, settings)
    made = stages.rl.run(
        view, tmp_path / "rl", Inputs({**roles, "data": (tmp_path / "recordings",)}, settings)
    )
    judged = made["ledger"]["judged"]  # nothing is more certain than that, so that no goal ends
    assert judged["goals_unfinished"] == judged["goals"] > 0


@pytest.mark.long
def test_in_physics_it_plays_as_many_episodes_as_are_deployed_and_not_whole_iterations(
    tmp_path: Path,
) -> None:
    words = ("experiment=soak", "track=disabled", "explore.levels=[]", "rounds.trial=3", "algorithm=ppo")
    cfg = load_config([*words, "rl.imagined=0"])  # which is about imagination alone
    graph = build_loop(cfg, tmp_path)
    name = add_rl_in_physics(graph, cfg, "episodes")
    made = graph.run(name)[name]["result"]
    asked = deployed_episodes(cfg)
    assert asked % cfg["rl"]["envs"] == 2
    assert asked <= made["episodes"] == made["physics_episodes"]["own"] <= asked + 2
    rows = read_metrics(graph.folder(name) / "metrics.jsonl")
    assert any(row.get("rl/loss") for row in rows)
