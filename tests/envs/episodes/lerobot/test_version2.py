"""LeRobot v2.1 and v2.0 data sets are read as they lie, and hold what the same episodes hold in v3.0."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from envs.episodes import EpisodeError, LeRobotDataset, LeRobotWriter
from envs.episodes.clip_spec import ClipSpec
from envs.episodes.clips import ClipStore
from envs.episodes.splits import read_splits
from envs.specs import WorldSpec
from tests.envs.episodes.lerobot.sets import LENGTHS, SETS, change_info, write_set

SIZE = (48, 64)
CHUNK = 3  # episodes of a folder: the fourth lies in another one


def as_version2(root: Path, version: str) -> None:
    """Give a v3.0 set, each of whose episodes has files of its own, the layout of v2."""
    info = json.loads((root / "meta/info.json").read_text())
    rows = LeRobotDataset(root, SIZE).rows
    for row in rows:
        index = row["episode_index"]
        for path in sorted(root.glob(f"[dv]*/**/file-{index:03d}.*")):  # data and videos
            kind, *key = path.relative_to(root).parts[:-2]
            place = root / kind / f"chunk-{index // CHUNK:03d}" / "/".join(key)
            place.mkdir(parents=True, exist_ok=True)
            path.rename(place / f"episode_{index:06d}{path.suffix}")
    for name in ("meta/tasks.parquet", "meta/episodes/chunk-000/file-000.parquet"):
        (root / name).unlink()
    told = [{key: row[key] for key in ("episode_index", "tasks", "length")} for row in rows]
    (root / "meta/episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in told))
    tasks = [{"task_index": index, "task": f"task {index}"} for index in range(2)]
    (root / "meta/tasks.jsonl").write_text("".join(json.dumps(row) + "\n" for row in tasks))
    info |= {"codebase_version": version, "chunks_size": CHUNK}
    info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    info["video_path"] = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    (root / "meta/info.json").write_text(json.dumps(info))


def both(folder: Path, name: str, version: str = "v2.1") -> tuple[Path, Path]:
    """The same episodes in v3.0 and in v2."""
    about = replace(SETS[name], files=tuple((0, number) for number in range(len(LENGTHS))))
    new, old = folder / "new", folder / "old"
    for root in (new, old):
        write_set(root, about)
    as_version2(old, version)
    return new, old


@pytest.mark.parametrize("version", ["v2.0", "v2.1"])
@pytest.mark.parametrize("name", [name for name in SETS if name != "many_files"])
def test_both_versions_hold_the_same(name: str, version: str, tmp_path: Path) -> None:
    new, old = (LeRobotDataset(root, SIZE) for root in both(tmp_path, name, version))
    assert old.embodiment == new.embodiment and len(old) == len(new) == len(LENGTHS)
    for mine, theirs in zip(old, new, strict=True):
        assert np.array_equal(mine.frames, theirs.frames) and mine.instruction == theirs.instruction
        assert np.array_equal(mine.commands, theirs.commands) and np.array_equal(mine.states, theirs.states)
        assert mine.succeeded == theirs.succeeded
    assert np.array_equal(old.column("action"), new.column("action"))


def test_it_is_learned_from_and_divided(tmp_path: Path) -> None:
    _, root = both(tmp_path, "so101")
    robot = LeRobotDataset(root, SIZE).embodiment
    store = ClipStore([root], WorldSpec(robot, (24, 32), chunk=3), tmp_path / "cache")
    clip = store.sample(store.split("train"), 5, ClipSpec(4, 3), torch.Generator().manual_seed(1))
    assert clip.shape == (5,)
    change_info(root, lambda info: info.update(splits={"train": "0:3", "val": "3:4"}))
    assert read_splits(root)["held_out"] == [3]


def test_what_is_missing_or_damaged_is_named(tmp_path: Path) -> None:
    _, root = both(tmp_path, "so101")
    robot = LeRobotDataset(root).embodiment
    with pytest.raises(EpisodeError, match=r"appends to nothing else"):
        LeRobotWriter(root, robot)
    (root / "videos/chunk-001/observation.images.up/episode_000003.mp4").unlink()
    data = LeRobotDataset(root)
    assert len(data.episode(2)) == LENGTHS[2]
    with pytest.raises(EpisodeError, match=r"episode_000003\.mp4"):
        data.episode(3)
    told = root / "meta/episodes.jsonl"
    lines = told.read_text().splitlines()
    for wrong in ('{"episode_index": 1}', '{"episode', "[]"):
        told.write_text("\n".join([lines[0], wrong, *lines[2:]]))
        with pytest.raises(EpisodeError, match="line 2"):
            LeRobotDataset(root)
    told.unlink()
    with pytest.raises(EpisodeError, match=r"episodes\.jsonl.*download it again"):
        LeRobotDataset(root)
