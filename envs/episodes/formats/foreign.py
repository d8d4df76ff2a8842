"""Other people's recordings as Episodes: GE-Sim 2.0 and GE-Sim 1 bundles, AgiBot-World-Beta, Bridge clips of
WPE.

Every reader keeps the calibration as it is (only resizing scales intrinsics) and says NaN of what its source
does not
know. `read_foreign` tells the formats apart by what lies in a folder.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.video import read_video
from envs.layouts import JointLayout, Joints
from envs.specs import ACTION_DIM, OBJECT_DIM, STATE_DIM

VIEWS = ("head", "hand_left", "hand_right")
_GRIPPER = (35.0, 85.0)  # AgiBot's gripper readings: open, and how much further closed


@dataclass(frozen=True)
class Cut:
    """How much of a recording to keep.

    Args:
        frames: the first so many, 0 for all.
        size: (height, width) to resize to, () for the source's own; intrinsics are scaled alike.
    """

    frames: int = 0
    size: tuple[int, ...] = ()

    def of(self, episode: Episode) -> Episode:
        """The episode so cut."""
        keep = slice(0, self.frames or len(episode))
        names = ("frames", "commands", "achieved", "states", "c2w", "success", "progress", "objects", "seen")
        parts: dict[str, Any] = {name: getattr(episode, name)[keep] for name in names}
        if episode.recorded is not None:
            parts["recorded"] = episode.recorded[keep]
        if self.size and tuple(episode.frames.shape[-2:]) != self.size:
            parts["frames"], parts["intrinsic"] = resize(
                parts["frames"], parts["seen"], episode.intrinsic, self.size
            )
        return replace(episode, **parts)


def resize(
    frames: NDArray[np.uint8], seen: NDArray[np.bool_], intrinsic: NDArray[np.float32], size: tuple[int, ...]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Frames [T, V, 3, H, W] and intrinsics [V, 3, 3] at another size; pixel centres lie at +0.5."""
    height, width = frames.shape[-2:]
    out = np.zeros((*frames.shape[:3], *size), np.uint8)
    for t in np.flatnonzero(seen):
        for v in range(frames.shape[1]):
            small = cv2.resize(
                frames[t, v].transpose(1, 2, 0), (size[1], size[0]), interpolation=cv2.INTER_AREA
            )
            out[t, v] = small.transpose(2, 0, 1)
    scale = np.array([[size[1] / width], [size[0] / height], [1.0]], np.float32)
    return out, intrinsic * scale


def read_foreign(source: Path, cut: Cut | None = None) -> Iterator[Episode]:
    """Every episode under a folder of one of the known formats.

    Raises:
        EpisodeError: if there is none, or one is damaged.
    """
    source, cut = Path(source), cut or Cut()
    for form in FORMS:
        places = form.find(source)
        if places:
            return (cut.of(form.read(place, number, cut)) for number, place in enumerate(places))
    raise EpisodeError(
        f"{source} holds no recording in a known format: {', '.join(form.name for form in FORMS)}, or LeRobot v3.0 (meta/info.json)"
    )


@dataclass(frozen=True)
class Form:
    """A format: its name, where recordings of it lie under a folder, and what reads one."""

    name: str
    find: Callable[[Path], list[Path]]
    read: Callable[[Path, int, Cut], Episode]


def _numbers(path: Path, shape: tuple[int | None, ...]) -> NDArray[np.float32]:
    """A .npy array of a shape (None is any length), without pickles."""
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise EpisodeError(f"{path}: {error}") from error
    if values.ndim != len(shape) or any(
        want is not None and have != want for have, want in zip(values.shape, shape, strict=True)
    ):
        raise EpisodeError(
            f"{path} has shape {values.shape}, expected {tuple('T' if want is None else want for want in shape)}"
        )
    if not np.isfinite(values).all():
        raise EpisodeError(f"{path} holds NaN or infinite values")
    return values.astype(np.float32)


def _picture(path: Path) -> NDArray[np.uint8]:
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    if picture is None:
        raise EpisodeError(f"{path} is missing or no readable picture")
    return picture.transpose(2, 0, 1)


def _assemble(
    pictures: dict[int, list[NDArray[np.uint8]]], length: int, place: Path, **known: Any
) -> Episode:
    """An episode of `length` rows of which only some have pictures, by row; everything else is NaN unless
    known.
    """
    shape = np.stack(next(iter(pictures.values()))).shape
    frames, seen = np.zeros((length, *shape), np.uint8), np.zeros(length, bool)
    for row, views in pictures.items():
        if any(view.shape != shape[1:] for view in views):
            raise EpisodeError(f"{place}: pictures of different sizes {[view.shape for view in views]}")
        frames[row], seen[row] = np.stack(views), True
    nothing = {"commands": ACTION_DIM, "states": STATE_DIM}
    values = {name: np.full((length, width), np.nan, np.float32) for name, width in nothing.items()} | known
    values.setdefault("achieved", values["commands"])
    values.setdefault("c2w", np.full((length, shape[0], 4, 4), np.nan, np.float32))
    return Episode(
        frames=frames,
        seen=seen,
        success=np.zeros(length, bool),
        progress=np.zeros(length, np.float32),
        objects=np.full((length, 2, OBJECT_DIM), np.nan, np.float32),
        **values,
    )


