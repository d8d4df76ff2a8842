"""GE-Sim's own recordings: bundles of GE-Sim 2.0, read and written, and samples of GE-Sim 1, read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from envs.embodiment import ActionKind, Arm, Camera, Embodiment
from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.formats.recordings import Cut, Format, assemble, read_numbers, read_picture

_ARMS = ("left", "right")
_JOINTS = tuple(f"joint{k}" for k in range(1, 8))
_POSE = ("x", "y", "z", "roll", "pitch", "yaw")
_GRIPPER = (35.0, 85.0)  # AgiBot's gripper readings: open, and how much further closed
VIEWS = ("head", "hand_left", "hand_right")
CAMERAS = (
    Camera("head", (0, 0), calibrated=True),
    Camera("hand_left", (0, 0), wrist="left", calibrated=True),
    Camera("hand_right", (0, 0), wrist="right", calibrated=True),
)

# The robot of GE-Sim 2.0: joint targets [L7, Lg, R7, Rg]; its state has grippers behind both arms, then the
# four joints of head and waist, as the bundles' state_joints_0.
GENIE = Embodiment(
    robot="genie",
    action_names=tuple(f"{arm}_{name}" for arm in _ARMS for name in (*_JOINTS, "gripper")),
    action_kind=ActionKind.JOINTS,
    delta=False,
    arms=(Arm("left", tuple(range(7)), 7), Arm("right", tuple(range(8, 15)), 15)),
    state_names=(
        *(f"{arm}_{name}" for arm in _ARMS for name in _JOINTS),
        *(f"{arm}_gripper" for arm in _ARMS),
        *("head_joint1", "head_joint2", "waist_joint1", "waist_joint2"),
    ),
    cameras=CAMERAS,
    fps=30.0,
    main_camera="head",
)
# The same robot by flange poses, as GE-Sim 1 commands it.
GENIE_POSES = replace(
    GENIE,
    robot="genie_poses",
    action_names=tuple(f"{arm}_{name}" for arm in _ARMS for name in (*_POSE, "gripper")),
    action_kind=ActionKind.END_EFFECTOR,
    arms=(Arm("left", tuple(range(6)), 6), Arm("right", tuple(range(7, 13)), 13)),
    state_names=tuple(f"{arm}_{name}" for arm in _ARMS for name in (*_POSE, "gripper")),
)


def closed_share(readings: NDArray[np.float32]) -> NDArray[np.float32]:
    """AgiBot's gripper readings as 0 open .. 1 closed, beyond where they go beyond."""
    return (readings - _GRIPPER[0]) / _GRIPPER[1]


def flange_poses(
    position: NDArray[np.float32], xyzw: NDArray[np.float32], closed: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Poses [T, 2, 7] of positions [T, 2, 3], quaternions [T, 2, 4] and shares closed [T, 2]."""
    angles = Rotation.from_quat(xyzw.reshape(-1, 4)).as_euler("xyz").reshape(*xyzw.shape[:-1], 3)
    return np.concatenate([position, angles, closed[..., None]], -1).astype(np.float32)


# -- GE-Sim 2.0
def _find_bundles(source: Path) -> list[Path]:
    name = "extrinsic_alignstate_0.npy"
    return sorted(path.parent for path in [*source.glob(name), *source.glob(f"*/{name}")])


def _read_bundle(place: Path, number: int, cut: Cut) -> Episode:
    c2w = read_numbers(place / "extrinsic_alignstate_0.npy", (3, None, 4, 4)).transpose(1, 0, 2, 3)
    length = len(c2w)
    try:
        task = (place / "task.txt").read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise EpisodeError(f"{place / 'task.txt'}: {error}") from error
    measured = place / "state_eef_poses_0.npy"
    achieved = read_numbers(measured, (length, 14)).reshape(-1, 2, 7)
    return assemble(
        GENIE,
        {0: [read_picture(place / f"cur_{view}.png") for view in ("head", "left", "right")]},
        length,
        place,
        commands=read_numbers(place / "actions_0.npy", (length, 16)),
        states=read_numbers(place / "state_joints_0.npy", (length, 20)),
        poses=read_numbers(place / "eef_poses_0.npy", (length, 14)).reshape(-1, 2, 7),
        c2w=c2w,
        intrinsic=read_numbers(place / "intrinsic.npy", (3, 3, 3)),
        instruction=task,
        seed=number,
        source="gesim2",
        privileged={"achieved_poses": achieved},
    )


def write_bundle(place: Path, episode: Episode) -> None:
    """Write an episode of the robot `genie` as a GE-Sim 2.0 bundle, a folder.

    Raises:
        EpisodeError: if it lacks what a bundle has.
    """
    other = GENIE.differs(episode.embodiment)
    if other or episode.c2w is None or episode.poses is None:
        lacks = other or "camera or flange poses are missing"
        raise EpisodeError(
            f"a GE-Sim 2.0 bundle needs the joints, cameras and flange poses of {GENIE.robot}: {lacks}"
        )
    place.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {
        "extrinsic_alignstate_0": episode.c2w.transpose(1, 0, 2, 3),
        "intrinsic": episode.intrinsic,
        "eef_poses_0": episode.poses.reshape(-1, 14),
        # Flange poses as measured, where they were kept; the commanded ones are the nearest there is.
        "state_eef_poses_0": episode.privileged.get("achieved_poses", episode.poses).reshape(-1, 14),
        "actions_0": episode.commands,
        "state_joints_0": episode.states,
    }
    for name, values in arrays.items():
        np.save(place / f"{name}.npy", np.ascontiguousarray(values, np.float32))
    for view, name in enumerate(("head", "left", "right")):
        cv2.imwrite(str(place / f"cur_{name}.png"), episode.frames[0, view].transpose(1, 2, 0)[..., ::-1])
    (place / "task.txt").write_text(episode.instruction, encoding="utf-8")


# -- GE-Sim 1
def _find_samples(source: Path) -> list[Path]:
    name = "extrinsic_head.npy"
    return sorted(path.parent for path in [*source.glob(name), *source.glob(f"*/{name}")])


def _read_sample(place: Path, number: int, cut: Cut) -> Episode:
    arms = read_numbers(place / "actions.npy", (None, 16)).reshape(-1, 2, 8)
    length = len(arms)
    names = sorted(int(path.stem) for path in (place / "head_color").glob("*.png") if path.stem.isdigit())
    if not names:
        raise EpisodeError(f"{place / 'head_color'} holds no pictures")
    closed = closed_share(arms[..., 7])
    commands = flange_poses(arms[..., :3], arms[..., 3:7], closed).reshape(length, 14)
    pictures = {
        row: [read_picture(place / f"{view}_color/{name}.png") for view in VIEWS]
        for row, name in enumerate(names)
    }
    return assemble(
        GENIE_POSES,
        pictures,
        length,
        place,
        commands=commands,
        states=commands,  # the sample holds no others
        c2w=np.stack([read_numbers(place / f"extrinsic_{view}.npy", (length, 4, 4)) for view in VIEWS], 1),
        intrinsic=np.stack([read_numbers(place / f"intrinsic_{view}.npy", (3, 3)) for view in VIEWS]),
        instruction="",
        seed=number,
        source="gesim1",
    )


GESIM2 = Format("GE-Sim 2.0 bundle", _find_bundles, _read_bundle)
GESIM1 = Format("GE-Sim 1 bundle", _find_samples, _read_sample)
