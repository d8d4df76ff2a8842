"""Any LeRobot v3.0 data set opens: robots, cameras, files and labels as LeRobot's software writes them."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from envs.embodiment import ActionKind, Arm, Embodiment
from envs.episodes import EpisodeError, LeRobotDataset
from envs.episodes.clip_spec import ClipSpec
from envs.episodes.clips import ClipStore
from envs.specs import WorldSpec
from tests.envs.episodes.lerobot.sets import LENGTHS, SETS, write_set

SIZE = (48, 64)


@pytest.mark.parametrize("name", SETS)
def test_a_set_as_lerobot_writes_it_opens(name: str, tmp_path: Path) -> None:
    about, root = SETS[name], tmp_path / name
    written = write_set(root, about)
    data = LeRobotDataset(root, SIZE)
    robot = data.embodiment
    assert (robot.robot, robot.fps, len(robot.cameras)) == (about.robot, about.fps, len(about.cameras))
    assert (robot.action_dim, robot.state_dim) == (about.size, about.size)
    assert len(data) == len(LENGTHS)
    for number, (episode, truth) in enumerate(zip(data, written, strict=True)):
        action, state = truth.columns["action"], truth.columns["observation.state"]
        assert np.array_equal(episode.commands[1:], action[:-1])
        first = state[0] if robot.state_names == robot.action_names else action[0]
        assert np.array_equal(episode.commands[0], first)
        assert np.array_equal(episode.states, state)
        assert episode.instruction == truth.task and episode.present.all()
        for view, (key, size) in enumerate(about.cameras.items()):
            shown = np.stack(
                [cv2.resize(f, SIZE[::-1], interpolation=cv2.INTER_AREA) for f in truth.frames[key]]
            )
            if size[0] < SIZE[0]:
                shown = np.stack([cv2.resize(f, SIZE[::-1]) for f in truth.frames[key]])
            apart = np.abs(shown.transpose(0, 3, 1, 2).astype(int) - episode.frames[:, view])
            assert apart.mean((1, 2, 3)).max() < (0.01 if about.kind == "image" and size == SIZE else 4), key
        if about.labelled:
            assert episode.succeeded is (number != 1)
            reward = truth.columns["next.reward"]
            assert episode.reward is not None
            assert episode.reward.sum() == pytest.approx(reward.sum(), abs=1e-5)
        else:
            assert episode.success is None and episode.reward is None and episode.succeeded is None
        assert episode.c2w is None and episode.intrinsic is None and episode.poses is None
    store = ClipStore([root], WorldSpec(robot, (24, 32), chunk=3), tmp_path / "cache")
    clip = store.sample(store.split("train"), 5, ClipSpec(4, 3), torch.Generator().manual_seed(1))
    assert clip["future", "frames"].shape == (5, 3, len(about.cameras), 3, 24, 32)
    assert ("success" in store.arrays) == about.labelled
    assert bool(store.arrays["labelled"].all()) == about.labelled


def test_names_tell_what_actions_are(tmp_path: Path) -> None:
    kinds = {}
    for name in ("single_arm", "aloha", "so101", "many_files"):
        write_set(tmp_path / name, SETS[name])
        kinds[name] = LeRobotDataset(tmp_path / name, SIZE).embodiment
    assert kinds["single_arm"].action_kind is ActionKind.END_EFFECTOR
    assert kinds["aloha"].action_kind is kinds["so101"].action_kind is ActionKind.JOINTS
    assert (
        kinds["aloha"].action_names[7] == "right_waist"
        and kinds["so101"].action_names[0] == "shoulder_pan.pos"
    )
    assert kinds["many_files"].action_kind is ActionKind.OTHER
    poses = {name for name, robot in kinds.items() if robot.commands_poses}
    assert poses == {"single_arm"}  # 14 joints are no two flange poses


ARMS = {
    "single_arm": (Arm("arm", (0, 1, 2, 3, 4, 5), 6),),
    "aloha": (Arm("left", (0, 1, 2, 3, 4, 5), 6), Arm("right", (7, 8, 9, 10, 11, 12), 13)),
    "so101": (Arm("arm", (0, 1, 2, 3, 4), 5, (100.0, 0.0)),),
    "labelled": (Arm("arm", (0, 1, 2, 3, 4, 5), 6),),
    "images": (Arm("arm", (0, 1, 2, 3, 4, 5), 6),),
    "pusht": (),
    "many_files": (),
}


@pytest.mark.parametrize("name", SETS)
def test_names_tell_arms_and_grippers(name: str, tmp_path: Path) -> None:
    write_set(tmp_path, SETS[name])
    assert LeRobotDataset(tmp_path, SIZE).embodiment.arms == ARMS[name]
    info = json.loads((tmp_path / "meta/info.json").read_text())
    info["features"]["action"]["info"] = {
        "worldloop": {"arms": []}
    }  # what is said goes before what is guessed
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    assert LeRobotDataset(tmp_path, SIZE).embodiment.arms == ()


def test_episodes_may_share_files_in_any_way(tmp_path: Path) -> None:
    """Two views whose videos are divided otherwise than the rows, as LeRobot's merge leaves them."""
    root = tmp_path / "set"
    written = write_set(root, SETS["many_files"])
    table = pq.read_table(root / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    key = "observation.images.front"
    old = root / f"videos/{key}/chunk-000/file-001.mp4"
    new = root / f"videos/{key}/chunk-007/file-003.mp4"
    new.parent.mkdir(parents=True)
    old.rename(new)
    for row in table:
        if row[f"videos/{key}/file_index"] == 1:
            row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"] = 7, 3
    pq.write_table(pa.Table.from_pylist(table), root / "meta/episodes/chunk-000/file-000.parquet")
    for episode, truth in zip(LeRobotDataset(root), written, strict=True):
        apart = np.abs(truth.frames[key].transpose(0, 3, 1, 2).astype(int) - episode.frames[:, 0])
        assert apart.mean((1, 2, 3)).max() < 4


def test_path_templates_are_those_of_the_set(tmp_path: Path) -> None:
    root = tmp_path / "set"
    write_set(root, SETS["labelled"])
    before = [episode.frames for episode in LeRobotDataset(root)]
    info = json.loads((root / "meta/info.json").read_text())
    (root / "data").rename(root / "rows")
    info["data_path"] = info["data_path"].replace("data/", "rows/")
    (root / "videos").rename(root / "films")
    info["video_path"] = info["video_path"].replace("videos/", "films/")
    (root / "meta/info.json").write_text(json.dumps(info))
    after = [episode.frames for episode in LeRobotDataset(root)]
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def test_pictures_of_different_sizes_want_one_size(tmp_path: Path) -> None:
    write_set(tmp_path / "set", SETS["single_arm"])
    with pytest.raises(EpisodeError, match="different sizes"):
        LeRobotDataset(tmp_path / "set")


def test_what_the_reader_knows_of_the_robot_counts(tmp_path: Path) -> None:
    """A set without names, read as a robot whose actions are changes: the first command is zero."""
    write_set(tmp_path / "set", SETS["many_files"])
    seen = LeRobotDataset(tmp_path / "set").embodiment
    names = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
    robot: Embodiment = replace(seen, action_names=names, action_kind=ActionKind.END_EFFECTOR, delta=True)
    data = LeRobotDataset(tmp_path / "set", embodiment=robot)
    assert data.embodiment.action_names == names and not data.episode(0).commands[0].any()
    other = replace(robot, fps=30.0)
    with pytest.raises(EpisodeError, match=r"another robot.*fps"):
        LeRobotDataset(tmp_path / "set", embodiment=other)


def test_missing_features_and_versions_are_named(tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match=r"info\.json"):
        LeRobotDataset(tmp_path)
    root = tmp_path / "set"
    write_set(root, SETS["labelled"])
    info = json.loads((root / "meta/info.json").read_text())
    for gone in ("action", "observation.state", "observation.images.front"):
        features = {key: value for key, value in info["features"].items() if key != gone}
        (root / "meta/info.json").write_text(json.dumps({**info, "features": features}))
        with pytest.raises(EpisodeError, match=gone.rsplit(".", 1)[0].replace(".", r"\.")):
            LeRobotDataset(root)
    (root / "meta/info.json").write_text(json.dumps({**info, "codebase_version": "v1.6"}))
    with pytest.raises(EpisodeError, match=r"v1\.6 is none of v3\.0, v2\.0, v2\.1; convert"):
        LeRobotDataset(root)


@pytest.mark.parametrize(
    "name",
    [
        "videos/observation.images.front/chunk-000/file-000.mp4",
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
    ],
)
def test_damage_names_the_file(tmp_path: Path, name: str) -> None:
    root = tmp_path / "set"
    write_set(root, SETS["labelled"])
    path = root / name
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(EpisodeError, match=path.name):
        list(LeRobotDataset(root))
    path.unlink()
    if "episodes" not in name:
        with pytest.raises(EpisodeError, match=path.name):
            list(LeRobotDataset(root))


def test_broken_pictures_and_numbers_are_named(tmp_path: Path) -> None:
    root = tmp_path / "set"
    write_set(root, SETS["images"])
    path = root / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    cells = table["observation.images.front"].to_pylist()
    cells[3] = {"bytes": b"no picture", "path": "frame-000003.png"}
    broken = pa.array(cells, table.schema.field("observation.images.front").type)
    pq.write_table(table.set_column(0, "observation.images.front", broken), path)
    with pytest.raises(EpisodeError, match=r"file-000\.parquet.*frame-000003"):
        LeRobotDataset(root).episode(0)
    at = table.column_names.index("action")
    holes = table["action"].to_pylist()
    holes[3] = [float("nan")] * 7
    nan = pa.array(holes, table.schema.field("action").type)
    pq.write_table(table.set_column(at, "action", nan), path)
    with pytest.raises(EpisodeError, match=r"file-000\.parquet.*commands holds NaN"):
        LeRobotDataset(root).episode(0)


def test_episodes_come_in_order_and_nobody_reads_on_when_nobody_asks(tmp_path: Path) -> None:
    root = tmp_path / "set"
    write_set(root, next(iter(SETS.values())))
    data = LeRobotDataset(root, SIZE)
    for number, episode in enumerate(data):
        assert np.array_equal(episode.frames, LeRobotDataset(root, SIZE).episode(number).frames)
    some = iter(data)
    next(some)
    some.close()  # type: ignore[attr-defined]
    assert not [thread.name for thread in threading.enumerate() if thread.name.startswith("episodes")]
