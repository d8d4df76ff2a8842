"""RL in physics for comparison with the loop: by as many episodes as that deploys."""

from __future__ import annotations

from pathlib import Path

from pipeline.config import load_config
from pipeline.loop import build_loop, deployed_episodes
from pipeline.study.methods import add_rl_in_physics
from pipeline.track import read_metrics


def test_it_plays_as_many_episodes_as_are_deployed_and_not_whole_iterations(tmp_path: Path) -> None:
    words = ("experiment=soak", "track=disabled", "explore.levels=[]", "rounds.deploy=[5]", "algorithm=ppo")
    cfg = load_config([*words, "rl.imagined=0"])  # which is about imagination alone
    graph = build_loop(cfg, tmp_path)
    name = add_rl_in_physics(graph, cfg, "episodes")
    made = graph.run(name)[name]["result"]
    asked = deployed_episodes(cfg)
    assert asked % cfg["rl"]["envs"] == 2
    assert asked <= made["episodes"] == made["physics_episodes"]["own"] <= asked + 2
    rows = read_metrics(graph.folder(name) / "metrics.jsonl")
    assert any(row.get("rl/loss") for row in rows)
