"""Keys of stages change with what matters, and with nothing else."""

from __future__ import annotations

from pathlib import Path

from pipeline.config import load_config
from pipeline.loop import build_loop


def test_keys_change_with_what_matters_only(tmp_path: Path) -> None:
    def build(*words: str) -> dict[str, str]:
        graph = build_loop(load_config(["experiment=smoke", *words]), tmp_path)
        return {name: graph.key(name) for name in graph.nodes}

    base = build()
    same = {name for name, key in build("evaluate.episodes=30").items() if base[name] == key}
    assert {"rl-2", "measure"} <= same and "evaluate-after" not in same
    same = {name for name, key in build("simulator.width=32").items() if base[name] == key}
    assert {"collect", "imitation", "deploy-1"} <= same and "simulator-1" not in same
    same = {name for name, key in build("simulator_fit.refresh.fit.steps=11").items() if base[name] == key}
    assert {"simulator-1", "rl-1"} <= same and "simulator-2" not in same
    assert build("simulator.ray_map=false")["imitation"] != base["imitation"]
    assert base == build("launch=ray", "track=disabled")
    same = {name for name, key in build("+task.variants={harder: {hold: 1.0}}").items() if base[name] == key}
    assert {"collect", "rl-2", "evaluate-after"} <= same


def test_who_serves_a_judge_leaves_keys_alone(tmp_path: Path) -> None:
    def build(*words: str) -> dict[str, str]:
        model = ("judge=vlm", "judge.chat.model=some")
        graph = build_loop(load_config(["experiment=smoke", *model, *words]), tmp_path)
        return {name: graph.key(name) for name in graph.nodes}

    base = build()
    served = ("judge.chat.url=http://elsewhere:1/v1", "judge.asking.retries=9", "judge.asking.cache=other")
    assert build(*served, "judge.budget.calls=7", "judge.budget.input_price=1.5") == base
    for word in ("judge.chat.model=other", "judge.votes.count=3"):
        same = {name for name, key in build(word).items() if base[name] == key}
        assert {"clone-1", "simulator-1"} <= same and not {"judge-1", "rl-1"} & same, word


def test_the_loop_without_rl_shares_what_comes_before(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke"])
    loop, without = build_loop(cfg, tmp_path), build_loop(cfg, tmp_path, with_rl=False)
    shared = {name for name in without.nodes if without.key(name) == loop.key(name)}
    once = {"collect", "imitation", "deploy-1", "trial-1", "simulator-1", "clone-1", "evaluate-before"}
    assert once <= shared
    assert "rl-1" not in without.nodes and not {"deploy-2", "trial-2", "evaluate-after"} & shared
