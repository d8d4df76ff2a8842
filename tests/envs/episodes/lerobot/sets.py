"""Small data sets in the file layout of LeRobot 0.6.1's own software, written with pyarrow and PyAV alone.

Seven sets, as LeRobotDataset.create makes them: a single arm with two cameras of different sizes, ALOHA,
SO-101, one with next.*, images instead of video, pusht, and one whose episodes lie in several files and
chunks.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from envs.episodes.video import frame_rate

_POSE = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
_ALOHA_ARM = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate", "gripper")
_ALOHA = {"motors": [f"{arm}_{joint}" for arm in ("left", "right") for joint in _ALOHA_ARM]}
_SO101 = [
    f"{joint}.pos"
    for joint in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
]
_PUSHT = {"motors": ["motor_0", "motor_1"]}


@dataclass(frozen=True)
class FakeSet:
    """One of the seven sets.

    Args:
        robot: its robot_type.
        fps: frames per second.
        cameras: feature -> (height, width).
        names: of action and state, as info.json has them.
        size: numbers of action and of state.
        kind: "video" or "image".
        labelled: whether there are next.success, next.reward and next.done.
        files: (chunk, file) of each episode's rows and videos; () puts all into the first.
    """

    robot: str
    fps: float
    cameras: dict[str, tuple[int, int]]
    names: Any
    size: int
    kind: str = "video"
    labelled: bool = False
    files: Sequence[tuple[int, int]] = ()


FRONT = {"observation.images.front": (48, 64)}
SETS = {
    "single_arm": FakeSet("franka", 20, {**FRONT, "observation.images.wrist": (32, 32)}, _POSE, 7),
    "aloha": FakeSet("aloha", 50, {"observation.images.top": (48, 64)}, _ALOHA, 14),
    "so101": FakeSet("so101_follower", 30, {"observation.images.up": (48, 64)}, _SO101, 6),
    "labelled": FakeSet("franka", 10, FRONT, _POSE, 7, labelled=True),
    "images": FakeSet("franka", 10, FRONT, _POSE, 7, kind="image"),
    "pusht": FakeSet("2d pointer", 10, {"observation.image": (96, 96)}, _PUSHT, 2, labelled=True),
    "many_files": FakeSet("franka", 12.5, FRONT, None, 7, files=((0, 0), (0, 1), (0, 1), (1, 0))),
}
LENGTHS = (9, 11, 5, 7)


@dataclass
class FakeEpisode:
    """What was put into one episode: frames uint8 [T, H, W, 3] by camera, numbers by column, the task."""

    frames: dict[str, NDArray[np.uint8]]
    columns: dict[str, NDArray[Any]]
    task: str


def fake_episodes(about: FakeSet) -> list[FakeEpisode]:
    """The episodes of a set; the second one fails."""
    out = []
    for number, length in enumerate(LENGTHS):
        rng = np.random.default_rng(number)
        columns: dict[str, NDArray[Any]] = {
            "observation.state": rng.normal(size=(length, about.size)).astype(np.float32),
            "action": rng.normal(size=(length, about.size)).astype(np.float32),
        }
        if about.labelled:
            columns["next.reward"] = rng.uniform(size=length).astype(np.float32)
            columns["next.success"] = (np.arange(length) == length - 1) & (number != 1)
            columns["next.done"] = np.arange(length) == length - 1
        frames = {
            key: _pictures(length, *size, number + k) for k, (key, size) in enumerate(about.cameras.items())
        }
        out.append(FakeEpisode(frames, columns, f"task {number % 2}"))
    return out


def write_set(root: Path, about: FakeSet) -> list[FakeEpisode]:
    """Write a set as LeRobot's software does and return what is in it."""
    episodes = fake_episodes(about)
    files = about.files or [(0, 0)] * len(episodes)
    rows, first = [], 0
    clocks: dict[tuple[int, int], float] = {}
    tables: dict[tuple[int, int], list[pa.Table]] = {}
    videos: dict[tuple[int, int], list[FakeEpisode]] = {}
    for number, (episode, place) in enumerate(zip(episodes, files, strict=True)):
        length = len(episode.columns["action"])
        tables.setdefault(place, []).append(_table(about, episode, number, first))
        videos.setdefault(place, []).append(episode)
        row: dict[str, Any] = {"episode_index": number, "tasks": [episode.task], "length": length}
        row |= {"data/chunk_index": place[0], "data/file_index": place[1]}
        row |= {"dataset_from_index": first, "dataset_to_index": first + length}
        begin = clocks.get(place, 0.0)
        for key in about.cameras if about.kind == "video" else ():
            row |= {f"videos/{key}/chunk_index": place[0], f"videos/{key}/file_index": place[1]}
            row |= {
                f"videos/{key}/from_timestamp": begin,
                f"videos/{key}/to_timestamp": begin + length / about.fps,
            }
        row |= {
            "stats/action/mean": episode.columns["action"].mean(0).tolist(),
            "stats/action/count": [length],
        }
        rows.append(row | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        clocks[place], first = begin + length / about.fps, first + length
    for (chunk, file), parts in tables.items():
        path = root / f"data/chunk-{chunk:03d}/file-{file:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        with pq.ParquetWriter(path, parts[0].schema) as writer:
            for part in parts:
                writer.write_table(part)
    for (chunk, file), made in videos.items():
        for key in about.cameras if about.kind == "video" else ():
            path = root / f"videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_yuv420(path, np.concatenate([episode.frames[key] for episode in made]), about.fps)
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows), path)
    tasks = pa.table({"task_index": pa.array([0, 1], pa.int64()), "task": ["task 0", "task 1"]})
    pq.write_table(tasks, root / "meta/tasks.parquet")
    (root / "meta/info.json").write_text(json.dumps(_info(about, len(rows), first), indent=4))
    return episodes


