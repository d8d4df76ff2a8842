"""Graph, config, statistics, artefacts, and one tiny run through everything."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch

from actors.factory import ConfigError, build_policy, build_simulator
from learners.training.checkpoint import Checkpoints
from pipeline.artefact import save_weights, write_text
from pipeline.config import load_config
from pipeline.evaluation.report import verdict
from pipeline.evaluation.statistics import confusion, mcnemar, wilson
from pipeline.graph import Graph, Stage
from pipeline.loop import build_loop

ROOT = Path(__file__).resolve().parent.parent.parent


def test_wilson_and_mcnemar_match_published_values() -> None:
    assert wilson(195, 400) == pytest.approx((0.4389, 0.5363), abs=2e-4)
    assert wilson(0, 10)[0] == 0.0 and wilson(0, 0) == (0.0, 1.0)
    before = torch.tensor([False] * 62 + [True] * 19 + [True] * 100)
    after = torch.tensor([True] * 62 + [False] * 19 + [True] * 100)
    result = mcnemar(before, after)
    assert (result["gained"], result["lost"]) == (62, 19) and result["p"] == pytest.approx(1.773e-6, rel=0.01)
    assert mcnemar(before, before)["p"] == 1.0


def test_confusion() -> None:
    said, truth = torch.tensor([True, True, False, False]), torch.tensor([True, False, True, False])
    assert confusion(said, truth) == {"tp": 1, "fp": 1, "fn": 1, "tn": 1, "accuracy": 0.5}


def stage(name: str, parents: tuple[str, ...], config: dict[str, Any], log: list[str]) -> Stage:
    def run(folder: Path, found: dict[str, Path]) -> dict[str, Any]:
        log.append(name)
        return {"n": len(found)}

    return Stage(name, parents, config, run)


def test_finished_stages_are_reused_and_changed_ones_are_not(tmp_path: Path) -> None:
    def build(value: int, log: list[str]) -> Graph:
        graph = Graph(tmp_path)
        graph.add(stage("a", (), {"x": 1}, log))
        graph.add(stage("b", ("a",), {"y": value}, log))
        graph.add(stage("c", ("b",), {}, log))
        graph.add(stage("d", ("a",), {}, log))
        return graph

    log: list[str] = []
    build(1, log).run()
    build(1, log).run()
    assert log == ["a", "b", "c", "d"]
    build(2, log).run()
    assert log[4:] == ["b", "c"]
    build(3, log).run("b")
    assert log[6:] == ["b"]


def test_a_failed_stage_keeps_the_others(tmp_path: Path) -> None:
    log: list[str] = []
    graph = Graph(tmp_path)
    graph.add(stage("a", (), {}, log))

    def fail(folder: Path, found: dict[str, Path]) -> dict[str, Any]:
        raise OSError(errno.ENOSPC, "no space")

    graph.add(Stage("b", ("a",), {}, fail))
    with pytest.raises(OSError):
        graph.run()
    with pytest.raises(OSError):
        graph.run()
    assert log == ["a"]


def test_seconds_of_interrupted_attempts_count(tmp_path: Path) -> None:
    tries: list[int] = []

    def work(folder: Path, found: dict[str, Path]) -> dict[str, Any]:
        tries.append(1)
        time.sleep(0.2)
        if len(tries) == 1:
            raise KeyboardInterrupt
        return {}

    graph = Graph(tmp_path)
    graph.add(Stage("a", (), {}, work))
    with pytest.raises(KeyboardInterrupt):
        graph.run()
    assert graph.run()["a"]["seconds"] >= 0.4


def test_keys_change_with_what_matters_only(tmp_path: Path) -> None:
    base, other = (
        build_loop(load_config(words), tmp_path)
        for words in (["experiment=smoke"], ["experiment=smoke", "evaluate.episodes=30"])
    )
    assert base.key("rl-2") == other.key("rl-2")
    assert base.key("evaluate-after") != other.key("evaluate-after")
    seeded = build_loop(load_config(["experiment=smoke", "seed=1"]), tmp_path)
    assert seeded.key("collect") != base.key("collect")


def test_many_rounds_are_keyed_and_followed_at_once(tmp_path: Path) -> None:
    """Every round has all earlier ones as ancestors by many ways; a graph that went them all would not end."""
    log: list[str] = []
    graph = Graph(tmp_path)
    for number in range(40):
        graph.add(stage(f"s{number}", tuple(graph.stages), {}, log))
    graph.add(stage("beside", (), {}, log))
    assert len({graph.key(name) for name in graph.stages}) == 41
    assert len(graph.run("s39")) == 40 and "beside" not in log


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["rl.learningrate=1"], "learningrate"),
        (["simulator=gan"], "gan"),
        (["task.horizon=41"], r"task\.horizon"),
        (["task.mode=sideways"], r"task\.mode"),
        (["collect.mix.expert=0.9"], r"collect\.mix"),
        (["rounds.deploy=[]"], r"rounds\.deploy"),
    ],
)
def test_config_mistakes_name_the_key(words: list[str], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        load_config(words)


def test_weights_of_another_architecture_are_refused(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke"])
    path = save_weights(build_policy(cfg), tmp_path)
    other = load_config(["experiment=smoke", "policy.width=64"])
    with pytest.raises(ConfigError, match="another architecture"):
        build_policy(other, path)
    with pytest.raises(ConfigError, match="does not exist"):
        build_policy(cfg, tmp_path / "nothing.safetensors")
    with pytest.raises(ConfigError, match=r"simulator\.model"):
        build_simulator({**cfg, "simulator": {**cfg["simulator"], "model": {"depth": 3}}})


def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_text(tmp_path / "a.json", "old")
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"x": torch.ones(3)}, {"step": 1})

    def full(*args: Any, **kwargs: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="disk space"):
        write_text(tmp_path / "a.json", "new")
    with pytest.raises(OSError, match="disk space"):
        checkpoints.save(2, {"x": torch.zeros(3)}, {"step": 2})
    assert (tmp_path / "a.json").read_text() == "old"
    found = {"x": torch.zeros(3)}
    assert checkpoints.load(found) == {"step": 1} and found["x"].tolist() == [1.0, 1.0, 1.0]
    with pytest.raises(RuntimeError, match="another architecture"):
        checkpoints.load({"x": torch.zeros(4)})


def entry(successes: int) -> dict[str, Any]:
    return {"successes": successes, "episodes": 100, "low": 0, "high": 1}


def test_the_verdict_can_say_no_and_why() -> None:
    base = {"physics_before": entry(40), "imagined_before": entry(40), "alarms": [], "rounds": [{"gap": 0.4}]}
    good = verdict({**base, "physics_after": entry(70), "imagined_after": entry(75), "paired": {"p": 1e-6}})
    assert good.startswith("gain")
    fooled = verdict({**base, "physics_after": entry(41), "imagined_after": entry(90), "paired": {"p": 0.9}})
    assert fooled.startswith("no gain") and "exploits" in fooled
    small = verdict({**base, "physics_after": entry(45), "imagined_after": entry(47), "paired": {"p": 0.02}})
    assert "chance" in small and "exploits" not in small
    flat = verdict({**base, "physics_after": entry(39), "imagined_after": entry(40), "paired": {"p": 0.9}})
    assert "iterations" in flat


def worldloop(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "pipeline", *words], cwd=ROOT, capture_output=True, text=True, check=False
    )


def test_command_line() -> None:
    out = worldloop("--help")
    assert out.returncode == 0 and "doctor" in out.stdout
    assert worldloop("fly").returncode == 2
    wrong = worldloop("config", "nope=1")
    assert wrong.returncode == 1 and "nope" in wrong.stderr and "Traceback" not in wrong.stderr


@pytest.mark.slow
def test_the_whole_loop_at_its_smallest(tmp_path: Path) -> None:
    words = ("run", "experiment=smoke", f"runs={tmp_path}", "track=disabled")
    out = worldloop(*words)
    assert out.returncode == 0, out.stderr[-3000:]
    result = json.loads((tmp_path / "smoke/result.json").read_text())
    assert result["physics_before"]["episodes"] == 20 and len(result["rounds"]) == 2
    assert set(result["rollout"]) >= {"expert", "noisy", "random", "on-policy"}
    page = (tmp_path / "smoke/report.html").read_text()
    assert (
        "data:video/mp4" in page
        and "http" not in page.replace("http://www.w3.org", "").split("<h2>Config")[0]
    )
    table = worldloop("compare", str(tmp_path / "smoke"), str(tmp_path / "smoke")).stdout
    assert "| engine; algorithm; seed | unet; ppo; 0 | unet; ppo; 0 |" in table
    missing = worldloop("compare", str(tmp_path))
    assert missing.returncode == 1 and "result.json is not there" in missing.stderr
    again = worldloop(*words)
    assert again.stdout.count("is finished, reused") + again.stderr.count("is finished, reused") == 23
