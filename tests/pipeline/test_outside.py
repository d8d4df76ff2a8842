"""What comes from outside is known by its content: keys change when it does, and only then."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from envs.targets import ConfigError
from pipeline import outside
from pipeline.commands.finetune import build_finetune
from pipeline.config import load_config
from pipeline.loop import build_loop
from pipeline.outside import fingerprint, option_files
from tests.envs.episodes.lerobot.sets import SETS, write_set

SUCCESS = "next.success"


def relabel(root: Path) -> None:
    """Move an episode's success to another of its frames."""
    (path,) = (root / "data").rglob("*.parquet")
    table = pq.read_table(path)
    labels = table[SUCCESS].to_pylist()
    at = labels.index(True)
    labels[at - 1 : at + 1] = labels[at], labels[at - 1]
    column = table.schema.get_field_index(SUCCESS)
    pq.write_table(table.set_column(column, table.schema.field(column), pa.array(labels)), path)


def reword(root: Path) -> None:
    path = root / "meta/tasks.parquet"
    table = pq.read_table(path)
    column = [n for n, field in enumerate(table.schema) if "int" not in str(field.type)][0]
    words = [text[:-1] + "!" for text in table.column(column).to_pylist()]
    pq.write_table(table.set_column(column, table.schema.field(column), pa.array(words)), path)


def refilm(root: Path) -> None:
    path = next((root / "videos").rglob("*.mp4"))
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("change", [relabel, reword, refilm])
def test_recordings_are_known_by_what_they_hold(change: Callable[[Path], None], tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    write_set(first, SETS["labelled"])
    for path in first.rglob("*.parquet"):
        pq.write_table(pq.read_table(path), path)  # as `relabel` does, so that no size changes
    shutil.copytree(first, second)
    for path in second.rglob("*"):
        os.utime(path, (1, 1))
    (second / ".cache").mkdir()
    (second / ".cache/of_somebody").write_text("")
    assert fingerprint([str(first)]) == fingerprint([str(second)])
    sizes = [path.stat().st_size for path in sorted(second.rglob("*"))]
    change(second)
    if change is not reword:
        assert [path.stat().st_size for path in sorted(second.rglob("*"))] == sizes
    assert fingerprint([str(first)]) != fingerprint([str(second)])


def test_recordings_behind_links_are_known_by_what_they_hold(tmp_path: Path) -> None:
    root, bulk = tmp_path / "set", tmp_path / "bulk"
    write_set(root, SETS["pusht"])
    whole = fingerprint([str(root)])
    (root / "data/chunk-000").rename(bulk)
    (root / "data/chunk-000").symlink_to(bulk)
    assert fingerprint([str(root)]) == whole
    (path,) = bulk.glob("*.parquet")
    table = pq.read_table(path)
    at = table.column_names.index(SUCCESS)
    pq.write_table(table.set_column(at, SUCCESS, pa.array([False] * len(table))), path)
    assert fingerprint([str(root)]) != whole


def test_of_large_tables_with_pictures_the_numbers_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outside, "_WHOLE", 0)
    monkeypatch.setattr(outside, "_COLUMN", 0)
    write_set(tmp_path / "set", SETS["pusht"])
    before = fingerprint([str(tmp_path / "set")])
    assert fingerprint([str(tmp_path / "set")]) == before
    relabel(tmp_path / "set")
    assert fingerprint([str(tmp_path / "set")]) != before
    (path,) = (tmp_path / "set/data").rglob("*.parquet")
    path.write_bytes(b"no table")
    assert fingerprint([str(tmp_path / "set")]) != before  # who reads it says that it is damaged


def test_the_robots_file_that_recordings_name_is_read(tmp_path: Path) -> None:
    write_set(tmp_path / "set", SETS["labelled"])
    info, urdf, found = tmp_path / "set/meta/info.json", tmp_path / "robot.urdf", []
    about = json.loads(info.read_text())
    about["features"]["action"]["info"] = {"worldloop": {"kinematics": {"model": str(urdf)}}}
    info.write_text(json.dumps(about))
    for content in ("short", "longer"):
        urdf.write_text(content)
        found.append(fingerprint([str(tmp_path / "set")]))
    assert found[0] != found[1]


def test_what_is_no_data_set_is_told_by_the_key(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"extra_starts\.data: .*info\.json is missing"):
        fingerprint([str(tmp_path)], "extra_starts.data")


def keys(cfg: Any, root: Path) -> dict[str, str]:
    graph = build_loop(cfg, root)
    return {name: graph.key(name) for name in graph.nodes}


def changed(before: dict[str, str], after: dict[str, str]) -> set[str]:
    assert before.keys() == after.keys()
    return {name for name in before if before[name] != after[name]}


