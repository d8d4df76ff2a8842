"""What LeRobot's tools leave of a data set of ours when they delete episodes or split it is read back and
continued.

LeRobot 0.6.1 is not installed here; `left_by_lerobot` lays files out as its delete_episodes and split_dataset
do. docs/lerobot_roundtrip.py runs the tools themselves.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from envs.episodes import Episode, LeRobotDataset, LeRobotWriter
from envs.episodes.formats.lerobot.files import write_tasks
from envs.episodes.splits import write_splits
from envs.episodes.video import read_video
from tests.envs.episodes.lerobot.sets import write_yuv420
from tests.envs.episodes.lerobot.test_writer import assert_equal, whole_episode

SHARDS = ((0, 1, 2), (3,), (4, 5))
# Columns of meta/episodes that LeRobot's tools write, statistics aside; what else was there is gone.
KEPT = ("episode_index", "tasks", "length", "data/", "dataset_from_index", "dataset_to_index", "videos/")


@pytest.fixture(scope="module")
def made() -> list[Episode]:
    return [
        replace(whole_episode(seed), instruction=("lift the cube", "open the drawer")[seed // 3])
        for seed in range(6)
    ]


@pytest.fixture(scope="module")
def ours(made: list[Episode], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes in three shards, with splits and with a column of somebody's own in meta/episodes."""
    root = tmp_path_factory.mktemp("ours") / "set"
    writer = LeRobotWriter(root, made[0].embodiment)
    for shard in SHARDS:
        writer.write([made[number] for number in shard])
    write_splits(root, {"train": 3, "held_out": 2, "calibration": 1})
    for path in (root / "meta/episodes").rglob("*.parquet"):
        table = pq.read_table(path)
        pq.write_table(table.append_column("operator", pa.array(["ann"] * len(table))), path)
    return root


def left_by_lerobot(root: Path, target: Path, keep: Sequence[int]) -> None:
    """A copy of a set with some of its episodes, numbered anew.

    Files keep their numbers, so those of which nothing is kept leave a gap. Videos of which a part is kept
    are encoded anew from time 0, others are copied. meta/episodes is one file with LeRobot's columns alone,
    tasks are those in use, and info.json's splits are one.
    """
    info = json.loads((root / "meta/info.json").read_text())
    paths = sorted((root / "meta/episodes").rglob("*.parquet"))
    rows = [row for path in paths for row in pq.read_table(path).to_pylist()]
    tasks: dict[str, int] = {}
    for number in keep:
        tasks.setdefault(rows[number]["tasks"][0], len(tasks))
    out: list[dict[str, Any]] = []
    for number in keep:
        row = {name: rows[number][name] for name in rows[number] if name.startswith((*KEPT, "stats/"))}
        first = out[-1]["dataset_to_index"] if out else 0
        row |= {"episode_index": len(out), "dataset_from_index": first}
        out.append({**row, "dataset_to_index": first + row["length"]})
    _copy_rows(root, target, keep, rows, out, tasks)
    for key, feature in info["features"].items():
        if feature["dtype"] == "video":
            _copy_videos(root, target, keep, rows, out, key, info["fps"])
    path = target / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True)
    pq.write_table(
        pa.Table.from_pylist(
            [row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0} for row in out]
        ),
        path,
    )
    write_tasks(target / "meta/tasks.parquet", tasks)
    shutil.copy(root / "meta/stats.json", target / "meta/stats.json")
    counts = {
        "total_episodes": len(out),
        "total_frames": out[-1]["dataset_to_index"],
        "total_tasks": len(tasks),
        "splits": {"train": f"0:{len(out)}"},
    }
    (target / "meta/info.json").write_text(json.dumps({**info, **counts}, indent=4))


def _copy_rows(
    root: Path,
    target: Path,
    keep: Sequence[int],
    rows: list[dict[str, Any]],
    out: list[dict[str, Any]],
    tasks: dict[str, int],
) -> None:
    """Rows of the data files, one row group each and in lists of no fixed size, as pandas writes them."""
    renumbered = {number: row for number, row in zip(keep, out, strict=True)}
    for path in sorted((root / "data").rglob("*.parquet")):
        kept = []
        for row in pq.read_table(path).to_pylist():
            new = renumbered.get(row["episode_index"])
            if new is not None:
                index = new["dataset_from_index"] + row["frame_index"]
                task = tasks[rows[row["episode_index"]]["tasks"][0]]
                number = {"episode_index": new["episode_index"], "index": index, "task_index": task}
                kept.append(row | number)
        if kept:
            there = target / path.relative_to(root)
            there.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(pa.Table.from_pylist(kept), there)


