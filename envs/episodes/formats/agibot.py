"""AgiBot-World-Beta: one folder each for videos, camera parameters, joint readings and tasks.

Commands are the targets that the recording holds (action/*). Where it holds none for every frame, measured
joints stand in for them, which is said aloud: a policy then learns where the robot was, not where it was
sent. Flange poses are always the measured ones, which fit the pictures; their grippers are as commanded.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.embodiment import Embodiment
from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.formats.gesim import GENIE, VIEWS, closed_share, flange_poses
from envs.episodes.formats.recordings import Cut, Format, assemble
from envs.episodes.video import read_video

# Grippers are commanded as GE-Sim's are, 0 open .. 1 closed, and read as 35 open .. 120 closed.
AGIBOT: Embodiment = replace(
    GENIE,
    robot="agibot_g1",
    state_names=GENIE.action_names,
    arms=tuple(replace(arm, gripper_readings=(35.0, 120.0)) for arm in GENIE.arms),
)

# Of each frame, by arm.
_STATE = {
    "effector/position": (2,),
    "end/position": (2, 3),
    "end/orientation": (2, 4),
    "joint/position": (14,),
}
Targets = tuple[NDArray[np.float32], NDArray[np.float32]]


def _find(source: Path) -> list[Path]:
    return sorted(path.parent for path in source.glob("observations/*/*/videos"))


def _read(place: Path, number: int, cut: Cut) -> Episode:
    import h5py

    task, name, root = place.parent.name, place.name, place.parent.parent.parent
    readings = root / f"proprio_stats/{task}/{name}/proprio_stats.h5"
    try:
        with h5py.File(readings) as file:
            read = {
                key: np.asarray(file[f"state/{key}"], np.float32).reshape(-1, *shape)
                for key, shape in _STATE.items()
            }
            sent = _targets(file, len(read["joint/position"]))
    except (OSError, KeyError, ValueError) as error:
        raise EpisodeError(f"{readings}: {error}") from error
    length = len(read["joint/position"])
    if any(len(values) != length for values in read.values()):
        raise EpisodeError(f"{readings}: {', '.join(read)} are not of as many frames")
    folder = root / f"parameters/{task}/{name}/parameters/camera"
    cameras = [_camera(folder, view, length) for view in VIEWS]
    videos = [read_video(place / f"videos/{view}_color.mp4") for view in VIEWS]
    length = min(length, *(len(video) for video in videos), cut.frames or length)
    hands = read["effector/position"][:length]
    flanges = read["end/position"][:length], read["end/orientation"][:length]
    joints, closed = sent or (read["joint/position"], closed_share(read["effector/position"]))
    return assemble(
        AGIBOT,
        {row: [video[row] for video in videos] for row in range(length)},
        length,
        place,
        commands=_in_order(joints[:length], closed[:length]),
        states=_in_order(read["joint/position"][:length], hands),
        poses=flange_poses(*flanges, closed[:length]),
        c2w=np.stack([c2w[:length] for _, c2w in cameras], 1),
        intrinsic=np.stack([intrinsic for intrinsic, _ in cameras]),
        instruction=_task(root, task, name),
        seed=int(name) if name.isdigit() else number,
        source="agibot",
    )


def _targets(file: Any, length: int) -> Targets | None:
    """Joint targets [T, 14] and gripper targets [T, 2], 0 open .. 1 closed; None, with a warning, where they
    do not cover all frames.
    """
    targets = []
    for key, size in (("joint", 14), ("effector", 2)):
        group = file.get(f"action/{key}")
        if group is None or "position" not in group:
            return _warn_measured(f"there is no action/{key}/position")
        values = np.asarray(group["position"], np.float32)
        if values.shape != (length, size):
            return _warn_measured(f"action/{key}/position is not {size} numbers for every frame")
        if "index" in group and not set(range(length)) <= set(np.asarray(group["index"]).tolist()):
            return _warn_measured(f"action/{key}/index says that no target was sent in some frames")
        targets.append(values)
    joints, closed = targets
    if not np.isfinite(joints).all() or not ((closed > -0.1) & (closed < 1.1)).all():
        return _warn_measured("action/* holds NaN, or grippers that are no share of 0 open .. 1 closed")
    return joints, closed


def _warn_measured(reason: str) -> Targets | None:
    warnings.warn(
        f"AgiBot: {reason}; measured joints stand in for commands, so `action` says where the robot was a"
        " frame later and not where it was sent",
        stacklevel=4,
    )
    return None


def _in_order(arms: NDArray[np.float32], hands: NDArray[np.float32]) -> NDArray[np.float32]:
    """Joints [T, 14] and grippers [T, 2] as [L7, Lg, R7, Rg]."""
    return np.concatenate([arms[:, :7], hands[:, :1], arms[:, 7:], hands[:, 1:]], 1)


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