@pytest.mark.parametrize(
    ("key", "same"),
    [
        (
            "simulator.checkpoint",
            {"collect", "imitation", "explore", "deploy-1", "clone-1", "trial-1", "evaluate-before"},
        ),
        ("simulator.kinematics.model", {"collect"}),
    ],
)
def test_files_that_a_config_names_are_known_by_their_content(
    key: str, same: set[str], tmp_path: Path
) -> None:
    cfg = load_config(["experiment=smoke", "simulator=gesim_tiny"])
    named = tmp_path / "named"
    if key == "simulator.checkpoint":
        named.mkdir()
        cfg["simulator"]["checkpoint"], file = str(named), named / "model.safetensors"
    else:
        cfg["simulator"]["kinematics"], file = {"model": str(named), "joints": [], "flanges": []}, named
    file.write_text("one")
    before = keys(cfg, tmp_path)
    assert keys(cfg, tmp_path) == before
    file.write_text("two")
    os.utime(file, (1, 1))
    assert changed(before, keys(cfg, tmp_path)) == before.keys() - same


def test_files_deep_in_a_judges_options_are_known_by_their_content(tmp_path: Path) -> None:
    folder, network = tmp_path / "t5", tmp_path / "alex.pth"
    folder.mkdir()
    cfg = load_config(["experiment=smoke", "judge=golden_goal"])
    cfg["judge"]["metric"] = {"_target_": "envs.judges.lpips.LPIPS", "network": str(network)}
    cfg["judge"]["text_world"]["words"]["folder"] = str(folder)
    for path in (network, folder / "alex.pth", folder / ".hidden"):
        path.write_text("one")
    before = keys(cfg, tmp_path)
    (folder / ".hidden").write_text("another")
    assert keys(cfg, tmp_path) == before
    (folder / "alex.pth").write_text("three")
    assert {"text_world-1", "judge-1", "rl-1"} <= changed(before, keys(cfg, tmp_path))
    before = keys(cfg, tmp_path)
    network.write_text("three")
    metric = changed(before, keys(cfg, tmp_path))
    assert {"judge-1", "rl-1"} <= metric and not metric & {"text_world-1", "clone-1", "simulator-1"}


@pytest.mark.parametrize(
    ("key", "same"),
    [
        ("task.suite.cameras", set()),
        ("policy.head.file", {"collect"}),
        ("algorithm.teacher", {"collect", "imitation", "simulator-1", "judge-1", "gap-1"}),
        ("simulator.table", {"collect", "imitation", "deploy-1"}),
    ],
)
@pytest.mark.parametrize("folder", [False, True])
def test_files_that_options_name_are_known_by_their_content(
    key: str, same: set[str], folder: bool, tmp_path: Path
) -> None:
    cfg = load_config(["experiment=smoke"])
    *around, last = key.split(".")
    inner: Any = cfg
    for part in around:
        inner = inner[part]
    named = file = tmp_path / "weights"
    if folder:
        named.mkdir()
        file = named / "model.bin"
    inner[last] = [str(named)]
    file.write_text("one")
    before, graph = keys(cfg, tmp_path), build_loop(cfg, tmp_path)
    assert keys(cfg, tmp_path) == before
    file.write_text("three")
    now = keys(cfg, tmp_path)
    assert {"rl-1", "evaluate-after"} <= changed(before, now) and not same & changed(before, now)
    if key == "task.suite.cameras":
        assert changed(before, now) >= {"collect", "imitation", "simulator-1"}
        old, new = (one.nodes["collect"].identity for one in (graph, build_loop(cfg, tmp_path)))
        assert new.changed(asdict(old)).endswith("ran: config files of task.suite")


def test_a_word_that_a_folder_happens_to_have_as_its_name_names_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "head").mkdir()
    for name in ("head/log", "push.txt"):
        (tmp_path / name).write_text("one")
    monkeypatch.chdir(tmp_path)
    assert option_files("task.suite", {"cameras": ["head"]}) == {}
    assert option_files("task.suite", {"words": f"{tmp_path}/head"}).keys() == {"log"}
    assert option_files("task.suite", {"words": "push.txt"}).keys() == {"push.txt"}


def test_a_robots_own_kinematics_are_known_by_their_source(tmp_path: Path) -> None:
    cfg = load_config(["experiment=smoke"])
    marks = []
    for name in ("examples.agibot_kinematics.solve", "examples.judge.solve"):
        cfg["simulator"]["kinematics"] = {"model": f"python:{name}"}
        marks.append(build_loop(cfg, tmp_path).nodes["imitation"].settings["files"])
    assert marks[0] != marks[1] and all(all(mark.values()) for mark in marks)


def test_finetuning_knows_the_weights_that_it_goes_on_from(tmp_path: Path) -> None:
    weights, data = tmp_path / "before.safetensors", tmp_path / "set"
    write_set(data, SETS["single_arm"])
    found = []
    for content in ("one", "three"):
        weights.write_text(content)
        cfg = load_config(
            [
                *("experiment=smoke", "task=lerobot", f"finetune.data=[{data}]", f"task.data=[{data}]"),
                *("task.size=[32,48]", "task.chunk=2", f"finetune.weights={weights}"),
            ]
        )
        found.append(build_finetune(cfg, tmp_path).key("simulator"))
    assert found[0] != found[1]


def test_nothing_from_outside_leaves_keys_alone(tmp_path: Path) -> None:
    graph = build_loop(load_config(["experiment=smoke"]), tmp_path)
    assert not [name for name, node in graph.nodes.items() if "files" in node.settings]
