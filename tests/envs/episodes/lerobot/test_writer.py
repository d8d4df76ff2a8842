"""What we write: equal after a round trip, in LeRobot's layout, resumable, and never over files of others."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from envs.embodiment import Embodiment
from envs.episodes import Episode, EpisodeError, LeRobotDataset, LeRobotWriter
from envs.episodes.video import read_clip, read_video, write_video
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, BIMANUAL_JOINTS, EMBODIMENTS
from tests.envs.episodes.lerobot.sets import SETS, write_set
from tests.moving_square import SIZE, moving_square
from tests.sampling import every

FIELDS = ("commands", "states", "success", "c2w", "intrinsic", "poses", "present")


def assert_equal(one: Episode, two: Episode, apart: float = 2.0) -> None:
    for name in FIELDS:
        mine, theirs = getattr(one, name), getattr(two, name)
        assert (mine is None) == (theirs is None), name
        assert mine is None or np.array_equal(mine, theirs, equal_nan=True), name
    assert one.embodiment == two.embodiment
    assert (one.instruction, one.seed, one.source) == (two.instruction, two.seed, two.source)
    assert np.abs(one.frames.astype(int) - two.frames).mean() < apart  # the video is compressed


def whole_episode(seed: int = 0) -> Episode:
    """An episode with everything that one may have: an uncalibrated camera, poses, rewards, gaps."""
    made = moving_square(BIMANUAL_JOINTS, seed)
    robot = made.embodiment
    cameras = (robot.cameras[0], replace(robot.cameras[1], calibrated=False), robot.cameras[2])
    assert made.c2w is not None and made.intrinsic is not None
    c2w, intrinsic = made.c2w.copy(), made.intrinsic.copy()
    c2w[:, 1], intrinsic[1] = np.nan, np.nan
    rng, length = np.random.default_rng(seed), len(made)
    present = np.arange(length) != 3
    frames = made.frames.copy()
    frames[3] = 0
    return replace(
        made,
        frames=frames,
        embodiment=replace(robot, cameras=cameras),
        c2w=c2w,
        intrinsic=intrinsic,
        poses=rng.normal(size=(length, 2, 7)).astype(np.float32),
        reward=rng.normal(size=length).astype(np.float32),
        privileged={"objects": rng.normal(size=(length, 2, 4)).astype(np.float32)},
        present=present,
    )


@pytest.mark.parametrize("robot", EMBODIMENTS.values(), ids=list(EMBODIMENTS))
def test_round_trip_of_any_robot(robot: Embodiment, tmp_path: Path) -> None:
    made = [moving_square(robot, seed, length=9 + seed) for seed in range(3)]
    writer = LeRobotWriter(tmp_path / "set", robot.at(SIZE))
    writer.write(made[:2])
    writer.write(made[2:])
    back = list(LeRobotDataset(tmp_path / "set"))
    assert writer.shards == 2 and writer.episodes == len(back) == 3
    for one, two in zip(made, back, strict=True):
        assert_equal(one, two)
        assert two.privileged == {}  # nobody asked for it


def test_round_trip_of_everything(tmp_path: Path) -> None:
    made = whole_episode()
    LeRobotWriter(tmp_path / "set", made.embodiment).write([made])
    (back,) = LeRobotDataset(tmp_path / "set", privileged=True)
    assert_equal(made, back)
    assert made.reward is not None and back.reward is not None
    assert np.array_equal(made.reward[1:], back.reward[1:])
    assert np.array_equal(made.privileged["objects"], back.privileged["objects"])
    small = LeRobotDataset(tmp_path / "set", size=(16, 8)).episode(0)
    assert small.frames.shape[-2:] == (16, 8) and small.intrinsic is not None and made.intrinsic is not None
    assert np.allclose(small.intrinsic[0], made.intrinsic[0] * [[8 / 32], [16 / 32], [1]])


def test_the_layout_is_lerobots(tmp_path: Path) -> None:
    root, made = tmp_path / "set", [whole_episode(seed) for seed in range(3)]
    writer = LeRobotWriter(root, made[0].embodiment)
    writer.write(made[:2])
    writer.write(made[2:])
    info = json.loads((root / "meta/info.json").read_text())
    assert (info["codebase_version"], info["robot_type"], info["fps"]) == ("v3.0", "two_arms_joints", 30)
    counts = {"total_episodes": 3, "total_frames": 39, "total_tasks": 1, "splits": {"train": "0:3"}}
    assert counts.items() <= info.items()
    features = info["features"]
    table = pq.read_table(root / info["data_path"].format(chunk_index=0, file_index=1))
    pictures = {name for name, feature in features.items() if feature["dtype"] == "video"}
    assert set(table.column_names) == set(features) - pictures
    for name in table.column_names:
        kind, shape = table.schema.field(name).type, features[name]["shape"]
        width = kind.list_size if pa.types.is_fixed_size_list(kind) else 1
        assert [width] == shape, name
        assert features[name]["names"] is None or len(features[name]["names"]) == width, name
    shown = {name for name in features if name.startswith(("observation", "action"))}
    assert shown == {
        "action",
        "observation.state",
        *(f"observation.images.{v}" for v in BIMANUAL_JOINTS.views),
    }
    assert table["index"][0].as_py() == 26 and table["timestamp"][3].as_py() == pytest.approx(0.1)
    (row,) = pq.read_table(root / "meta/episodes/chunk-000/file-001.parquet").to_pylist()
    assert (row["data/file_index"], row["dataset_from_index"], row["dataset_to_index"]) == (1, 26, 39)
    assert row["videos/observation.images.head/from_timestamp"] == 0
    assert not any(value is None for value in row.values())
    index = json.loads(pq.read_schema(root / "meta/tasks.parquet").metadata[b"pandas"])["index_columns"]
    assert index == ["task"]


def test_statistics_are_those_of_all_rows(tmp_path: Path) -> None:
    root, made = tmp_path / "set", [whole_episode(seed) for seed in range(3)]
    writer = LeRobotWriter(root, made[0].embodiment)
    writer.write(made[:1])
    writer.write(made[1:])

    def refuse(name: str) -> None:
        raise AssertionError(f"stats.json holds {name}")

    stats = json.loads((root / "meta/stats.json").read_text(), parse_constant=refuse)
    states = np.concatenate([episode.states for episode in made]).astype(np.float64)
    for name, value in (("mean", states.mean(0)), ("std", states.std(0)), ("min", states.min(0))):
        assert np.allclose(stats["observation.state"][name], value, atol=1e-6), name
    assert stats["observation.state"]["count"] == [39]
    # LeRobot keeps the lowest q01 and the highest q99 of all episodes
    lowest = np.min([np.quantile(episode.states, 0.01, axis=0) for episode in made], 0)
    assert np.allclose(stats["observation.state"]["q01"], lowest)
    assert {"q01", "q10", "q50", "q90", "q99"} <= stats["action"].keys()
    head = stats["observation.images.head"]
    assert np.shape(head["mean"]) == np.shape(head["q90"]) == (3, 1, 1) and 0 < head["mean"][0][0][0] < 1
    assert "source" not in stats and stats["next.success"]["max"] == [1.0]


def test_action_is_the_next_command(dataset: Path, episodes: list[Episode]) -> None:
    rows = pq.read_table(dataset / "data/chunk-000/file-000.parquet")
    action = np.array(rows["action"].to_pylist(), np.float32)
    length = len(episodes[0])
    assert np.array_equal(action[: length - 1], episodes[0].commands[1:])
    assert np.array_equal(action[length - 1], episodes[0].commands[-1])


@pytest.mark.parametrize("point", every(3, ["data/", "videos/observation.images.top", "meta/episodes"]))
def test_an_interrupted_shard_is_written_again(point: str, tmp_path: Path) -> None:
    """Power fails while one of a shard's files is written; the collection goes on as if it had not."""
    root = tmp_path / "set"
    script = f"""
import os, sys
from pathlib import Path
from envs.episodes import LeRobotWriter
from envs.episodes.formats.lerobot import writer as lerobot_writer
from tests.embodiments import BIMANUAL_POSES as robot
from tests.moving_square import SIZE, moving_square
writer = LeRobotWriter(Path({str(root)!r}), robot.at(SIZE))
if {point!r} != "meta/episodes":
    writer.write([moving_square(robot, seed) for seed in range(2)])
write = lerobot_writer.write_atomically
def until_the_point(path, part):
    if {point!r} in str(path):
        os._exit(9)
    write(path, part)
lerobot_writer.write_atomically = until_the_point
writer.write([moving_square(robot, seed) for seed in (2, 3)])
"""
    here = Path(__file__).resolve().parents[4]
    ended = subprocess.run(
        [sys.executable, "-c", script], cwd=here, env={**os.environ, "PYTHONPATH": str(here)}
    )
    assert ended.returncode == 9
    robot = EMBODIMENTS["two_arms_poses"]
    writer = LeRobotWriter(root, robot.at(SIZE))
    finished = writer.episodes
    assert finished == (0 if point == "meta/episodes" else 2)
    writer.write([moving_square(robot, seed) for seed in range(finished, 4)])
    assert [episode.seed for episode in LeRobotDataset(root)] == [0, 1, 2, 3]
    data = [path for path in (root / "data").rglob("*.parquet")]
    assert sum(pq.read_metadata(path).num_rows for path in data) == 4 * 13  # LeRobot reads all that lie there
    assert json.loads((root / "meta/info.json").read_text())["total_episodes"] == 4
    assert not list(root.rglob("*writing*")) and not list(root.rglob("*.part"))