# -- GE-Sim 2.0
# ----------------------------------------------------------------------------------------------------
def _find_gesim2(source: Path) -> list[Path]:
    return sorted(
        path.parent
        for path in [*source.glob("extrinsic_alignstate_0.npy"), *source.glob("*/extrinsic_alignstate_0.npy")]
    )


def _read_gesim2(place: Path, number: int, cut: Cut) -> Episode:
    c2w = _numbers(place / "extrinsic_alignstate_0.npy", (3, None, 4, 4)).transpose(1, 0, 2, 3)
    length = len(c2w)
    joints = torch.from_numpy(_numbers(place / "state_joints_0.npy", (length, 20))[:, :16])
    try:
        task = (place / "task.txt").read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise EpisodeError(f"{place / 'task.txt'}: {error}") from error
    return _assemble(
        {0: [_picture(place / f"cur_{view}.png") for view in ("head", "left", "right")]},
        length,
        place,
        commands=_numbers(place / "eef_poses_0.npy", (length, 14)),
        achieved=_numbers(place / "state_eef_poses_0.npy", (length, 14)),
        states=Joints(joints, JointLayout.GRIPPERS_LAST).to(JointLayout.PER_ARM).numpy(),
        c2w=c2w,
        intrinsic=_numbers(place / "intrinsic.npy", (3, 3, 3)),
        recorded=_numbers(place / "actions_0.npy", (length, 16)),
        recorded_layout="joints",
        instruction=task,
        seed=number,
        behaviour="gesim2",
        views=VIEWS,
        fps=30.0,
    )


def write_gesim2(place: Path, episode: Episode) -> None:
    """An episode of three views as a GE-Sim 2.0 bundle; joints that Worldloop does not keep (head, waist) are
    zero.

    Raises:
        EpisodeError: if it lacks what a bundle has.
    """
    if (
        episode.views != VIEWS
        or episode.recorded_layout != "joints"
        or not np.isfinite(episode.c2w).all()
        or not np.isfinite(episode.states).all()
    ):
        raise EpisodeError(
            f"a GE-Sim 2.0 bundle needs views {VIEWS}, their poses, joint states and joint commands; this episode has views {episode.views} and actions {episode.recorded_layout or 'of end effectors only'!r}"
        )
    place.mkdir(parents=True, exist_ok=True)
    joints = (
        Joints(torch.from_numpy(episode.states), JointLayout.PER_ARM).to(JointLayout.GRIPPERS_LAST).numpy()
    )
    arrays = {
        "extrinsic_alignstate_0": episode.c2w.transpose(1, 0, 2, 3),
        "intrinsic": episode.intrinsic,
        "eef_poses_0": episode.commands,
        "state_eef_poses_0": episode.achieved,
        "actions_0": episode.recorded,
        "state_joints_0": np.concatenate([joints, np.zeros((len(joints), 4), np.float32)], 1),
    }
    for name, values in arrays.items():
        np.save(place / f"{name}.npy", np.ascontiguousarray(values, np.float32))
    for view, name in enumerate(("head", "left", "right")):
        cv2.imwrite(str(place / f"cur_{name}.png"), episode.frames[0, view].transpose(1, 2, 0)[..., ::-1])
    (place / "task.txt").write_text(episode.instruction, encoding="utf-8")


# -- GE-Sim 1
# ------------------------------------------------------------------------------------------------------
def _find_gesim1(source: Path) -> list[Path]:
    return sorted(
        path.parent for path in [*source.glob("extrinsic_head.npy"), *source.glob("*/extrinsic_head.npy")]
    )


