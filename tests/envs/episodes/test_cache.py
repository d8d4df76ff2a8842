"""What clips are cut from, made once and made again when data change."""

from __future__ import annotations

import errno
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from envs.conditioning import CANVAS, PoseMapStyle, end_effector_poses, render_pose_map
from envs.episodes import LeRobotWriter
from envs.episodes.clips import ClipStore
from envs.episodes.formats.recordings import Cut
from envs.geometry.cameras import follow_wrists
from envs.geometry.kinematics import Kinematics
from envs.specs import WorldSpec
from pipeline.commands.convert import inspect
from tests.arms import two_arms
from tests.embodiments import ARM_DELTAS, BIMANUAL_JOINTS, BIMANUAL_POSES, world_spec
from tests.moving_square import SIZE, moving_square

SPEC = world_spec(BIMANUAL_POSES.at(SIZE), SIZE)


def test_a_cache_is_made_once_and_again_when_the_data_change(dataset: Path, tmp_path: Path) -> None:
    root, cache = tmp_path / "set", tmp_path / "cache"
    shutil.copytree(dataset, root)
    ClipStore([root], SPEC, cache)
    (made,) = cache.glob("*/*/frames.npy")
    before = made.stat().st_mtime_ns, made.stat().st_ino
    assert made.stat().st_blocks * 512 >= made.stat().st_size  # reserved, not sparse
    ClipStore([root], replace(SPEC, chunk=7), cache)  # the length of a chunk changes nothing
    assert (made.stat().st_mtime_ns, made.stat().st_ino) == before
    held = ClipStore([root], SPEC, cache)
    LeRobotWriter(root, BIMANUAL_POSES.at(SIZE)).write([moving_square(BIMANUAL_POSES, 20)])
    assert len(ClipStore([root], SPEC, cache)) == 21
    assert held.frames(torch.tensor([0])).any()  # whoever had the old one open keeps it
    assert len(list(cache.glob("*/*"))) == 1 and not list(cache.glob("*/.*"))


def test_a_cache_sees_rows_behind_links_and_pictures_beside_them(tmp_path: Path) -> None:
    root, bulk, cache = tmp_path / "set", tmp_path / "bulk", tmp_path / "cache"
    LeRobotWriter(root, ARM_DELTAS.at(SIZE)).write([moving_square(ARM_DELTAS, 0)])
    spec = world_spec(ARM_DELTAS.at(SIZE), SIZE)
    (root / "data/chunk-000").rename(bulk)
    (root / "data/chunk-000").symlink_to(bulk)
    (bulk / "round").symlink_to(root / "data")  # as endless as it looks
    assert ClipStore([root], spec, cache).episodes[0]["success"]
    (path,) = bulk.glob("*.parquet")
    table = pq.read_table(path)
    at = table.column_names.index("next.success")
    never = pa.array([False] * len(table))
    pq.write_table(table.set_column(at, "next.success", never), path)
    assert ClipStore([root], spec, cache).episodes[0]["success"] is False
    (made,) = cache.glob("*/*/info.json")
    before = made.stat().st_ino
    (root / "images").mkdir()
    (root / "images/frame-000000.png").write_bytes(b"new")
    ClipStore([root], spec, cache)
    assert made.stat().st_ino != before


def test_poses_are_those_of_commands_where_kinematics_say_them_and_else_the_recorded_ones(
    tmp_path: Path,
) -> None:
    robot = replace(BIMANUAL_JOINTS, kinematics=two_arms(tmp_path)).at(SIZE)
    assert robot.kinematics is not None
    made = moving_square(robot, 0)
    commanded = end_effector_poses(robot, torch.from_numpy(made.commands), Kinematics(robot.kinematics))
    measured = commanded.roll(2, 0) + 0.01  # as of a robot that is late
    LeRobotWriter(tmp_path / "set", robot).write([replace(made, poses=measured.numpy())])
    assert made.c2w is not None and made.intrinsic is not None
    for body, poses in ((robot, commanded), (replace(robot, kinematics=None), measured)):
        spec = WorldSpec(body, SIZE, 4, pose_map=True, ray_map=True)
        store = ClipStore([tmp_path / "set"], spec, tmp_path / "cache")
        c2w = follow_wrists(torch.from_numpy(made.c2w[0]), poses[0], poses, body.wrists)
        assert torch.allclose(store.arrays["c2w"], c2w, atol=1e-6)
        maps = render_pose_map(poses, c2w.transpose(0, 1), torch.from_numpy(made.intrinsic), SIZE)
        drawn = store.pose_maps(torch.arange(len(made)))
        assert torch.equal(drawn, maps.transpose(0, 1)) and bool((drawn != CANVAS).any())
    LeRobotWriter(tmp_path / "bare", robot).write([made])
    (one,), (two,) = (inspect(tmp_path / name, tmp_path, Cut(), PoseMapStyle()) for name in ("set", "bare"))
    assert one.read_bytes() == two.read_bytes()


def test_a_half_made_cache_is_not_used(dataset: Path, tmp_path: Path) -> None:
    ClipStore([dataset], SPEC, tmp_path)
    (marker,) = tmp_path.glob("*/*/info.json")
    marker.write_text(marker.read_text()[:40])
    assert len(ClipStore([dataset], SPEC, tmp_path)) == 20
    assert json.loads(marker.read_text())["episodes"]


def test_data_in_a_folder_that_cannot_be_written(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "read_only" / "set"
    shutil.copytree(dataset, root)
    (tmp_path / "read_only" / ".cache-set").write_text("here no folder can be made")
    monkeypatch.delenv("WORLDLOOP_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    before = sorted((tmp_path / "read_only").rglob("*"))
    assert len(ClipStore([root], SPEC)) == 20
    assert (
        list((tmp_path / "home").rglob("frames.npy"))
        and sorted((tmp_path / "read_only").rglob("*")) == before
    )
    monkeypatch.setenv("WORLDLOOP_CACHE", str(tmp_path / "said"))
    ClipStore([root], SPEC)
    assert list((tmp_path / "said").rglob("frames.npy"))


def test_a_full_disk_is_said_before_anything_is_mapped(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match=r"a cache of 0\.00 GB does not fit.*WORLDLOOP_CACHE"):
        ClipStore([dataset], SPEC, tmp_path)
    assert not list(tmp_path.rglob("*.npy"))