def test_the_description_catches_up(dataset: Path, tmp_path: Path) -> None:
    """Power failed after a shard's episodes file and before info.json."""
    root = tmp_path / "set"
    shutil.copytree(dataset, root)
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**info, "total_episodes": 10, "total_frames": 130}))
    LeRobotWriter(root, EMBODIMENTS["two_arms_poses"].at(SIZE))
    assert json.loads((root / "meta/info.json").read_text())["total_episodes"] == 20


def merged(root: Path, made: list[Episode]) -> dict[Path, bytes]:
    """A set of ours as LeRobot's merge leaves it: rows and videos joined into other files than the episodes
    file's own number says, columns in another order, no top-level keys but LeRobot's.
    """
    writer = LeRobotWriter(root, made[0].embodiment)
    for episode in made:
        writer.write([episode])
    rows = [
        pq.read_table(path).to_pylist()[0] for path in sorted((root / "meta/episodes").rglob("*.parquet"))
    ]
    keys = [f"observation.images.{view}" for view in made[0].embodiment.views]
    for key in keys:
        paths = sorted((root / "videos" / key).rglob("*.mp4"))
        joined = np.concatenate([read_video(path) for path in paths]).transpose(0, 2, 3, 1)
        for path in paths:
            path.unlink()
        write_video(paths[0], joined, made[0].embodiment.fps)
    clock = 0.0
    for row in rows:
        for key in keys:
            row[f"videos/{key}/file_index"], length = 0, row["length"] / made[0].embodiment.fps
            row[f"videos/{key}/from_timestamp"], row[f"videos/{key}/to_timestamp"] = clock, clock + length
        clock += row["length"] / made[0].embodiment.fps
        row["meta/episodes/file_index"] = 0
    shutil.rmtree(root / "meta/episodes/chunk-000")
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir()
    pq.write_table(pa.Table.from_pylist([dict(reversed(row.items())) for row in rows]), path)
    return {
        path: path.read_bytes() for path in root.rglob("*.*") if path.is_file() and path.parent.name != "meta"
    }