def quaternion_poses(position: NDArray[np.float32], xyzw: NDArray[np.float32]) -> NDArray[np.float32]:
    """[..., 6] = x, y, z, roll, pitch, yaw of positions [..., 3] and quaternions [..., 4]."""
    x, y, z, w = np.moveaxis(xyzw.astype(np.float64) / np.linalg.norm(xyzw, axis=-1, keepdims=True), -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.concatenate([position, np.stack([roll, pitch, yaw], -1)], -1).astype(np.float32)


def _commands(
    position: NDArray[np.float32], xyzw: NDArray[np.float32], gripper: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Commands [T, 14] of positions [T, 2, 3], quaternions [T, 2, 4] and AgiBot's gripper readings [T, 2]."""
    closed = np.clip((gripper - _GRIPPER[0]) / _GRIPPER[1], 0, 1)[..., None]
    return (
        np.concatenate([quaternion_poses(position, xyzw), closed], -1)
        .reshape(len(position), 14)
        .astype(np.float32)
    )


def _read_gesim1(place: Path, number: int, cut: Cut) -> Episode:
    arms = _numbers(place / "actions.npy", (None, 16)).reshape(-1, 2, 8)
    length = len(arms)
    names = sorted(int(path.stem) for path in (place / "head_color").glob("*.png") if path.stem.isdigit())
    if not names:
        raise EpisodeError(f"{place / 'head_color'} holds no pictures")
    return _assemble(
        {
            row: [_picture(place / f"{view}_color/{name}.png") for view in VIEWS]
            for row, name in enumerate(names)
        },
        length,
        place,
        commands=_commands(arms[..., :3], arms[..., 3:7], arms[..., 7]),
        c2w=np.stack([_numbers(place / f"extrinsic_{view}.npy", (length, 4, 4)) for view in VIEWS], 1),
        intrinsic=np.stack([_numbers(place / f"intrinsic_{view}.npy", (3, 3)) for view in VIEWS]),
        instruction="",
        seed=number,
        behaviour="gesim1",
        views=VIEWS,
        fps=30.0,
    )


# -- AgiBot-World-Beta
# ---------------------------------------------------------------------------------------------
def _find_agibot(source: Path) -> list[Path]:
    return sorted(path.parent for path in source.glob("observations/*/*/videos"))


def _read_agibot(place: Path, number: int, cut: Cut) -> Episode:
    import h5py

    task, name, root = place.parent.name, place.name, place.parent.parent.parent
    stats = root / f"proprio_stats/{task}/{name}/proprio_stats.h5"
    try:
        with h5py.File(stats) as file:
            read = {
                key: np.asarray(file[f"state/{key}"], np.float32)
                for key in ("effector/position", "end/position", "end/orientation", "joint/position")
            }
    except (OSError, KeyError) as error:
        raise EpisodeError(f"{stats}: {error}") from error
    length = len(read["joint/position"])
    cameras = [
        _agibot_camera(root / f"parameters/{task}/{name}/parameters/camera", view, length) for view in VIEWS
    ]
    videos = [read_video(place / f"videos/{view}_color.mp4") for view in VIEWS]
    length = min(length, *(len(video) for video in videos))
    length = min(length, cut.frames) if cut.frames else length
    arms, hands = read["joint/position"][:length], read["effector/position"][:length].reshape(length, 2)
    joints = np.concatenate([arms[:, :7], hands[:, :1], arms[:, 7:], hands[:, 1:]], 1)
    return _assemble(
        {row: [video[row] for video in videos] for row in range(length)},
        length,
        place,
        commands=_commands(read["end/position"][:length], read["end/orientation"][:length], hands),
        states=joints,
        recorded=joints,
        recorded_layout="joints",
        c2w=np.stack([c2w[:length] for _, c2w in cameras], 1),
        intrinsic=np.stack([intrinsic for intrinsic, _ in cameras]),
        instruction=_agibot_task(root, task, name),
        seed=int(name) if name.isdigit() else number,
        behaviour="agibot",
        views=VIEWS,
        fps=30.0,
    )


def _agibot_camera(folder: Path, view: str, length: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
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


def _agibot_task(root: Path, task: str, name: str) -> str:
    path = root / f"task_info/task_{task}.json"
    if not path.exists():
        return ""
    rows = json.loads(path.read_text())
    found = [row.get("task_name", "") for row in rows if str(row.get("episode_id")) == name]
    return found[0] if found else ""


# -- Bridge
# --------------------------------------------------------------------------------------------------------
def _find_bridge(source: Path) -> list[Path]:
    return sorted(path for path in source.glob("*.mp4") if path.with_suffix(".npz").exists())


def _read_bridge(place: Path, number: int, cut: Cut) -> Episode:
    """One camera without calibration, one arm whose motions are normalised by numbers nobody published: poses
    stay unknown.
    """
    video = read_video(place)
    try:
        with np.load(place.with_suffix(".npz"), allow_pickle=False) as file:
            actions = file["arr_0"].astype(np.float32)
    except (OSError, ValueError, KeyError) as error:
        raise EpisodeError(f"{place.with_suffix('.npz')}: {error!r}") from error
    length = min(len(video), len(actions))
    height, width = video.shape[-2:]
    return _assemble(
        {row: [video[row]] for row in range(length)},
        length,
        place,
        intrinsic=np.array([[[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]], np.float32),
        recorded=actions[:length],
        recorded_layout="wpe-bridge",
        instruction="",
        seed=int(place.stem) if place.stem.isdigit() else number,
        behaviour="bridge",
        views=("head",),
        fps=20.0,
    )


FORMS = (
    Form("GE-Sim 2.0 bundle", _find_gesim2, _read_gesim2),
    Form("GE-Sim 1 bundle", _find_gesim1, _read_gesim1),
    Form("AgiBot-World-Beta", _find_agibot, _read_agibot),
    Form("Bridge clips", _find_bridge, _read_bridge),
)
