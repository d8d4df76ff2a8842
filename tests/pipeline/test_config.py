"""The config: mistakes name the key and the nearest fix before anything starts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envs.targets import ConfigError
from pipeline.checks import faults
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
        (["+foo=1"], r"foo is not a key"),
        (["name=../../x"], r"name='\.\./\.\./x' should be"),
        (["evaluate.episodes=0"], r"evaluate\.episodes=0 should be greater than or equal to 1"),
        (["track.wandb=of"], r"track\.wandb='of' should be 'offline', 'online' or 'disabled'"),
        (["launch=ray", "launch.actors=-2"], r"launch\.actors=-2"),
        (["launch=ray", "launch.patience.job=0"], r"launch\.patience\.job=0"),
        (["policy.head.std=wide"], r"policy\.head\.std='wide' should be a valid number"),
        (["judge._target_=judges.Mine"], r"judge\._target_=judges\.Mine does not import"),
        (["algorithm=grpo", "rl.envs=40"], r"algorithm\.group"),
        (["imitation.fit.batch=7", "microbatches=2"], r"imitation\.fit: batch=7 must be a multiple of micro"),
        (["collect.noise_level=[0.6,0.1]"], r"collect\.noise_level"),
        (["task=tabletop", "task.suite.scenes=3"], r"task\.suite\.scenes=3"),
        (["task=tabletop", "+task.variants.x={scene: a}"], r"task\.variants\.x\.scene is not an option"),
    ],
)
def test_mistakes_name_the_key(words: list[str], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        load_config(words)


def test_all_mistakes_are_told_at_once() -> None:
    with pytest.raises(ConfigError) as told:
        load_config(["rl.lr=-1", "seed=-3", "task.suite.control_hz=fast", "simulator.width=0"])
    for key in ("rl.lr", "seed", "task.suite.control_hz", "simulator.width"):
        assert f"\n{key}=" in f"\n{told.value}"


WRONG: dict[type, list[Any]] = {
    bool: ["perhaps", None, 3],
    int: ["many", -7, [1], {}],
    float: ["much", [1.0], {}, float("nan")],
    str: [3, {}],
    list: [3, {}, {"a": 1}],
    dict: [3, "none", [1]],
}
FREE = ("simulator.scratch", "policy.policy", "finetune.weights")  # other packages' classes; null or a path


@pytest.mark.parametrize(
    "words",
    [
        ["experiment=quickstart"],
        ["experiment=smoke", "algorithm=grpo", "launch=ray", "policy=chunk_tokens", "simulator=dit_small"],
        ["experiment=smoke", "task=tabletop", "judge=learned"],
        ["simulator=gesim_tiny", "task=metaworld", "algorithm=filtered_bc", "policy=tiny_vla"],
    ],
)
def test_hundreds_of_wrong_values_are_all_found(words: list[str]) -> None:
    """Every value of the config in turn is replaced by values of other types; each is found and named."""
    cfg = load_config(words)
    tried, missed = 0, []
    for path, value in leaves(cfg):
        if value is None or path.startswith(FREE) or path.endswith("_target_"):
            continue
        for wrong in WRONG[type(value)]:
            found = faults(replaced(cfg, path.split("."), wrong))
            tried += 1
            if not any(path in sentence for sentence in found):
                missed.append((path, wrong))
    assert tried > 300
    assert not missed, missed


def leaves(section: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every value and its dotted path; sections are values, too."""
    for key, value in section.items():
        yield f"{prefix}{key}", value
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")


def replaced(section: dict[str, Any], path: list[str], value: Any) -> dict[str, Any]:
    """The config with another value at a path."""
    inner = value if len(path) == 1 else replaced(section[path[0]], path[1:], value)
    return {**section, path[0]: inner}


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
    same = {name for name, key in build("+task.variants={harder: {hold: 1.0}}").items() if base[name] == key}
    assert {"collect", "rl-2", "evaluate-after"} <= same


def test_the_loop_without_rl_shares_what_comes_before(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke"])
    loop, without = build_loop(cfg, tmp_path), build_loop(cfg, tmp_path, with_rl=False)
    shared = {name for name in without.nodes if without.key(name) == loop.key(name)}
    assert {"collect", "imitation", "deploy-1", "simulator-1", "clone-1", "evaluate-before"} <= shared
    assert "rl-1" not in without.nodes and not {"deploy-2", "evaluate-after"} & shared
