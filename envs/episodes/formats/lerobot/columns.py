"""Which columns of a LeRobot data set hold what of an Episode.

LeRobot's own: action, observation.state, observation.images.*, next.success, next.reward, next.done,
timestamp and the indices. Ours, each of which may be missing: calibration.c2w, calibration.intrinsic, source
and seed, which any set may have; command, end_effector.command, present and privileged.*, which are read from
sets with our description alone. None of ours begins with "observation" or "action", which LeRobot would show
to policies.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from envs.episodes.episode import Episode
from envs.episodes.formats.lerobot.info import IMAGE_PREFIX, INFO_KEY, to_info

VERSION = "v3.0"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
CHUNK_FILES = 1000  # files of a folder
PRIVILEGED = "privileged."
COMMAND, C2W, INTRINSIC = "command", "calibration.c2w", "calibration.intrinsic"
POSES, PRESENT, SOURCE, SEED = "end_effector.command", "present", "source", "seed"
SUCCESS, REWARD, DONE = "next.success", "next.reward", "next.done"
INDICES = ("frame_index", "episode_index", "index", "task_index")
_POSE = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")


def columns_of(episode: Episode) -> dict[str, NDArray[Any]]:
    """The columns of an episode's rows, [T] or [T, n]; without pictures and without indices."""
    length, cameras = len(episode), list(episode.embodiment.calibrated_views)
    columns: dict[str, NDArray[Any]] = {
        # LeRobot's action is the one taken at a frame; the last row repeats, for nothing follows it.
        "action": np.concatenate([episode.commands[1:], episode.commands[-1:]]),
        "observation.state": episode.states,
        COMMAND: episode.commands,
    }
    if episode.c2w is not None and episode.intrinsic is not None:
        columns[C2W] = episode.c2w[:, cameras].reshape(length, -1)
        columns[INTRINSIC] = np.tile(episode.intrinsic[cameras].reshape(1, -1), (length, 1))
    if episode.poses is not None:
        columns[POSES] = episode.poses.reshape(length, -1)
    if not episode.present.all():
        columns[PRESENT] = episode.present
    if episode.success is not None:
        columns[SUCCESS] = np.concatenate([episode.success[1:], episode.success[-1:]])
    if episode.reward is not None:
        columns[REWARD] = np.concatenate([episode.reward[1:], np.zeros(1, np.float32)])
    columns[DONE] = np.arange(length) == length - 1
    columns[SOURCE] = np.full(length, episode.source, object)
    columns[SEED] = np.full(length, episode.seed, np.int64)
    columns |= {PRIVILEGED + name: value.reshape(length, -1) for name, value in episode.privileged.items()}
    columns["timestamp"] = (np.arange(length) / episode.embodiment.fps).astype(np.float32)
    columns["frame_index"] = np.arange(length)
    # LeRobot keeps features of one number as scalars.
    return {
        name: value[:, 0] if value.ndim == 2 and value.shape[1] == 1 else value
        for name, value in columns.items()
    }


def indexed_columns(
    episode: Episode, number: int, row: int, task: int, features: dict[str, Any]
) -> dict[str, NDArray[Any]]:
    """The columns of an episode in a data set of these features, with its number, first row and task."""
    columns, length = columns_of(episode), len(episode)
    if PRESENT in features:
        columns[PRESENT] = episode.present
    columns["episode_index"] = np.full(length, number)
    columns["index"] = np.arange(row, row + length)
    columns["task_index"] = np.full(length, task)
    return {name: columns[name] for name in features if name in columns}


def arrow_table(columns: dict[str, NDArray[Any]]) -> pa.Table:
    """Columns [T] or [T, n] as a table; n numbers become a list of fixed size."""
    return pa.table({name: _column(value) for name, value in columns.items()})


def _column(values: NDArray[Any]) -> pa.Array:
    if values.dtype == object:
        return pa.array(values.tolist(), pa.string())
    if values.ndim == 1:
        return pa.array(values)
    flat = pa.array(np.ascontiguousarray(values, np.float32).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def features_of(episode: Episode) -> dict[str, dict[str, Any]]:
    """The `features` of info.json for episodes like this one: pictures, its columns, the indices."""
    robot = episode.embodiment
    names: dict[str, Any] = {
        "action": list(robot.action_names),
        "observation.state": list(robot.state_names),
        COMMAND: list(robot.action_names),
        C2W: [f"{robot.views[k]}.{r}{c}" for k in robot.calibrated_views for r in range(4) for c in range(4)],
        INTRINSIC: [
            f"{robot.views[k]}.{r}{c}" for k in robot.calibrated_views for r in range(3) for c in range(3)
        ],
        POSES: [f"{arm.name}.{axis}" for arm in robot.arms for axis in _POSE],
    }
    features = {IMAGE_PREFIX + camera: _video_feature(episode.size, robot.fps) for camera in robot.views}
    for name, value in columns_of(episode).items():
        kind = "string" if value.dtype == object else str(value.dtype)
        shape = [1] if value.ndim == 1 else [value.shape[1]]
        features[name] = {"dtype": kind, "shape": shape, "names": names.get(name)}
    features["action"]["info"] = {INFO_KEY: to_info(robot)}
    for name, value in episode.privileged.items():
        features[PRIVILEGED + name]["info"] = {INFO_KEY: {"shape": list(value.shape[1:])}}
    for name in INDICES:
        features[name] = {"dtype": "int64", "shape": [1], "names": None}
    return features


def _video_feature(size: tuple[int, int], fps: float) -> dict[str, Any]:
    return {
        "dtype": "video",
        "shape": [*size, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.fps": plain_rate(fps),
            "video.height": size[0],
            "video.width": size[1],
            "video.channels": 3,
            "video.codec": "h264",
            "video.pix_fmt": "yuv444p",
            "video.is_depth_map": False,
            "has_audio": False,
        },
    }


def plain_rate(fps: float) -> float | int:
    """Frames per second as LeRobot writes them: 10, but 12.5."""
    return int(fps) if float(fps).is_integer() else float(fps)
