"""LeRobot data sets: round trip, resumption, damage; clips and their sampling."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from envs.episodes import Episode, EpisodeError, LeRobotDataset, LeRobotWriter
from envs.episodes.clips import ClipSpec, ClipStore, memory_indices
from envs.episodes.video import write_video


def test_round_trip(episodes: list[Episode], dataset: Path) -> None:
    back = list(LeRobotDataset(dataset))
    assert len(back) == len(episodes)
    for one, two in zip(episodes, back, strict=True):
        for name in ("commands", "achieved", "states", "c2w", "success", "progress", "objects", "intrinsic"):
            assert np.array_equal(getattr(one, name), getattr(two, name), equal_nan=True), name
        assert (one.instruction, one.seed, one.behaviour) == (two.instruction, two.seed, two.behaviour)
        assert np.abs(one.frames.astype(int) - two.frames).mean() < 2.0  # the video is compressed


def test_format_is_lerobot_v3(dataset: Path) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    rows = pq.read_table(dataset / info["data_path"].format(chunk_index=0, file_index=1))
    assert {
        "timestamp",
        "frame_index",
        "episode_index",
        "index",
        "task_index",
        "action",
        "observation.state",
    } <= set(rows.column_names)
    assert rows["index"][0].as_py() == sum(r["length"] for r in LeRobotDataset(dataset).episode_rows()[:4])
    episode = LeRobotDataset(dataset).episode_rows()[5]
    assert episode["videos/observation.images.head/from_timestamp"] == pytest.approx(
        LeRobotDataset(dataset).episode_rows()[4]["length"] / 10
    )
    assert json.loads(pq.read_schema(dataset / "meta/tasks.parquet").metadata[b"pandas"])[
        "index_columns"
    ] == ["task"]
    stats = json.loads((dataset / "meta/stats.json").read_text())
    assert len(stats["action"]["mean"]) == 14 and len(stats["observation.images.head"]["mean"]) == 3


def test_action_is_the_next_command(dataset: Path, episodes: list[Episode]) -> None:
    rows = pq.read_table(dataset / "data/chunk-000/file-000.parquet")
    action = np.array(rows["action"].to_pylist(), np.float32)
    length = len(episodes[0])
    assert np.array_equal(action[: length - 1], episodes[0].commands[1:])


def test_interrupted_collection_resumes(dataset: Path, episodes: list[Episode], tmp_path: Path) -> None:
    root = tmp_path / "copy"
    shutil.copytree(dataset, root)
    # the second shard was being written when the power failed
    (root / "meta/episodes/chunk-000/file-001.parquet").unlink()
    writer = LeRobotWriter(root, ("head", "hand_left", "hand_right"), (64, 64), 10.0)
    assert writer.shards == 1
    writer.write(episodes[4:])
    assert [e.seed for e in LeRobotDataset(root)] == [e.seed for e in episodes]


@pytest.mark.parametrize(
    "name", ["videos/observation.images.head/chunk-000/file-000.mp4", "data/chunk-000/file-000.parquet"]
)
def test_damage_names_the_file(dataset: Path, tmp_path: Path, name: str) -> None:
    root = tmp_path / "copy"
    shutil.copytree(dataset, root)
    path = root / name
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(EpisodeError, match=path.name):
        list(LeRobotDataset(root))


def test_foreign_data_are_refused(dataset: Path, tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match=r"info\.json"):
        LeRobotDataset(tmp_path)
    root = tmp_path / "old"
    (root / "meta").mkdir(parents=True)
    info = json.loads((dataset / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps({**info, "codebase_version": "v2.1"}))
    with pytest.raises(EpisodeError, match=r"v2\.1"):
        LeRobotDataset(root)
    del info["features"]["observation.camera.c2w"]
    (root / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(EpisodeError, match=r"camera\.c2w"):
        LeRobotDataset(root)
    with pytest.raises(EpisodeError, match="another folder"):
        LeRobotWriter(dataset, ("head",), (64, 64), 10.0)


def test_nan_in_an_episode_is_refused(episodes: list[Episode]) -> None:
    broken = episodes[0].commands.copy()
    broken[2, 3] = np.nan
    with pytest.raises(EpisodeError, match="commands holds NaN"):
        Episode(**{**vars(episodes[0]), "commands": broken})


def test_memory_is_sparse_and_keeps_first_and_last() -> None:
    assert memory_indices(torch.tensor([1, 4, 10, 41]), 4).tolist() == [
        [0, 0, 0, 0],
        [0, 1, 2, 3],
        [0, 3, 6, 9],
        [0, 13, 27, 40],
    ]


def test_clips_line_up(store: ClipStore) -> None:
    clip = store.clips(torch.tensor([0, 3]), torch.tensor([0, 5]), ClipSpec(4, 4, 2))
    rows = store.start[3] + 5 + torch.arange(1, 9)
    assert torch.equal(clip["future", "frames"][1], store.frames(rows))
    assert torch.equal(clip["now", "command"][1], store.arrays["commands"][store.start[3] + 5])
    assert clip["memory", "index"].tolist() == [[[0, 0, 0, 0], [0, 1, 3, 4]], [[0, 2, 3, 5], [0, 3, 6, 9]]]
    assert torch.equal(clip["memory", "frames"][1, 1, 1], store.frames(store.start[3] + 3))


def test_stride_skips_frames(store: ClipStore) -> None:
    clip = store.clips(torch.tensor([3]), torch.tensor([5]), ClipSpec(4, 2, 1, stride=3))
    assert torch.equal(
        clip["future", "commands"][0], store.arrays["commands"][store.start[3] + torch.tensor([8, 11])]
    )
    assert int(clip["begin"]) == 1  # one stride of past: frames 2 and 5


def test_frames_past_the_end_are_not_valid(store: ClipStore) -> None:
    end = int(store.length[0]) - 2
    clip = store.clips(torch.tensor([0]), torch.tensor([end]), ClipSpec(4, 4))
    assert clip["future", "valid"].tolist() == [[True, False, False, False]]


def test_sampling_is_a_function_of_the_generator(store: ClipStore) -> None:
    a, b = (store.sample(torch.arange(8), 16, ClipSpec(), torch.Generator().manual_seed(3)) for _ in range(2))
    assert bool((a.apply(torch.nan_to_num) == b.apply(torch.nan_to_num)).all())  # a disc has no heading


def test_selecting_by_behaviour(store: ClipStore) -> None:
    assert store.select(["random"]).tolist() == [3, 7]
    assert store.select(["no*"]).tolist() == [1, 2, 5, 6]


def test_objects_without_headings_are_refused_by_name(dataset: Path, tmp_path: Path) -> None:
    root = tmp_path / "copy"
    shutil.copytree(dataset, root)
    info = json.loads((root / "meta/info.json").read_text())
    assert info["features"]["observation.objects"]["names"][:4] == [
        "object0_x",
        "object0_y",
        "object0_z",
        "object0_heading",
    ]
    info["features"]["observation.objects"] |= {"names": None, "shape": [6]}
    (root / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(EpisodeError, match="heading"):
        LeRobotDataset(root)


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