def change_info(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change info.json in place."""
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def set_column(root: Path, name: str, values: Sequence[Any]) -> None:
    """Add a column to the rows of a set in one file, or exchange it."""
    path = root / "data/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    if name in table.column_names:
        table = table.drop_columns([name])
    pq.write_table(table.append_column(name, pa.array(values)), path)


def _pictures(length: int, height: int, width: int, seed: int) -> NDArray[np.uint8]:
    """Smooth pictures, each brighter than the one before."""
    rows, columns = np.mgrid[0:height, 0:width]
    still = np.stack([np.sin(rows / 9 + seed + k) + np.cos(columns / 11 - seed) for k in range(3)], -1)
    return (70 + 25 * still + 10 * np.arange(length)[:, None, None, None]).astype(np.uint8)


def _table(about: FakeSet, episode: FakeEpisode, number: int, first: int) -> pa.Table:
    columns: dict[str, pa.Array] = {}
    if about.kind == "image":
        kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        for key, frames in episode.frames.items():
            cells = [
                {"bytes": cv2.imencode(".png", frame[..., ::-1])[1].tobytes(), "path": f"frame-{k:06d}.png"}
                for k, frame in enumerate(frames)
            ]
            columns[key] = pa.array(cells, kind)
    for key, values in episode.columns.items():
        flat = pa.array(values.reshape(-1))
        columns[key] = flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    length = len(episode.columns["action"])
    columns["timestamp"] = pa.array((np.arange(length) / about.fps).astype(np.float32))
    columns["frame_index"] = pa.array(np.arange(length))
    columns["episode_index"] = pa.array(np.full(length, number))
    columns["index"] = pa.array(np.arange(first, first + length))
    columns["task_index"] = pa.array(np.full(length, number % 2))
    return pa.table(columns)


def write_yuv420(path: Path, frames: NDArray[np.uint8], fps: float) -> None:
    """A video uint8 [T, H, W, 3] as LeRobot encodes it, with a quarter of the colour."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=frame_rate(fps), options={"g": "2", "crf": "12"})
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def _info(about: FakeSet, episodes: int, frames: int) -> dict[str, Any]:
    features: dict[str, Any] = {
        key: {"dtype": about.kind, "shape": [*size, 3], "names": ["height", "width", "channels"]}
        for key, size in about.cameras.items()
    }
    for key in ("observation.state", "action"):
        features[key] = {"dtype": "float32", "shape": [about.size], "names": about.names}
    single = (
        [("next.reward", "float32"), ("next.success", "bool"), ("next.done", "bool")]
        if about.labelled
        else []
    )
    single += [("timestamp", "float32")]
    single += [(key, "int64") for key in ("frame_index", "episode_index", "index", "task_index")]
    features |= {key: {"dtype": kind, "shape": [1], "names": None} for key, kind in single}
    return {
        "codebase_version": "v3.0",
        "fps": about.fps,
        "features": features,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 2,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        if about.kind == "video"
        else None,
        "robot_type": about.robot,
        "splits": {"train": f"0:{episodes}"},
    }