def _copy_videos(
    root: Path,
    target: Path,
    keep: Sequence[int],
    rows: list[dict[str, Any]],
    out: list[dict[str, Any]],
    key: str,
    fps: float,
) -> None:
    """One camera's videos, and their times in the rows `out`."""
    for path in sorted((root / "videos" / key).rglob("*.mp4")):
        file = int(path.stem.removeprefix("file-"))
        inside = [number for number, row in enumerate(rows) if row[f"videos/{key}/file_index"] == file]
        kept = [number for number in inside if number in keep]
        there = target / path.relative_to(root)
        if not kept:
            continue
        there.parent.mkdir(parents=True, exist_ok=True)
        if kept == inside:
            shutil.copy(path, there)
            continue
        frames, parts, clock = read_video(path).transpose(0, 2, 3, 1), [], 0.0
        for number in kept:
            row = rows[number]
            first = round(row[f"videos/{key}/from_timestamp"] * fps)
            parts.append(frames[first : first + row["length"]])
            new = out[keep.index(number)]
            new[f"videos/{key}/from_timestamp"] = clock
            clock += row["length"] / fps
            new[f"videos/{key}/to_timestamp"] = clock
        write_yuv420(there, np.concatenate(parts), fps)


def check(root: Path, expected: list[Episode]) -> None:
    """The set holds these episodes, with all that only we know of them."""
    data = LeRobotDataset(root, privileged=True)
    assert len(data) == len(expected)
    for one, two in zip(expected, data, strict=True):
        assert_equal(one, two, 3.0)  # some videos were compressed twice; a frame too late is 12 apart
        assert np.array_equal(one.privileged["objects"], two.privileged["objects"])


@pytest.mark.parametrize(
    "keep", [(0, 2, 4), (1, 2, 5), (0, 1, 2, 4, 5), (4, 5), (3,), (0, 1, 2), (3, 4, 5)], ids=str
)
def test_what_is_kept_is_read_back_and_continued(
    keep: tuple[int, ...], made: list[Episode], ours: Path, tmp_path: Path
) -> None:
    root = tmp_path / "kept"
    left_by_lerobot(ours, root, keep)
    expected = [made[number] for number in keep]
    check(root, expected)
    (listing,) = (root / "meta/episodes").rglob("*.parquet")
    assert "operator" not in pq.read_schema(listing).names
    files = [path for path in root.rglob("*.*") if path.is_file() and path.parent.name != "meta"]
    before = {path: path.read_bytes() for path in files}
    more = replace(whole_episode(9), instruction="put it back")
    LeRobotWriter(root, more.embodiment).write([more])
    assert all(path.read_bytes() == data for path, data in before.items())
    check(root, [*expected, more])
    info = json.loads((root / "meta/info.json").read_text())
    assert info["splits"] == {"train": f"0:{len(keep) + 1}"}
    assert info["total_frames"] == sum(len(episode) for episode in expected) + len(more)


def test_files_that_no_episode_names_are_left_alone(made: list[Episode], ours: Path, tmp_path: Path) -> None:
    """A set whose files were copied whole: rows and videos of deleted episodes still lie there."""
    root = tmp_path / "kept"
    left_by_lerobot(ours, root, (0, 1, 2))
    stray = []
    for folder in ("data", "videos"):
        for path in sorted((ours / folder).rglob("file-00[12].*")):
            there = root / path.relative_to(ours)
            shutil.copy(path, there)
            stray.append((there, path.read_bytes()))
    assert len(stray) == 8
    check(root, made[:3])
    LeRobotWriter(root, made[3].embodiment).write([made[3]])
    check(root, made[:4])
    assert all(path.read_bytes() == data for path, data in stray)
    assert (root / "data/chunk-000/file-003.parquet").exists()


def test_a_set_of_ours_with_a_column_of_somebody_elses_in_its_episodes_is_read_but_not_continued(
    made: list[Episode], ours: Path, tmp_path: Path
) -> None:
    root = tmp_path / "set"
    shutil.copytree(ours, root)
    check(root, made)
    with pytest.raises(ValueError, match=r"columns \['operator'\] that Worldloop cannot fill"):
        LeRobotWriter(root, made[0].embodiment).write(made[:1])
    check(root, made)
