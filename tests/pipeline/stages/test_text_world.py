"""The stage text_world: where it stands in the graph, and that it trains, hands on and goes on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from actors.factory import build_text_world
from actors.fleets.fleet import EpisodeLedger
from envs.embodiment import Embodiment
from envs.targets import ConfigError
from pipeline.config import load_config
from pipeline.graph.stage import Inputs
from pipeline.loop import build_loop
from pipeline.stages.given import DATASETS
from pipeline.stages.judging import stage as judging
from pipeline.stages.rl import what_the_judge_needs
from tests.embodiments import ARM_DELTAS
from tests.envs.simulators.test_text_world import section


def config(*words: str) -> dict[str, Any]:
    """The smallest experiment, with a judge that asks for a text world."""
    cfg: dict[str, Any] = dict(load_config(["experiment=smoke", *words]))
    return {**cfg, "judge": {**cfg["judge"], "text_world": section()}}


def test_the_graph_has_it_where_the_judge_asks_for_one(tmp_path: Path) -> None:
    plain = build_loop(load_config(["experiment=smoke"]), tmp_path)
    assert not [name for name in plain.nodes if name.startswith("text_world")]
    graph = build_loop(config(), tmp_path)
    roles = {name: node.identity.roles for name, node in graph.nodes.items()}
    assert [name for name in roles if name.startswith("text_world")] == ["text_world-1", "text_world-2"]
    assert roles["judge-2"]["text_world"] == ["text_world-2"]
    assert roles["text_world-2"]["warm"] == ["text_world-1"]
    # the judge's weights hold it from then on
    assert [name for name in roles if "text_world" in roles[name]] == ["judge-1", "judge-2"]


def test_a_text_world_that_never_says_done_is_told_with_what_to_change(
    tiny_data: Callable[[Embodiment], Path], tmp_path: Path
) -> None:
    words = ("judge=golden_goal", "task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]", "task.size=[32,32]")
    cfg = config(*words, "judge.fallback=drop", "task.chunk=4", "task.horizon=8", "launch.device=cpu")
    cfg["judge"]["text_world"] = section(ending={"threshold": 1.0})  # nothing is more certain than that
    (tmp_path / DATASETS).write_text(json.dumps([str(tiny_data(ARM_DELTAS))]))
    settings = {"phase": "first"}
    view = judging.judge.view("judge-1", cfg, settings)
    said = r"no judgement on (\d+) of \1 .*ending\.threshold=1\.0, .*fallback=drop: .*=last_frame or progress"
    with pytest.raises(ConfigError, match=said):
        judging.judge.run(view, tmp_path, Inputs({"data": tmp_path}, settings))
    cfg["judge"]["fallback"] = "last_frame"  # with which no judgement is missing
    made = judging.judge.run(
        judging.judge.view("judge-1", cfg, settings), tmp_path, Inputs({"data": tmp_path}, settings)
    )
    assert made["goals"] == made["goals_unfinished"] and "imagined goals never end" in made["alarm"]
    assert "train it longer (text_world_fit)" in made["alarm"]
    cfg["judge"]["fallback"] = "drop"
    fleet = SimpleNamespace(ledger=EpisodeLedger(dropped={"judge": 3, "physics": 2}))
    assert "judge.fallback=drop: train it longer" in what_the_judge_needs(cfg, fleet)  # type: ignore[arg-type]
    fleet.ledger.drop("physics", 1)
    assert not what_the_judge_needs(cfg, fleet)  # type: ignore[arg-type]


def test_it_trains_and_goes_on_from_what_it_left(
    tiny_data: Callable[[Embodiment], Path], tmp_path: Path
) -> None:
    words = ("task=lerobot", f"task.data=[{tiny_data(ARM_DELTAS)}]", "task.size=[32,32]", "task.chunk=4")
    cfg = config(*words, "task.horizon=8", "launch.device=cpu")
    short = {"steps": 2, "batch": 4, "lr": 1e-3}
    cfg["text_world_fit"] = {"stride": 1, "tokenizer": short, "first": short, "refresh": short}
    data = tmp_path / "recordings"
    data.mkdir()
    (data / DATASETS).write_text(json.dumps([str(tiny_data(ARM_DELTAS))]))
    found: dict[str, Any] = {"data": (data,)}
    stats, learned = {}, {}
    for phase in ("first", "refresh"):
        folder = tmp_path / phase
        folder.mkdir()
        view = judging.text_world.view(phase, cfg, {"phase": phase})
        stats[phase] = judging.text_world.run(view, folder, Inputs(found, {"phase": phase}))
        learned[phase] = build_text_world(cfg, folder / "weights.safetensors").state_dict()
        found["warm"] = folder
    assert stats["first"]["successes"] == stats["refresh"]["successes"] > 0
    assert stats["first"]["ending_max_frames"] == 7  # as the section says
    assert "tokenizer_psnr" in stats["first"] and "tokenizer_psnr" not in stats["refresh"]
    kept = [name for name in learned["first"] if ".codec." in name]
    same = [torch.equal(learned["first"][name], learned["refresh"][name]) for name in kept]
    assert kept and all(same)
    assert any(not torch.equal(value, learned["refresh"][name]) for name, value in learned["first"].items())