def test_appending_to_a_merged_set_touches_no_file_of_it(tmp_path: Path) -> None:
    root, made = tmp_path / "set", [whole_episode(seed) for seed in range(4)]
    before = merged(root, made[:3])
    assert len(list((root / "data").rglob("*.parquet"))) == 3 and len(list(root.rglob("*.mp4"))) == 3
    LeRobotWriter(root, made[0].embodiment).write(made[3:])
    assert all(path.read_bytes() == data for path, data in before.items())
    for one, two in zip(made, LeRobotDataset(root), strict=True):
        assert_equal(one, two)
    parts = sorted((root / "meta/episodes").rglob("*.parquet"))
    assert pq.read_schema(parts[0]) == pq.read_schema(parts[1])  # LeRobot reads them as one table
    assert {row["episode_index"] for row in pq.read_table(parts[1]).to_pylist()} == {3}
    info: dict[str, Any] = json.loads((root / "meta/info.json").read_text())
    assert (info["total_episodes"], info["total_frames"]) == (4, 52)


def test_what_does_not_fit_a_set_is_refused(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match=r"another robot.*Choose another folder"):
        LeRobotWriter(dataset, ARM_DELTAS.at(SIZE))
    writer = LeRobotWriter(tmp_path / "set", ARM_DELTAS.at(SIZE))
    writer.write([moving_square(ARM_DELTAS, 0)])
    for other, feature in (
        (moving_square(ARM_DELTAS, 1, labelled=False), r"next\.success"),
        (moving_square(ARM_DELTAS, 1).resized((16, 16)), r"observation\.images"),
        (replace(moving_square(ARM_DELTAS, 1), privileged={}), r"privileged\.object_pose"),
    ):
        with pytest.raises(EpisodeError, match=feature):
            writer.write([other])
    with pytest.raises(EpisodeError, match="another robot"):
        writer.write([moving_square(ARM_JOINTS, 1)])
    assert writer.episodes == 1 and len(list((tmp_path / "set/data").rglob("*.parquet"))) == 1


