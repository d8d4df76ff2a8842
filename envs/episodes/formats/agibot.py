"""AgiBot-World-Beta: one folder each for videos, camera parameters, joint readings and tasks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from envs.embodiment import Embodiment
from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.formats.gesim import GENIE, VIEWS, flange_poses
from envs.episodes.formats.recordings import Cut, Format, assemble
from envs.episodes.video import read_video

# Joint positions serve as state and as command: the set holds no targets. Grippers are as read, 35 open ..
# 120 closed.
AGIBOT: Embodiment = replace(
    GENIE,
    robot="agibot_g1",
    state_names=GENIE.action_names,
    arms=tuple(replace(arm, gripper_range=(35.0, 120.0)) for arm in GENIE.arms),
)


def _find(source: Path) -> list[Path]:
    return sorted(path.parent for path in source.glob("observations/*/*/videos"))


def _read(place: Path, number: int, cut: Cut) -> Episode:
    import h5py

    task, name, root = place.parent.name, place.name, place.parent.parent.parent
    readings = root / f"proprio_stats/{task}/{name}/proprio_stats.h5"
    try:
        with h5py.File(readings) as file:
            read = {
                key: np.asarray(file[f"state/{key}"], np.float32)
                for key in ("effector/position", "end/position", "end/orientation", "joint/position")
            }
    except (OSError, KeyError) as error:
        raise EpisodeError(f"{readings}: {error}") from error
    length = len(read["joint/position"])
    folder = root / f"parameters/{task}/{name}/parameters/camera"
    cameras = [_camera(folder, view, length) for view in VIEWS]
    videos = [read_video(place / f"videos/{view}_color.mp4") for view in VIEWS]
    length = min(length, *(len(video) for video in videos), cut.frames or length)
    arms, hands = read["joint/position"][:length], read["effector/position"][:length].reshape(length, 2)
    joints = np.concatenate([arms[:, :7], hands[:, :1], arms[:, 7:], hands[:, 1:]], 1)
    return assemble(
        AGIBOT,
        {row: [video[row] for video in videos] for row in range(length)},
        length,
        place,
        commands=joints,
        states=joints,
        poses=flange_poses(read["end/position"][:length], read["end/orientation"][:length], hands),
        c2w=np.stack([c2w[:length] for _, c2w in cameras], 1),
        intrinsic=np.stack([intrinsic for intrinsic, _ in cameras]),
        instruction=_task(root, task, name),
        seed=int(name) if name.isdigit() else number,
        source="agibot",
    )


def _camera(folder: Path, view: str, length: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Intrinsics [3, 3] and poses [T, 4, 4] of a camera."""
    inner, outer = folder / f"{view}_intrinsic_params.json", folder / f"{view}_extrinsic_params_aligned.json"
    try:
        k = json.loads(inner.read_text())["intrinsic"]
        poses = [row["extrinsic"] for row in json.loads(outer.read_text())]
        intrinsic = np.array([[k["fx"], 0, k["ppx"]], [0, k["fy"], k["ppy"]], [0, 0, 1]], np.float32)
        c2w = np.tile(np.eye(4, dtype=np.float32), (len(poses), 1, 1))
        c2w[:, :3, :3] = [pose["rotation_matrix"] for pose in poses]
        c2w[:, :3, 3] = [pose["translation_vector"] for pose in poses]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EpisodeError(f"{inner} or {outer.name}: {error!r}") from error
    if len(c2w) < length:  # a camera that never moved may have one row
        c2w = np.concatenate([c2w, np.repeat(c2w[-1:], length - len(c2w), 0)])
    return intrinsic, c2w


def _task(root: Path, task: str, name: str) -> str:
    path = root / f"task_info/task_{task}.json"
    if not path.exists():
        return ""
    rows = json.loads(path.read_text())
    found = [row.get("task_name", "") for row in rows if str(row.get("episode_id")) == name]
    return str(found[0]) if found else ""


AGIBOT_BETA = Format("AgiBot-World-Beta", _find, _read)
