"""Clips and their sampling, and what learners never see."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from envs.conditioning import CANVAS, PoseMapStyle, end_effector_poses, render_pose_map
from envs.embodiment import Embodiment
from envs.episodes import Episode, EpisodeError, LeRobotDataset, LeRobotWriter
from envs.episodes.angles import check_radians
from envs.episodes.clip_spec import ClipSpec
from envs.episodes.clips import ClipStore
from envs.episodes.privileged import read_privileged
from envs.geometry.cameras import follow_wrists
from envs.simulators.inputs import build_inputs
from envs.specs import WorldSpec
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, BIMANUAL_POSES, EMBODIMENTS, world_spec
from tests.moving_square import SIZE, moving_square

SPEC = world_spec(BIMANUAL_POSES.at(SIZE), SIZE)


@pytest.mark.parametrize("robot", EMBODIMENTS.values(), ids=list(EMBODIMENTS))
def test_a_store_shows_what_the_robot_allows(
    robot: Embodiment, tiny_store: Callable[[Embodiment], ClipStore]
) -> None:
    store = tiny_store(robot)
    clip = store.sample(torch.arange(20), 3, ClipSpec(4, 4, 2), torch.Generator().manual_seed(0))
    calibrated, drawn = robot.calibrated, robot.calibrated and robot.commands_poses
    for part in ("memory", "future"):
        assert ("c2w" in clip[part].keys()) == calibrated and ("pose_map" in clip[part].keys()) == drawn
    assert ("intrinsic" in clip.keys()) == calibrated
    assert clip["future", "commands"].shape == (3, 8, robot.action_dim)
    assert clip["history", "states"].shape == (3, 4, robot.state_dim)
    inputs = build_inputs(store.spec, clip, 1)
    assert inputs["memory", "commands"].shape == (3, 4, robot.action_dim)
    first = store.first(torch.tensor([4, 5]))
    assert torch.equal(first["frames"], store.frames(store.start[[4, 5]]))
    assert ("pose_map" in first.keys(), "intrinsic" in first.keys()) == (drawn, calibrated)
    later = store.at(torch.tensor([4, 5]), torch.tensor([3, 99]))
    assert torch.equal(later["state"][0], store.arrays["states"][store.start[4] + 3])
    assert torch.equal(later["state"][1], store.arrays["states"][store.start[5] + store.length[5] - 1])


def test_pictures_stay_on_disk(store: ClipStore) -> None:
    for part in store.parts:
        for pictures in (part.frames, part.pose_maps):
            assert isinstance(pictures, np.memmap) and not pictures.flags.writeable


def test_clips_line_up(store: ClipStore) -> None:
    clip = store.clips(torch.tensor([0, 3]), torch.tensor([0, 3]), ClipSpec(4, 4, 2))
    rows = store.start[3] + 3 + torch.arange(1, 9)
    assert torch.equal(clip["future", "frames"][1], store.frames(rows))
    assert torch.equal(clip["now", "command"][1], store.arrays["commands"][store.start[3] + 3])
    assert clip["memory", "index"].tolist() == [[[0, 0, 0, 0], [0, 1, 3, 4]], [[0, 1, 2, 3], [0, 2, 5, 7]]]
    assert torch.equal(clip["memory", "frames"][1, 1, 1], store.frames(store.start[3] + 2))


def test_frames_past_the_end_are_not_valid(store: ClipStore) -> None:
    end = int(store.length[0]) - 2
    clip = store.clips(torch.tensor([0]), torch.tensor([end]), ClipSpec(4, 4))
    assert clip["future", "valid"].tolist() == [[True, False, False, False]]
    rows, real = store.whole(torch.tensor([0, 1]))
    assert rows.shape == real.shape == (2, 12) and bool(real.all())


def test_sampling_is_a_function_of_the_generator(store: ClipStore) -> None:
    a, b = (store.sample(torch.arange(8), 16, ClipSpec(), torch.Generator().manual_seed(3)) for _ in range(2))
    assert bool((a == b).all())
    with pytest.raises(EpisodeError, match="no episode is left"):
        store.sample(torch.arange(0), 16, ClipSpec(), torch.Generator())


def test_selecting_by_source_and_outcome(store: ClipStore) -> None:
    assert store.select(["random"]).tolist() == list(range(1, 20, 2))
    assert store.select(["exp*"], succeeded=True).tolist() == list(range(0, 20, 2))
    assert store.select(succeeded=False).tolist() == list(range(1, 20, 2))
    assert store.instructions[0] == store.episodes[0]["instruction"] and store.episodes[3]["seed"] == 3


def test_pose_maps_are_those_of_the_commands(store: ClipStore, episodes: list[Episode]) -> None:
    """Wrist cameras stand where the commands lead them, as they will in imagination; of the third camera
    nobody knows where it is.
    """
    episode, rows = episodes[4], store.rows(torch.tensor([4]))
    assert episode.c2w is not None and episode.intrinsic is not None
    poses = end_effector_poses(BIMANUAL_POSES, torch.from_numpy(episode.commands))
    c2w = follow_wrists(torch.from_numpy(episode.c2w[0]), poses[0], poses, BIMANUAL_POSES.wrists)
    assert torch.equal(store.arrays["c2w"][rows][:, :2], c2w[:, :2]) and c2w[:, 2].isnan().all()
    assert not torch.allclose(c2w[-1, 1], c2w[0, 1]) and torch.equal(c2w[-1, 0], c2w[0, 0])
    assert not store.arrays["c2w"][rows][:, 2].any() and not store.intrinsic[:, 2].any()
    intrinsic = torch.from_numpy(episode.intrinsic[:2])
    maps = render_pose_map(poses, c2w[:, :2].transpose(0, 1), intrinsic, SIZE, PoseMapStyle())
    assert torch.equal(store.pose_maps(rows)[:, :2], maps.transpose(0, 1))
    assert (store.pose_maps(rows)[:, 2] == CANVAS).all()


def test_a_camera_that_data_do_not_place_is_named(tmp_path: Path) -> None:
    robot = BIMANUAL_POSES.at(SIZE)
    LeRobotWriter(tmp_path / "set", robot).write([moving_square(robot, 0)])
    cameras = [replace(camera, calibrated=camera.wrist != "left") for camera in robot.cameras]
    with pytest.raises(EpisodeError, match=r"no calibration of \['right_wrist'\]"):
        ClipStore([tmp_path / "set"], world_spec(replace(robot, cameras=tuple(cameras)), SIZE))


def test_cameras_on_wrists_stay_where_nobody_knows_where_changes_lead(tmp_path: Path) -> None:
    cameras = [replace(camera, calibrated=True) for camera in ARM_DELTAS.at(SIZE).cameras]
    cameras[1] = replace(cameras[1], wrist="arm")
    robot = replace(ARM_DELTAS.at(SIZE), cameras=tuple(cameras))
    moved = moving_square(robot, 0)
    assert moved.c2w is not None
    moved.c2w[:, 1, 0, 3] += np.arange(len(moved.c2w), dtype=np.float32)  # as imagination could not know
    LeRobotWriter(tmp_path / "set", robot).write([moved])
    c2w = ClipStore([tmp_path / "set"], world_spec(robot, SIZE)).arrays["c2w"]
    assert torch.equal(c2w, c2w[:1].expand_as(c2w))


def test_joints_in_degrees_are_refused_where_kinematics_take_radians() -> None:
    commands = moving_square(ARM_JOINTS, 0).commands
    check_radians(ARM_JOINTS, commands, Path("set"))
    commands[:, 0] *= 45.0
    with pytest.raises(EpisodeError, match=r"set: a joint is commanded to 4.*convert degrees"):
        check_radians(ARM_JOINTS, commands, Path("set"))


@pytest.mark.parametrize(
    ("number", "factor", "match"),
    [
        (1, 1000.0, "left_y is commanded to 900.*millimetres"),
        (10, 57.3, "right_roll.*convert degrees"),
    ],
)
def test_poses_in_millimetres_or_degrees_are_refused_where_cameras_are_calibrated(
    number: int, factor: float, match: str, tmp_path: Path
) -> None:
    robot = BIMANUAL_POSES.at(SIZE)
    made = moving_square(robot, 0)
    made.commands[:, number] = np.linspace(0, 0.9, len(made.commands))
    LeRobotWriter(tmp_path / "right", robot).write([made])
    assert len(ClipStore([tmp_path / "right"], SPEC)) == 1
    made.commands[:, number] *= factor
    LeRobotWriter(tmp_path / "set", robot).write([made])
    with pytest.raises(EpisodeError, match=f"set: .*{match}"):
        ClipStore([tmp_path / "set"], SPEC)


def test_angles_that_pass_pi_do_not_jump(tmp_path: Path) -> None:
    robot = BIMANUAL_POSES.at(SIZE)
    turning = moving_square(robot, 0)
    steady = 3.0 + 0.05 * np.arange(len(turning.commands))
    turning.commands[:, 3] = (steady + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(np.diff(turning.commands[:, 3])).max() > 6
    LeRobotWriter(tmp_path / "set", robot).write([turning])
    commands = ClipStore([tmp_path / "set"], SPEC).arrays["commands"]
    assert torch.allclose(commands[:, 3], torch.from_numpy(steady).float(), atol=1e-5)
    assert torch.equal(commands[:, 4:], torch.from_numpy(turning.commands[:, 4:]))


def test_unlabelled_sets_have_no_success(tmp_path: Path) -> None:
    spec = world_spec(ARM_DELTAS.at(SIZE), SIZE)
    for name, labelled in (("told", True), ("untold", False)):
        made = [moving_square(ARM_DELTAS, seed, labelled=labelled) for seed in range(2)]
        LeRobotWriter(tmp_path / name, ARM_DELTAS.at(SIZE)).write(made)
    assert "success" not in ClipStore([tmp_path / "untold"], spec).arrays
    both = ClipStore([tmp_path / "told", tmp_path / "untold"], spec)
    assert both.arrays["labelled"].tolist() == [True, True, False, False]
    assert both.select(succeeded=False).tolist() == [] and both.select(succeeded=True).tolist() == [0, 1]
    assert torch.equal(
        both.frames(both.rows(torch.tensor([3])))[:2], both.frames(both.start[3] + torch.arange(2))
    )
    assert both.episodes[2]["dataset"] == 1


def test_pictures_are_brought_to_the_spec_and_intrinsics_with_them(dataset: Path, tmp_path: Path) -> None:
    large = ClipStore([dataset], SPEC, tmp_path)
    small = ClipStore([dataset], replace(SPEC, size=(16, 24)), tmp_path)
    assert small.frames(torch.arange(2)).shape[-2:] == (16, 24)
    scale = torch.tensor([[24 / 32], [16 / 32], [1.0]])
    assert torch.allclose(small.intrinsic, large.intrinsic * scale)


def test_data_of_another_robot_are_refused(dataset: Path) -> None:
    with pytest.raises(EpisodeError, match=r"another robot: action_names"):
        ClipStore([dataset], world_spec(ARM_JOINTS.at(SIZE), SIZE))
    with pytest.raises(EpisodeError, match="no data set is given"):
        ClipStore([], SPEC)
    with pytest.raises(EpisodeError, match=r"not a LeRobot data set.*info\.json is missing"):
        ClipStore([dataset / "meta"], SPEC)


def test_missing_calibration_is_named(tmp_path: Path) -> None:
    LeRobotWriter(tmp_path / "set", ARM_DELTAS.at(SIZE)).write([moving_square(ARM_DELTAS, 0)])
    cameras = tuple(replace(camera, calibrated=True) for camera in ARM_DELTAS.at(SIZE).cameras)
    spec = WorldSpec(replace(ARM_DELTAS, cameras=cameras), SIZE, 4, ray_map=True)
    with pytest.raises(EpisodeError, match=r"no calibration.*calibrated=false"):
        ClipStore([tmp_path / "set"], spec)


# -- what only physics knows
def test_privileged_columns_are_read_apart(dataset: Path, episodes: list[Episode], tmp_path: Path) -> None:
    store = ClipStore([dataset, dataset], SPEC, tmp_path)
    truth = np.concatenate([episode.privileged["object_pose"] for episode in episodes])
    read = read_privileged(store, "object_pose")
    assert read is not None and np.array_equal(read.numpy(), np.concatenate([truth, truth]))
    assert read_privileged(store, "centimetres") is None
    assert not any("object" in path.name for path in tmp_path.rglob("*"))


def test_a_learner_that_asks_for_a_privileged_column_is_told_why_not(dataset: Path, tmp_path: Path) -> None:
    store, name = ClipStore([dataset], SPEC, tmp_path), "privileged.object_pose"
    with pytest.raises(
        EpisodeError, match=r"'privileged\.object_pose' is asked for; only physics.*Learn from"
    ):
        store.arrays[name]
    assert name not in store.arrays and store.arrays.get(name) is None
    with pytest.raises(EpisodeError, match=r"privileged\.object_pose is asked for.*privileged=True"):
        LeRobotDataset(dataset).column(name)
    assert len(LeRobotDataset(dataset, privileged=True).column(name)) == len(store.arrays["states"])


@pytest.mark.parametrize(
    ("name", "fix"),
    [("success", r"Record next\.success"), ("c2w", r"calibration\.c2w"), ("sates", r"there are .*'states'")],
)
def test_columns_that_a_store_has_not_are_refused_with_the_fix(name: str, fix: str, tmp_path: Path) -> None:
    writer = LeRobotWriter(tmp_path / "set", ARM_DELTAS.at(SIZE))
    writer.write([moving_square(ARM_DELTAS, 0, labelled=False)])
    store = ClipStore([tmp_path / "set"], world_spec(ARM_DELTAS.at(SIZE), SIZE))
    with pytest.raises(EpisodeError, match=f"column '{name}' is asked for; .*{fix}"):
        store.arrays[name]
    with pytest.raises(EpisodeError, match="no column sates; record it"):
        LeRobotDataset(tmp_path / "set").column("sates")


def test_noise_in_privileged_columns_changes_nothing_that_is_learned_from(
    dataset: Path, tmp_path: Path
) -> None:
    root = tmp_path / "set"
    shutil.copytree(dataset, root)
    for path in (root / "data").rglob("*.parquet"):
        table = pq.read_table(path)
        at = table.column_names.index("privileged.object_pose")
        noise = pa.array(np.random.default_rng(0).normal(size=2 * len(table)).astype(np.float32))
        noisy = pa.FixedSizeListArray.from_arrays(noise, 2)
        pq.write_table(table.set_column(at, "privileged.object_pose", noisy), path)
    a, b = ClipStore([dataset], SPEC, tmp_path / "a"), ClipStore([root], SPEC, tmp_path / "b")
    assert a.arrays.keys() == b.arrays.keys() and a.episodes == b.episodes
    assert all(torch.equal(a.arrays[name], b.arrays[name]) for name in a.arrays)
    rows = torch.arange(len(a.arrays["commands"]))
    assert torch.equal(a.frames(rows), b.frames(rows)) and torch.equal(a.pose_maps(rows), b.pose_maps(rows))
    one, two = read_privileged(a, "object_pose"), read_privileged(b, "object_pose")
    assert one is not None and two is not None and not torch.equal(one, two)


def test_an_instruction_that_is_cut_is_told(
    tmp_path: Path, episodes: list[Episode], caplog: pytest.LogCaptureFixture
) -> None:
    robot, wordy = BIMANUAL_POSES.at(SIZE), "put the cup " + "beside the other cup " * 20
    LeRobotWriter(tmp_path, robot).write([replace(episodes[0], instruction=wordy), *episodes[1:3]])
    for _ in range(2):  # once, however often it is opened
        ClipStore([tmp_path], world_spec(robot, SIZE))
    (said,) = [entry.getMessage() for entry in caplog.records if "bytes" in entry.getMessage()]
    assert said.startswith("1 instructions, the first of them 'put the cup") and "256 bytes" in said
