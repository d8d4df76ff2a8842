"""Real recordings become Episodes without loss of calibration, and their pose maps are the public ones."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from envs.conditioning import PoseMapStyle, render_pose_map
from envs.episodes import EpisodeError, LeRobotDataset
from envs.episodes.clips import ClipSpec, ClipStore, pose_maps_of
from envs.episodes.formats.foreign import Cut, read_foreign
from envs.episodes.video import write_video
from envs.layouts import CommandLayout
from pipeline.convert import convert, inspect


def test_the_bundles_pose_maps_are_the_golden_ones(shared: Path) -> None:
    (episode,) = read_foreign(shared / "data/gesim_v2")
    golden = np.load(shared / "golden/pose_map_gesim_v2_demo_000.npz")
    at = golden["frame_indices"]
    assert len(episode) == 456 and episode.seen.sum() == 1 and episode.recorded_layout == "joints"
    maps = render_pose_map(
        torch.from_numpy(episode.commands[at]),
        torch.from_numpy(episode.c2w[at]).transpose(0, 1),
        torch.from_numpy(episode.intrinsic),
    )
    assert np.array_equal(maps.numpy(), golden["pose_map_uint8"].transpose(1, 2, 0, 3, 4))
    assert np.allclose(episode.states[0, [7, 15]], 0.2173, atol=1e-3)  # grippers stand beside their arms now


def test_to_lerobot_and_back_keeps_calibration(shared: Path, tmp_path: Path) -> None:
    cut = Cut(frames=12, size=(48, 64))
    assert convert(shared / "data/gesim_v2", tmp_path / "lerobot", cut) == 1
    (source,), (there,) = (
        list(read_foreign(shared / "data/gesim_v2", cut)),
        list(LeRobotDataset(tmp_path / "lerobot")),
    )
    for name in ("c2w", "intrinsic", "commands", "achieved", "states", "recorded", "seen"):
        assert np.array_equal(getattr(there, name), getattr(source, name)), name
    assert there.instruction == source.instruction and there.recorded_layout == "joints"
    assert convert(tmp_path / "lerobot", tmp_path / "bundles", Cut()) == 1
    (back,) = read_foreign(tmp_path / "bundles")
    for name in ("c2w", "intrinsic", "commands", "achieved", "states", "recorded"):
        assert np.array_equal(getattr(back, name), getattr(source, name)), name
    with pytest.raises(EpisodeError, match="not empty"):
        convert(tmp_path / "lerobot", tmp_path / "bundles", Cut())


def test_joint_commands_are_what_a_store_gives_a_joint_world(
    shared: Path, dataset: Path, tmp_path: Path
) -> None:
    convert(shared / "data/gesim_v2", tmp_path / "lerobot", Cut(frames=12, size=(48, 64)))
    store = ClipStore([tmp_path / "lerobot"], CommandLayout.JOINTS)
    clip = store.clips(torch.tensor([0]), torch.tensor([0]), ClipSpec(4, 5))
    # nobody saw those frames
    assert clip["future", "commands"].shape == (1, 5, 16) and not clip["future", "valid"].any()
    with pytest.raises(EpisodeError, match=r"simulator\.layout=joints"):
        ClipStore([dataset], CommandLayout.JOINTS)


def test_scaled_intrinsics_see_the_same(shared: Path) -> None:
    (whole,), (small,) = (
        list(read_foreign(shared / "data/gesim_v2", Cut(frames=2, size=size))) for size in ((), (192, 256))
    )
    big = pose_maps_of(whole, torch.from_numpy(whole.c2w)).float()
    half = pose_maps_of(small, torch.from_numpy(small.c2w)).float()
    shrunk = torch.nn.functional.avg_pool2d(big.flatten(0, 1), 2).unflatten(0, big.shape[:2])
    assert (shrunk - half).abs().mean() < 4.0


def test_gesim_1_bundle(shared: Path, tmp_path: Path) -> None:
    (episode,) = read_foreign(shared / "data/gesim_v1")
    assert (
        episode.frames.shape == (300, 3, 3, 480, 640)
        and episode.seen.sum() == 4
        and np.isnan(episode.states).all()
    )
    assert episode.commands[:, [6, 13]].min() >= 0 and episode.commands[:, 13].max() == pytest.approx(
        (117.1111 - 35) / 85, abs=1e-3
    )
    (sheet,) = inspect(shared / "data/gesim_v1", tmp_path, Cut(), PoseMapStyle(tool_offset=0.23))
    assert cv2.imread(str(sheet)).shape == (4 * 480, 3 * 640, 3)


def test_bridge_clips_know_no_calibration(shared: Path, tmp_path: Path) -> None:
    first = next(iter(read_foreign(shared / "data/bridge", Cut(frames=8))))
    assert (
        first.frames.shape == (8, 1, 3, 256, 256)
        and first.seen.all()
        and first.recorded.shape == (8, 10)
        and np.isnan(first.c2w).all()
    )
    assert convert(shared / "data/bridge", tmp_path / "bridge", Cut(frames=8, size=(64, 64))) == 5
    store = ClipStore([tmp_path / "bridge"])
    clip = store.clips(torch.tensor([2]), torch.tensor([0]), ClipSpec(4, 5))
    assert (
        clip["future", "valid"].all()
        and (clip["future", "pose_map"] == 50).all()
        and torch.isfinite(clip["future", "c2w"]).all()
    )


def _agibot(root: Path, length: int = 6) -> Path:
    import h5py

    for folder in (
        "observations/327/648642/videos",
        "parameters/327/648642/parameters/camera",
        "proprio_stats/327/648642",
        "task_info",
    ):
        (root / folder).mkdir(parents=True)
    rng = np.random.default_rng(0)
    for view in ("head", "hand_left", "hand_right"):
        write_video(
            root / f"observations/327/648642/videos/{view}_color.mp4",
            rng.integers(0, 255, (length, 48, 64, 3), dtype=np.uint8),
            30,
        )
        folder = root / "parameters/327/648642/parameters/camera"
        (folder / f"{view}_intrinsic_params.json").write_text(
            json.dumps({"intrinsic": {"fx": 60.0, "fy": 61.0, "ppx": 32.0, "ppy": 24.0}})
        )
        poses = [
            {"extrinsic": {"rotation_matrix": np.eye(3).tolist(), "translation_vector": [0.0, 0.1 * t, 1.0]}}
            for t in range(length)
        ]
        (folder / f"{view}_extrinsic_params_aligned.json").write_text(json.dumps(poses))
    with h5py.File(root / "proprio_stats/327/648642/proprio_stats.h5", "w") as file:
        file["state/effector/position"] = np.tile([[35.0, 120.0]], (length, 1))
        file["state/end/position"] = np.tile([[[0.5, 0.2, 0.3], [0.5, -0.2, 0.3]]], (length, 1, 1))
        file["state/end/orientation"] = np.tile(
            [[[0.0, 0.0, np.sin(0.5), np.cos(0.5)], [0.0, 0.0, 0.0, 1.0]]], (length, 1, 1)
        )
        file["state/joint/position"] = np.tile(np.arange(14.0), (length, 1))
    (root / "task_info/task_327.json").write_text(
        json.dumps([{"episode_id": 648642, "task_name": "Pickup items"}])
    )
    return root


def test_agibot_folders(tmp_path: Path) -> None:
    root = _agibot(tmp_path / "beta")
    (episode,) = read_foreign(root)
    assert (
        episode.instruction == "Pickup items"
        and episode.seed == 648642
        and episode.frames.shape == (6, 3, 3, 48, 64)
    )
    assert episode.commands[0] == pytest.approx(
        [0.5, 0.2, 0.3, 0, 0, 1.0, 0, 0.5, -0.2, 0.3, 0, 0, 0, 1.0], abs=1e-5
    )
    assert episode.states[0].tolist() == [*range(7), 35.0, *range(7, 14), 120.0] and episode.c2w[
        3, 1, 1, 3
    ] == pytest.approx(0.3)
    assert episode.intrinsic[0].tolist() == [[60, 0, 32], [0, 61, 24], [0, 0, 1]]
    (root / "parameters/327/648642/parameters/camera/head_intrinsic_params.json").write_text("{}")
    with pytest.raises(EpisodeError, match="head_intrinsic_params"):
        list(read_foreign(root))


def test_damage_is_named(shared: Path, tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match="no recording in a known format"):
        read_foreign(tmp_path)
    bundle = tmp_path / "demo"
    shutil.copytree(shared / "data/gesim_v2/demo_000", bundle)
    for path in bundle.iterdir():
        path.chmod(0o644)
    (bundle / "cur_left.png").write_bytes(b"no picture")
    with pytest.raises(EpisodeError, match=r"cur_left\.png"):
        list(read_foreign(bundle))
    np.save(bundle / "actions_0.npy", np.full((456, 16), np.nan, np.float32))
    shutil.copy(shared / "data/gesim_v2/demo_000/cur_head.png", bundle / "cur_left.png")
    with pytest.raises(EpisodeError, match=r"actions_0\.npy holds NaN"):
        list(read_foreign(bundle))
    np.save(bundle / "actions_0.npy", np.zeros((455, 16), np.float32))
    with pytest.raises(EpisodeError, match=r"actions_0\.npy has shape"):
        list(read_foreign(bundle))