def test_a_foreign_set_is_not_appended_to_unawares(tmp_path: Path) -> None:
    write_set(tmp_path / "set", SETS["labelled"])
    data = LeRobotDataset(tmp_path / "set")
    writer = LeRobotWriter(tmp_path / "set", data.embodiment)
    with pytest.raises(EpisodeError, match=r"feature command is absent in the data set"):
        writer.write([data.episode(0)])


def test_nan_in_an_episode_is_refused(episodes: list[Episode]) -> None:
    broken = episodes[0].commands.copy()
    broken[2, 3] = np.nan
    with pytest.raises(EpisodeError, match="commands holds NaN"):
        replace(episodes[0], commands=broken)
    with pytest.raises(EpisodeError, match=r"states has shape \(13, 3\)"):
        replace(episodes[0], states=np.zeros((13, 3), np.float32))
    with pytest.raises(EpisodeError, match="camera top is calibrated, but"):
        assert episodes[0].c2w is not None
        replace(episodes[0], c2w=np.full_like(episodes[0].c2w, np.nan))


@pytest.mark.parametrize("fps", [12.5, 29.97, 30.0])
def test_any_frame_rate(fps: float, tmp_path: Path) -> None:
    robot = replace(ARM_DELTAS, fps=fps)
    made = [moving_square(robot, seed) for seed in range(4)]
    LeRobotWriter(tmp_path / "set", robot.at(SIZE)).write(made)
    data = LeRobotDataset(tmp_path / "set")
    assert data.fps == fps
    for one, two in zip(made, data, strict=True):
        assert_equal(one, two)


def test_a_clip_is_read_from_the_middle_of_a_video(tmp_path: Path) -> None:
    frames = np.zeros((90, 32, 32, 3), np.uint8)
    frames += (2 * np.arange(90, dtype=np.uint8))[:, None, None, None]
    write_video(tmp_path / "long.mp4", frames, 12.5)
    clip = read_clip(tmp_path / "long.mp4", 47 / 12.5, 20, 12.5)
    assert np.abs(clip[:, 0, 0, 0].astype(int) - 2 * np.arange(47, 67)).max() <= 1
    with pytest.raises(EpisodeError, match=r"long\.mp4: holds 5 of the 20 frames from 6\.800 s"):
        read_clip(tmp_path / "long.mp4", 85 / 12.5, 20, 12.5)


def test_appending_leaves_files_behind_links_as_they_are(tmp_path: Path) -> None:
    root, robot, bulk = tmp_path / "set", ARM_DELTAS.at(SIZE), tmp_path / "bulk"
    LeRobotWriter(root, robot).write([moving_square(ARM_DELTAS, 0)])
    for number, folder in enumerate(sorted(root.rglob("chunk-000"))):
        bulk.mkdir(exist_ok=True)
        folder.rename(bulk / f"{number}")
        folder.symlink_to(bulk / f"{number}")
    before = {path: path.read_bytes() for path in bulk.rglob("*.*")}
    LeRobotWriter(root, robot).write([moving_square(ARM_DELTAS, 1)])
    assert all(path.read_bytes() == content for path, content in before.items())
    assert [episode.seed for episode in LeRobotDataset(root)] == [0, 1]


def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    """A coder that reads memory nobody wrote gives other pictures each time, and with them other worlds,
    judges and policies.
    """
    rng, frames = np.random.default_rng(5), np.full((40, 64, 64, 3), (155, 122, 108), np.uint8)
    for frame in frames:  # arms that jump
        for x, y, aside in zip((10, 44), rng.integers(40, 56, 2), rng.integers(-6, 7, 2), strict=True):
            frame[y : y + 4, x + aside : x + aside + 10] = (230, 120, 30)
            frame[y + 4 :, x + aside + 3 : x + aside + 7] = (200, 200, 205)
    path, found, held = tmp_path / "video.mp4", set(), []
    for _ in range(20):
        # memory changes hands
        held = [*held[-4:], rng.integers(0, 255, int(rng.integers(1_000, 3_000_000)), dtype=np.uint8)]
        write_video(path, frames, 5)
        found.add(path.read_bytes())
    assert len(found) == 1
