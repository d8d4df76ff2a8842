"""The graph: keys say what a stage reads, finished stages are reused, interrupted ones resume."""

from __future__ import annotations

import errno
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from envs.manifest import DamagedArtefact, read_manifest
from pipeline.commands.verify import verify_run
from pipeline.graph import code_version
from pipeline.graph.code_version import code_of
from pipeline.graph.graph import Graph
from pipeline.graph.stage import Inputs, Stage, stage
from pipeline.graph.view import ConfigView, UndeclaredRead

LOG: list[str] = []
CFG: dict[str, Any] = {"x": 1, "y": {"first": 2, "second": 3}, "other": 4, "launch": {"device": "cpu"}}


@pytest.fixture(autouse=True)
def log() -> Iterator[list[str]]:
    LOG.clear()
    yield LOG


@stage(reads=("x",))
def plain(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    LOG.append(folder.name.rpartition("-")[0])
    return {"x": cfg["x"], "inputs": len(inputs.found)}


@stage(reads=("y.{phase}",))
def phased(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    LOG.append(folder.name.rpartition("-")[0])
    return {"y": cfg["y"][inputs.settings["phase"]]}


@stage(reads=("x",))
def nosy(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    return {"other": cfg.get("other", 0)}


@stage(reads=("x",))
def full_disk(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    raise OSError(errno.ENOSPC, "no space")


@stage(reads=("x",))
def interrupted_once(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    time.sleep(0.2)
    LOG.append("try")
    if len(LOG) == 1:
        raise KeyboardInterrupt
    return {}


def build(root: Path, cfg: dict[str, Any] = CFG) -> Graph:
    graph = Graph(cfg, root)
    graph.add("a", plain)
    graph.add("b", phased, {"data": ("a",)}, phase="first")
    graph.add("c", plain, {"data": ("a", "b"), "warm": None})
    graph.add("d", phased, {"data": "a"}, phase="second")
    return graph


def test_finished_stages_are_reused_and_changed_ones_are_not(tmp_path: Path) -> None:
    build(tmp_path).run()
    build(tmp_path).run()
    assert LOG == ["a", "b", "c", "d"]
    changed = {**CFG, "y": {"first": 5, "second": 3}}
    build(tmp_path, changed).run()
    assert LOG[4:] == ["b", "c"]


def test_only_what_is_needed_runs(tmp_path: Path) -> None:
    build(tmp_path).run("d")
    assert LOG == ["a", "d"]
    with pytest.raises(KeyError, match="no stage e"):
        build(tmp_path).run("e")


def test_a_stage_that_reads_what_it_does_not_declare_fails(tmp_path: Path) -> None:
    graph = Graph(CFG, tmp_path)
    graph.add("a", nosy)
    with pytest.raises(UndeclaredRead, match="stage a reads other"):
        graph.run()


def test_a_view_shows_the_declared_sections_and_the_launch() -> None:
    view = ConfigView(CFG, ("x", "y.first"), "a")
    assert view.plain() == {"x": 1, "y": {"first": 2}, "launch": {"device": "cpu"}}
    assert list(view) == ["x", "y", "launch"] and list(view["y"]) == ["first"]
    with pytest.raises(UndeclaredRead, match=r"y\.second"):
        view["y"]["second"]
    with pytest.raises(UndeclaredRead):
        _ = "other" in view


def test_unrelated_config_and_placement_leave_keys_alone(tmp_path: Path) -> None:
    base = build(tmp_path)
    for other in ({**CFG, "other": 5}, {**CFG, "launch": {"device": "cuda"}}):
        assert all(build(tmp_path, other).key(name) == base.key(name) for name in base.nodes)
    settings = Graph(CFG, tmp_path)
    settings.add("a", plain, number=2)
    assert settings.key("a") != base.key("a")


def test_roles_are_part_of_the_key(tmp_path: Path) -> None:
    keys = []
    for roles in ({"before": "a", "after": "b"}, {"before": "b", "after": "a"}):
        graph = Graph(CFG, tmp_path)
        graph.add("a", plain)
        graph.add("b", plain)
        keys.append((graph.add("c", plain, roles), graph.key("c"))[1])
    assert keys[0] != keys[1]


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Somebody's package outside the repository: a class, and what it imports."""
    root = tmp_path / "code"
    (root / "theirs").mkdir(parents=True)
    (root / "theirs/__init__.py").write_text("")
    (root / "theirs/model.py").write_text("def run():\n    from theirs import part\n    return part.VALUE\n")
    (root / "theirs/part.py").write_text('"""Words."""\nVALUE = 1\n')
    (root / "theirs/unused.py").write_text("VALUE = 1\n")
    monkeypatch.syspath_prepend(str(root))
    yield root / "theirs"
    for name in [name for name in sys.modules if name.startswith("theirs")]:
        del sys.modules[name]


def fresh_key(root: Path, cfg: dict[str, Any]) -> str:
    """A key as another process would find it."""
    for cached in vars(code_version).values():
        if hasattr(cached, "cache_clear"):
            cached.cache_clear()
    return build(root, cfg).key("a")


def test_code_behind_a_target_is_part_of_the_key(tmp_path: Path, package: Path) -> None:
    cfg = {**CFG, "x": {"_target_": "theirs.model.run"}}
    first = fresh_key(tmp_path, cfg)
    (package / "part.py").write_text('"""Other words."""\n# and a remark\nVALUE   = 1\n')
    (package / "unused.py").write_text("VALUE = 2\n")
    assert fresh_key(tmp_path, cfg) == first
    (package / "part.py").write_text("VALUE = 2\n")
    assert fresh_key(tmp_path, cfg) != first


def test_a_description_beside_the_code_is_part_of_the_key(tmp_path: Path, package: Path) -> None:
    cfg = {**CFG, "x": {"_target_": "theirs.model.run"}}
    keys = [fresh_key(tmp_path, cfg)]
    for name in ("robot.xml", "prompt.txt"):
        for content in ("one", "two"):
            (package / name).write_text(content)
            keys.append(fresh_key(tmp_path, cfg))
    assert len(set(keys)) == len(keys)
    (package.parent / "notes.txt").write_text("of somebody")  # is beside a package, and no part of it
    (package / "log.csv").write_text("1")
    assert fresh_key(tmp_path, cfg) == keys[-1]
    assert "envs/physics/tabletop/robot.xml" in code_of("envs.physics.tabletop.scene", {})


@pytest.mark.long
def test_modules_that_lie_beside_somebodys_own_are_part_of_the_key(tmp_path: Path, package: Path) -> None:
    folder = package.parent
    (folder / "theirs_alone.py").write_text(
        "import json, torch\nfrom theirs_beside import part\nfrom theirs_loose import more\n"
        "run, ROBOT = part, 'robot.xml'\n"
    )
    (folder / "theirs_loose").mkdir()  # a package without __init__.py
    (folder / "theirs_beside.py").write_text("from theirs import part\nvalue = 0\n")
    (folder / "theirs_loose/more.py").write_text("value = 0\n")
    (folder / "robot.xml").write_text("one")
    cfg = {**CFG, "x": {"_target_": "theirs_alone.run"}}
    keys = [fresh_key(tmp_path, cfg)]
    for name in ("theirs/part.py", "theirs_beside.py", "theirs_loose/more.py", "robot.xml"):
        (folder / name).write_text("value = 1\n")
        keys.append(fresh_key(tmp_path, cfg))
    assert len(set(keys)) == len(keys)
    (folder / "notes.txt").write_text("which nobody names")
    assert fresh_key(tmp_path, cfg) == keys[-1]
    behind = {Path(name).name for name in code_of("theirs_alone", {})}  # nothing of torch and json
    assert behind == {"theirs_alone.py", "theirs_beside.py", "more.py", "robot.xml"}


def test_stages_say_why_they_will_run_again(tmp_path: Path, package: Path) -> None:
    cfg = {**CFG, "x": {"_target_": "theirs.model.run"}}
    build(tmp_path, cfg).run()
    assert build(tmp_path, cfg).why("c") == ""
    changed = build(tmp_path, {**cfg, "y": {"first": 5, "second": 3}})
    assert "config y.first" in changed.why("b") and "stages b" in changed.why("c")
    assert changed.why("d") == ""
    (package / "part.py").write_text("VALUE = 2\n")
    fresh_key(tmp_path, cfg)
    assert "code" in build(tmp_path, cfg).why("a") and "part.py" in build(tmp_path, cfg).why("a")


def test_the_import_closure_is_that_of_the_stage() -> None:
    collected = code_of("pipeline.stages.collect", {})
    assert "envs/episodes/clips.py" in collected and "envs/embodiment.py" in collected
    assert "learners/rl/ppo.py" not in collected and "pipeline/evaluation/report.py" not in collected
    torch = code_of("envs.ranges", {"policy": {"_target_": "torchrl.modules.vla.TinyVLA"}})
    assert set(torch) == {
        "envs/__init__.py",
        "envs/ranges.py",
    } | {"torchrl"}


def test_a_failed_stage_keeps_the_others(tmp_path: Path) -> None:
    graph = Graph(CFG, tmp_path)
    graph.add("a", plain)
    graph.add("b", full_disk, {"data": "a"})
    for _ in range(2):
        with pytest.raises(OSError):
            graph.run()
    assert LOG == ["a"]


def test_seconds_of_interrupted_attempts_count(tmp_path: Path) -> None:
    graph = Graph(CFG, tmp_path)
    graph.add("a", interrupted_once)
    with pytest.raises(KeyboardInterrupt):
        graph.run()
    assert graph.run()["a"]["seconds"] >= 0.4
    manifest = read_manifest(graph.folder("a"))
    assert manifest is not None and manifest["identity"]["config"].keys() == {"x"}


def test_many_rounds_are_keyed_and_followed_at_once(tmp_path: Path) -> None:
    """Rounds have all earlier ones as ancestors by many ways; a graph that went them all would not end."""
    graph = Graph(CFG, tmp_path)
    for number in range(40):
        graph.add(f"s{number}", plain, {"data": tuple(graph.nodes)})
    graph.add("beside", plain)
    assert len({graph.key(name) for name in graph.nodes}) == 41
    assert len(graph.run("s39")) == 40 and "beside" not in LOG


def test_a_stage_is_found_by_its_path() -> None:
    from pipeline.graph.stage import find_stage
    from pipeline.stages.collect import deploy

    assert isinstance(deploy, Stage) and find_stage(deploy.path) is deploy


@stage(reads=("x",))
def weighty(cfg: ConfigView, folder: Path, inputs: Inputs) -> dict[str, Any]:
    LOG.append("weighty")
    (folder / "weights.safetensors").write_bytes(bytes(range(256)) * 40)
    (folder / "dataset/data").mkdir(parents=True)
    (folder / "dataset/data/file-000.parquet").write_bytes(b"PAR1" * 100)
    (folder / "dataset/.cache").mkdir()
    (folder / "dataset/.cache/frames").write_bytes(b"made anew when it is gone")
    return {}


def flip(path: Path) -> None:
    """One bit of a file."""
    bytes_ = bytearray(path.read_bytes())
    bytes_[len(bytes_) // 2] ^= 1
    path.write_bytes(bytes(bytes_))


def spoil_nothing(folder: Path) -> None:
    (folder / "dataset/.cache/frames").unlink()


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: flip(folder / "weights.safetensors"), r"weights\.safetensors\. Bring"),
        (lambda folder: flip(folder / "dataset/data/file-000.parquet"), r"dataset/data/file-000\.parquet\."),
        (lambda folder: (folder / "weights.safetensors").unlink(), r"weights\.safetensors \(missing\)"),
        (lambda folder: (folder / "manifest.json").write_text("{"), r"manifest\.json\. Bring"),
        (lambda folder: (folder / "manifest.json").write_text("{}"), r"manifest\.json\. Bring"),
        (spoil_nothing, ""),
    ],
)
def test_a_finished_stage_that_has_changed_is_told_and_not_built_upon(
    tmp_path: Path, spoil: Any, said: str
) -> None:
    def graph() -> Graph:
        built = Graph(CFG, tmp_path / "stages")
        built.add("first", weighty)
        built.add("second", plain, {"data": "first"})
        return built

    folder = graph().folder("first")
    graph().run("first")
    spoil(folder)
    if not said:
        graph().run()
        assert LOG == ["weighty", "second"] and "2 stages" in verify_run(tmp_path)
        return
    with pytest.raises(DamagedArtefact, match=said):
        graph().run()
    with pytest.raises(DamagedArtefact, match=said):
        verify_run(tmp_path)
    assert LOG == ["weighty"]
    shutil.rmtree(folder)  # the fix that the message names
    graph().run()
    assert LOG == ["weighty", "weighty", "second"]
