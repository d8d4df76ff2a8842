"""The config: mistakes name the key and the nearest fix before anything starts."""

from __future__ import annotations

from pathlib import Path

import pytest

from envs.targets import ConfigError
from pipeline.config import choices, load_config
from pipeline.loop import build_loop


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["rl.learningrate=1"], r"rl\.learningrate is not a key"),
        (["rl.minibach=1"], r"did you mean rl\.minibatch"),
        (["simulater=dit"], "simulator"),
        (["simulator=gan"], "gan"),
        (["task.horizon=41"], r"task\.horizon"),
        (["task.mode=sideways"], r"task\.mode"),
        (["collect.mix.expert=0.9"], r"collect\.mix"),
        (["rounds.deploy=[]"], r"rounds\.deploy"),
        (["rounds.splits.held_out=0.9"], r"rounds\.splits"),
        (["rl.shards=3"], r"rl\.shards"),
    ],
)
def test_mistakes_name_the_key(words: list[str], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        load_config(words)


@pytest.mark.parametrize("name", choices("experiment"))
def test_every_experiment_composes(name: str, tmp_path: Path) -> None:
    cfg = load_config([f"experiment={name}"])
    graph = build_loop(cfg, tmp_path)
    assert ("tokenizer" in graph.nodes) == ("codec" in cfg["simulator"])


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


def test_the_loop_without_rl_shares_what_comes_before(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke"])
    loop, without = build_loop(cfg, tmp_path), build_loop(cfg, tmp_path, with_rl=False)
    shared = {name for name in without.nodes if without.key(name) == loop.key(name)}
    assert {"collect", "imitation", "deploy-1", "simulator-1", "clone-1", "evaluate-before"} <= shared
    assert "rl-1" not in without.nodes and not {"deploy-2", "evaluate-after"} & shared
