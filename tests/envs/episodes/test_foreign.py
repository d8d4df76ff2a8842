"""Recordings from elsewhere become Episodes without loss, and their pose maps are the public ones."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from envs.commanded_states import as_states
from envs.conditioning import PoseMapStyle, end_effector_poses, render_pose_map
from envs.embodiment import Embodiment
from envs.episodes import EpisodeError, LeRobotDataset, LeRobotWriter
from envs.episodes.clip_spec import ClipSpec
from envs.episodes.clips import ClipStore
from envs.episodes.formats.agibot import AGIBOT
from envs.episodes.formats.bridge import BRIDGE
from envs.episodes.formats.foreign import Cut, read_foreign
from envs.episodes.formats.gesim import GENIE, GENIE_POSES, write_bundle
from envs.episodes.video import write_video
from envs.specs import WorldSpec
from pipeline.commands.convert import convert, inspect
from pipeline.graph.owner import RunInUse, owning
from tests.envs.episodes.lerobot.sets import SETS, write_set
from tests.moving_square import moving_square


def test_the_bundles_pose_maps_are_the_golden_ones(shared: Path) -> None:
    (episode,) = read_foreign(shared / "data/gesim_v2")
    golden = np.load(shared / "golden/pose_map_gesim_v2_demo_000.npz")
    at = golden["frame_indices"]
    assert len(episode) == 456 and episode.present.sum() == 1 and episode.embodiment.robot == "genie"
    assert episode.c2w is not None and episode.intrinsic is not None and episode.poses is not None
    maps = render_pose_map(
        torch.from_numpy(episode.poses[at]),
        torch.from_numpy(episode.c2w[at]).transpose(0, 1),
        torch.from_numpy(episode.intrinsic),
        (384, 512),
    )
    assert np.array_equal(maps.numpy(), golden["pose_map_uint8"].transpose(1, 2, 0, 3, 4))
    names = dict(zip(GENIE.state_names, episode.states[0], strict=True))
    assert names["left_gripper"] == pytest.approx(0.2173, abs=1e-3)
    assert names["head_joint2"] == pytest.approx(0.4363, abs=1e-3)


@pytest.mark.long
def test_a_bundle_comes_back_as_it_was(shared: Path, tmp_path: Path) -> None:
    """Head and waist joints too: the released closed loop feeds them to kinematics."""
    size = (384, 512)
    cut = Cut(size=size)
    assert convert(shared / "data/gesim_v2", tmp_path / "lerobot", cut) == 1
    assert {path.name for path in (tmp_path / "lerobot").iterdir()} == {"data", "meta", "videos"}
    (there,) = LeRobotDataset(tmp_path / "lerobot")
    (source,) = read_foreign(shared / "data/gesim_v2", cut)
    for name in ("c2w", "intrinsic", "commands", "poses", "states", "present"):
        assert np.array_equal(getattr(there, name), getattr(source, name)), name
    assert there.instruction == source.instruction and there.embodiment == GENIE.at(size)
    assert there.success is None
    assert convert(tmp_path / "lerobot", tmp_path / "bundles", Cut()) == 1
    for path in (shared / "data/gesim_v2/demo_000").glob("*.npy"):
        written = np.load(tmp_path / "bundles/episode_000000" / path.name)
        assert np.array_equal(written, np.load(path)), path.name
    joints = np.load(tmp_path / "bundles/episode_000000/state_joints_0.npy")
    assert joints[:, 17:].all()
    with pytest.raises(EpisodeError, match="not empty"):
        convert(tmp_path / "lerobot", tmp_path / "bundles", Cut())


def test_a_conversion_goes_on_where_it_broke_off(shared: Path, tmp_path: Path) -> None:
    source, target, cut = tmp_path / "clips", tmp_path / "lerobot", Cut(frames=4, size=(32, 32))
    shutil.copytree(shared / "data/bridge", source)
    numbers = source / "000000003.npz"
    content = numbers.read_bytes()
    numbers.write_bytes(content[:100])
    with pytest.raises(EpisodeError, match=numbers.name):
        convert(source, target, cut)
    numbers.write_bytes(content)
    with pytest.raises(EpisodeError, match="half of another conversion"):
        convert(source, target, Cut(frames=5))
    made = {path: path.stat().st_mtime_ns for path in target.rglob("file-*.*")}
    assert convert(source, target, cut) == 5 and not list(target.glob(".*"))
    assert made and all(path.stat().st_mtime_ns == then for path, then in made.items())
    convert(source, tmp_path / "at once", cut)
    for one, other in zip(LeRobotDataset(target), LeRobotDataset(tmp_path / "at once"), strict=True):
        assert np.array_equal(one.frames, other.frames) and np.array_equal(one.commands, other.commands)


def test_a_conversion_of_nothing_does_not_claim_the_folder(shared: Path, tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match="no recording in a known format"):
        convert(tmp_path / "mistyped", tmp_path / "out", Cut())
    assert convert(shared / "data/gesim_v2", tmp_path / "out", Cut(frames=2, size=(32, 48))) == 1


def test_two_conversions_into_one_folder_are_one_too_many(shared: Path, tmp_path: Path) -> None:
    with (
        owning(tmp_path, "convert there here"),
        pytest.raises(RunInUse, match=r"convert there here.*another folder"),
    ):
        convert(shared / "data/gesim_v1", tmp_path, Cut(frames=4))
    assert not (tmp_path / "meta").exists()


def test_a_bundle_has_one_robot(shared: Path, tmp_path: Path) -> None:
    (episode,) = read_foreign(shared / "data/gesim_v1", Cut(frames=4, size=(48, 64)))
    with pytest.raises(EpisodeError, match="genie: action_names"):
        write_bundle(tmp_path, episode)
    with pytest.raises(EpisodeError, match="flange poses are missing"):
        write_bundle(tmp_path, moving_square(GENIE.at((32, 32)), 0))


def test_joint_commands_of_a_bundle_are_clips(shared: Path, tmp_path: Path) -> None:
    size = (48, 64)
    convert(shared / "data/gesim_v2", tmp_path / "lerobot", Cut(frames=12, size=size))
    store = ClipStore([tmp_path / "lerobot"], WorldSpec(GENIE.at(size), size, 5, ray_map=True))
    clip = store.clips(torch.tensor([0]), torch.tensor([0]), ClipSpec(4, 5))
    assert clip["future", "commands"].shape == (1, 5, 16) and clip["now", "state"].shape == (1, 20)
    assert not clip["future", "valid"].any()  # nobody photographed those frames
    later = store.clips(torch.tensor([0]), torch.tensor([3]), ClipSpec(4, 5))
    assert later["memory", "present"].tolist() == [[[True, False, False, False]]]
    assert clip["future", "c2w"].shape == (1, 5, 3, 4, 4)


def test_scaled_intrinsics_see_the_same(shared: Path) -> None:
    drawn = []
    for size in ((384, 512), (192, 256)):
        (episode,) = read_foreign(shared / "data/gesim_v2", Cut(frames=2, size=size))
        assert episode.c2w is not None and episode.intrinsic is not None and episode.poses is not None
        c2w = torch.from_numpy(episode.c2w).transpose(0, 1)
        poses, intrinsic = torch.from_numpy(episode.poses), torch.from_numpy(episode.intrinsic)
        drawn.append(render_pose_map(poses, c2w, intrinsic, size).float())
    shrunk = torch.nn.functional.avg_pool2d(drawn[0].flatten(0, 1), 2).unflatten(0, drawn[0].shape[:2])
    assert (shrunk - drawn[1]).abs().mean() < 4.0


def test_gesim_1_samples(shared: Path, tmp_path: Path) -> None:
    (episode,) = read_foreign(shared / "data/gesim_v1")
    assert episode.frames.shape == (300, 3, 3, 480, 640) and episode.present.sum() == 4
    assert episode.embodiment == GENIE_POSES.at((480, 640)) and episode.poses is None
    recorded = np.load(shared / "data/gesim_v1/sample_0/actions.npy")
    poses = end_effector_poses(GENIE_POSES, torch.from_numpy(episode.commands))
    assert np.allclose(poses[:, 0, :3], recorded[:, :3])
    assert np.allclose(poses[:, 1, 6], (recorded[:, 15] - 35) / 85, atol=1e-6)
    (sheet,) = inspect(shared / "data/gesim_v1", tmp_path, Cut(), PoseMapStyle(tool_offset=0.23))
    assert cv2.imread(str(sheet)).shape == (4 * 480, 3 * 640, 3)


def test_bridge_clips_know_no_calibration(
    shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = next(read_foreign(shared / "data/bridge", Cut(frames=8)))
    assert first.frames.shape == (8, 1, 3, 256, 256) and first.present.all()
    assert first.commands.shape == (8, 10) and first.c2w is None and first.poses is None
    size = (64, 64)
    assert convert(shared / "data/bridge", tmp_path / "bridge", Cut(frames=8, size=size)) == 5
    store = ClipStore([tmp_path / "bridge"], WorldSpec(BRIDGE.at(size), size, 5))
    clip = store.clips(torch.tensor([2]), torch.tensor([0]), ClipSpec(4, 5))
    assert clip["future", "valid"].all() and "c2w" not in clip["future"].keys()
    made = inspect(shared / "data/bridge", tmp_path / "seen", Cut(frames=8), PoseMapStyle(), episodes=1)
    assert len(made) == 1
    said = "".join(capsys.readouterr())
    assert "nothing is drawn: cameras ['front'] of widowx are not calibrated" in said


def test_inspect_says_when_actions_tell_no_pose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot: Embodiment = GENIE.at((32, 32))
    LeRobotWriter(tmp_path / "set", robot).write([moving_square(robot, 0)])
    inspect(tmp_path / "set", tmp_path / "seen", Cut(), PoseMapStyle())
    assert "actions of genie (joints, delta=False) do not say" in "".join(capsys.readouterr())


def test_inspect_brings_cameras_of_different_sizes_to_the_main_ones(tmp_path: Path) -> None:
    write_set(tmp_path / "set", SETS["single_arm"])  # 48 x 64, and 32 x 32 on the wrist
    (sheet,) = inspect(tmp_path / "set", tmp_path / "seen", Cut(), PoseMapStyle(), rows=2, episodes=1)
    assert cv2.imread(str(sheet)).shape == (2 * 48, 2 * 64, 3)


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
    with pytest.warns(UserWarning, match="no action/joint/position; measured joints stand in for commands"):
        (episode,) = read_foreign(root)
    assert np.array_equal(as_states(AGIBOT, episode.commands), episode.states)
    assert (episode.instruction, episode.seed) == ("Pickup items", 648642)
    assert episode.frames.shape == (6, 3, 3, 48, 64)
    assert episode.poses is not None and episode.c2w is not None and episode.intrinsic is not None
    left, right = [0.5, 0.2, 0.3, 0, 0, 1.0, 0], [0.5, -0.2, 0.3, 0, 0, 0, 1.0]
    assert episode.poses[0].tolist() == [pytest.approx(left, abs=1e-5), pytest.approx(right, abs=1e-5)]
    assert episode.states[0].tolist() == [*range(7), 35.0, *range(7, 14), 120.0]
    assert episode.c2w[3, 1, 1, 3] == pytest.approx(0.3)
    assert episode.intrinsic[0].tolist() == [[60, 0, 32], [0, 61, 24], [0, 0, 1]]
    (root / "parameters/327/648642/parameters/camera/head_intrinsic_params.json").write_text("{}")
    with (
        pytest.warns(UserWarning, match="measured joints"),
        pytest.raises(EpisodeError, match="head_intrinsic_params"),
    ):
        list(read_foreign(root))


def test_agibots_targets_are_commands_where_they_cover_every_frame(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    import h5py

    root, length = _agibot(tmp_path / "beta"), 6
    path = root / "proprio_stats/327/648642/proprio_stats.h5"
    targets = np.arange(14.0) + 0.1 * np.arange(length)[:, None]
    with h5py.File(path, "a") as file:
        file["action/joint/position"] = targets
        file["action/effector/position"] = np.tile([[0.25, 0.5]], (length, 1))
        file["action/joint/index"] = np.arange(length)
    assert convert(root, tmp_path / "lerobot", Cut()) == 1
    assert not recwarn.list
    (episode,) = LeRobotDataset(tmp_path / "lerobot")
    assert np.allclose(episode.commands[:, [*range(7), *range(8, 15)]], targets)
    assert episode.commands[0, [7, 15]].tolist() == [0.25, 0.5]  # as GE-Sim and its clients command
    assert episode.poses is not None and episode.poses[0, :, 6].tolist() == [0.25, 0.5]
    assert episode.states[0, [7, 15]].tolist() == [35.0, 120.0]
    assert episode.embodiment.arms == AGIBOT.arms
    assert np.array_equal(episode.states[3, :7], np.arange(7))
    for change, reason in (
        (lambda file: file.create_dataset("action/joint/index", data=[0, 1, 2]), "no target was sent"),
        (lambda file: file.create_dataset("action/joint/position", data=np.ones((9, 14))), "every frame"),
        (lambda file: file.create_dataset("action/effector/position", data=60 * np.ones((6, 2))), "share"),
    ):
        with h5py.File(path, "a") as file:
            kept = {name: np.array(file[name]) for name in ("action/joint/position", "action/joint/index")}
            kept["action/effector/position"] = np.array(file["action/effector/position"])
            del file["action"]
            made = change(file).name[1:]
            for name in kept.keys() - {made}:
                file[name] = kept[name]
        with pytest.warns(UserWarning, match=reason):
            (episode,) = read_foreign(root)
        assert np.array_equal(as_states(AGIBOT, episode.commands), episode.states)
        with h5py.File(path, "a") as file:
            del file[made]
            file[made] = kept[made]


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
