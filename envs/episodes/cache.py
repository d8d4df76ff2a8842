"""Decoded pictures of a data set behind a memory map, and its numbers, made once for each way of reading it.

A cache is a folder: frames.npy and, where pose maps are drawn, pose_maps.npy, uint8 [N, V, 3, H, W]; an .npy
per numeric array; and info.json, written last. It is built under another name and renamed, so that it is
there whole or not at all, and several processes may build it at once. Its name says how the data are read
(size, pose maps, robot), its info.json which state of the data it holds; data that changed are read again.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import shutil
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from envs.conditioning import PoseMapStyle, end_effector_poses, render_pose_map
from envs.embodiment import ActionKind
from envs.episodes.angles import check_poses, check_radians, turned_steadily
from envs.episodes.episode import Episode, EpisodeError
from envs.episodes.formats.lerobot import version2
from envs.episodes.formats.lerobot.dataset import LeRobotDataset
from envs.episodes.formats.lerobot.robot import cameras_without_columns
from envs.files import files_below, new_neighbour, put
from envs.geometry.cameras import follow_wrists
from envs.geometry.kinematics import Kinematics
from envs.manifest import check_part
from envs.specs import WorldSpec

log = logging.getLogger(__name__)
_FORM = "9"  # changes when what a cache holds does


@dataclass
class CachedSet:
    """One data set as arrays; row i of each is one video frame, episodes one after the other.

    Args:
        folder: the data set.
        info: episodes (length, instruction, source, seed, success), intrinsic and splits.
        frames: uint8 [N, V, 3, H, W] behind a memory map.
        pose_maps: likewise, None if they are not drawn.
        arrays: commands, states, success, present, and c2w of calibrated robots.
    """

    folder: Path
    info: dict[str, Any]
    frames: NDArray[np.uint8]
    pose_maps: NDArray[np.uint8] | None
    arrays: dict[str, NDArray[Any]]


def open_cached(folder: Path, spec: WorldSpec, style: PoseMapStyle, chosen: Path | None) -> CachedSet:
    """Open the cache of a data set, making it first if it is missing or older than the data.

    Args:
        folder: a LeRobot data set.
        spec: how it is read.
        style: how pose maps are drawn.
        chosen: folder for caches; None takes $WORLDLOOP_CACHE, else one beside the data, and where nothing
            can be written there one in ~/.cache/worldloop.

    Raises:
        EpisodeError: if the data are damaged, or those of another robot.
        DamagedArtefact: if they are part of a finished stage and have changed since.
        OSError: if there is no room for the cache; the message names it and its size.
    """
    if not (folder / "meta/info.json").exists():
        raise EpisodeError(f"{folder} is not a LeRobot data set: {folder / 'meta/info.json'} is missing")
    # Only how the data are read decides; the length of a chunk does not.
    reading = repr((replace(spec, chunk=1, ray_map=False), style if spec.pose_map else None, _FORM))
    name = f"{spec.size[0]}x{spec.size[1]}-{hashlib.sha256(reading.encode()).hexdigest()[:12]}"
    stamp, places = _stamp(folder), [place / name for place in _places(folder, chosen)]
    for place in places:
        if _holds(place, stamp):
            return _load(folder, place)
    for place in places:
        part = _new_folder(place)
        if part is None:
            continue
        try:
            check_part(folder.resolve())
            _Builder(folder, spec, style).build(part, stamp)
            put(part, place, partial(_holds, place, stamp))
        finally:
            shutil.rmtree(part, ignore_errors=True)
        return _load(folder, place)
    raise OSError(
        errno.EROFS,
        f"no cache of {folder} can be written to {', '.join(str(place.parent) for place in places)}; name a"
        " folder in $WORLDLOOP_CACHE",
    )


def _places(folder: Path, chosen: Path | None) -> list[Path]:
    """Folders for caches of a data set, the most wanted first."""
    real = folder.resolve()
    own = f"{real.name}-{hashlib.sha256(str(real).encode()).hexdigest()[:12]}"
    configured = chosen or os.environ.get("WORLDLOOP_CACHE")
    if configured:
        return [Path(configured) / own]
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return [real.parent / f".cache-{real.name}", home / "worldloop" / own]


def _stamp(folder: Path) -> str:
    """Changes whenever a file of the data set does."""
    digest = hashlib.sha256((folder / "meta/info.json").read_bytes())
    meta = ("meta/tasks.parquet", version2.TASKS, version2.EPISODES)
    found = [
        *files_below(folder / "meta/episodes"),
        *(folder / name for name in meta if (folder / name).is_file()),
    ]
    for kind in ("data", "videos", "images"):
        found += files_below(folder / kind)
    for path in found:
        about = path.stat()
        key = f"{path.relative_to(folder)} {about.st_size} {about.st_mtime_ns}"
        digest.update(key.encode())
    return digest.hexdigest()


def _holds(place: Path, stamp: str) -> bool:
    try:
        return bool(json.loads((place / "info.json").read_text())["stamp"] == stamp)
    except (OSError, ValueError, KeyError):
        return False


def _new_folder(place: Path) -> Path | None:
    """An empty folder beside `place`, None where nothing can be written."""
    try:
        return new_neighbour(place)
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise
        return None


def _load(folder: Path, place: Path) -> CachedSet:
    info = json.loads((place / "info.json").read_text())
    maps = place / "pose_maps.npy"
    return CachedSet(
        folder,
        info,
        np.load(place / "frames.npy", mmap_mode="r"),
        np.load(maps, mmap_mode="r") if maps.exists() else None,
        {name: np.load(place / f"{name}.npy") for name in info["arrays"]},
    )


def _reserve(path: Path, shape: tuple[int, ...]) -> np.memmap[Any, np.dtype[np.uint8]]:
    """A writable memory map of a new .npy file whose room on disk is certain: a full disk would otherwise end
    the process with a bus error in the middle of writing.
    """
    np.lib.format.open_memmap(path, "w+", np.uint8, shape).flush()
    size = path.stat().st_size
    try:
        with path.open("r+b") as file:
            os.posix_fallocate(file.fileno(), 0, size)
    except OSError as error:
        raise OSError(
            error.errno,
            f"a cache of {size / 1e9:.2f} GB does not fit at {path.parent}: {error.strerror}; make room, or"
            " name another folder in $WORLDLOOP_CACHE",
            str(path),
        ) from error
    return np.lib.format.open_memmap(path, "r+")


class _Builder:
    def __init__(self, folder: Path, spec: WorldSpec, style: PoseMapStyle):
        self.spec, self.style = spec, style
        self.data = LeRobotDataset(folder, spec.size, embodiment=spec.embodiment)
        if lost := cameras_without_columns(self.data.info):
            log.warning(
                "%s lacks calibration.c2w or calibration.intrinsic, though its info.json says that cameras %s"
                " are calibrated; it is read without",
                *(folder, lost),
            )
        self.known = np.array([camera.calibrated for camera in spec.embodiment.cameras])
        robot = spec.embodiment.kinematics
        self.kinematics = Kinematics(robot) if robot is not None and spec.embodiment.calibrated else None
        here, said = self.data.embodiment, spec.embodiment
        if missing := set(said.calibrated_views) - set(here.calibrated_views):
            raise EpisodeError(
                f"{folder} has no calibration of {[said.views[view] for view in sorted(missing)]}, but"
                f" {said.robot} is said to have; set calibrated=false of these cameras in the embodiment, or"
                " record calibration.c2w"
            )

    def build(self, place: Path, stamp: str) -> None:
        """Fill the folder `place`."""
        total = sum(int(row["length"]) for row in self.data.rows)
        if not total:
            raise EpisodeError(f"{self.data.root} holds no episodes yet")
        shape = (total, self.spec.views, 3, *self.spec.size)
        frames = _reserve(place / "frames.npy", shape)
        maps = _reserve(place / "pose_maps.npy", shape) if self.spec.pose_map else None
        columns: dict[str, list[NDArray[Any]]] = {}
        episodes, intrinsics, row = [], [], 0
        name = f"cache of {self.data.root.name}"
        for episode in tqdm(self.data, desc=name, unit="ep", dynamic_ncols=True, leave=False, delay=3):
            rows = slice(row, row + len(episode))
            frames[rows] = episode.frames
            numbers = self._numbers(episode)
            if maps is not None:
                maps[rows] = self._pose_maps(episode, numbers["c2w"])
            for name, values in numbers.items():
                columns.setdefault(name, []).append(values)
            episodes.append(
                {
                    "length": len(episode),
                    "instruction": episode.instruction,
                    "source": episode.source,
                    "seed": episode.seed,
                    "success": episode.succeeded,
                }
            )
            if self.spec.embodiment.calibrated and episode.intrinsic is not None:
                intrinsics.append(np.where(self.known[:, None, None], episode.intrinsic, 0).tolist())
            row = rows.stop
        frames.flush()
        if maps is not None:
            maps.flush()
        for name, parts in columns.items():
            np.save(place / f"{name}.npy", np.concatenate(parts))
        info = {
            "stamp": stamp,
            "arrays": list(columns),
            "episodes": episodes,
            "intrinsic": intrinsics,
            "splits": self.data.info.get("splits") or {},
        }
        (place / "info.json").write_text(json.dumps(info))

    def _numbers(self, episode: Episode) -> dict[str, NDArray[Any]]:
        unlabelled = np.zeros(len(episode), bool)
        numbers: dict[str, NDArray[Any]] = {
            "commands": turned_steadily(self.spec.embodiment, episode.commands),
            "states": episode.states,
            "success": unlabelled if episode.success is None else episode.success,
            "present": episode.present,
        }
        if self.spec.embodiment.calibrated:
            numbers["c2w"] = self._cameras(episode).numpy()
        return numbers

    def _poses(self, episode: Episode) -> Tensor | None:
        """Flange poses [T, arms, 7]: of the commands, as in imagination, where these or the robot's
        kinematics say them; else those recorded, if any.
        """
        if not self.spec.embodiment.commands_poses:
            return None if episode.poses is None else torch.from_numpy(episode.poses)
        joints = self.spec.embodiment.action_kind is ActionKind.JOINTS
        check = check_radians if joints else check_poses
        check(self.spec.embodiment, episode.commands, self.data.root)
        return end_effector_poses(self.spec.embodiment, torch.from_numpy(episode.commands), self.kinematics)

    def _cameras(self, episode: Episode) -> Tensor:
        """Camera poses [T, V, 4, 4] as in imagination, where nobody can measure them: wrist cameras where the
        commands lead them; all where they were at first if commands do not say it. Zeros of cameras that are
        not calibrated.
        """
        assert episode.c2w is not None
        known = torch.from_numpy(self.known)[:, None, None]
        c2w, poses = torch.from_numpy(episode.c2w).where(known, 0.0), self._poses(episode)
        if poses is None:
            return c2w[:1].expand_as(c2w)
        return follow_wrists(c2w[0], poses[0], poses, self.spec.embodiment.wrists)

    def _pose_maps(self, episode: Episode, c2w: NDArray[np.float32]) -> NDArray[np.uint8]:
        poses = self._poses(episode)
        if poses is None or episode.intrinsic is None:
            raise EpisodeError(
                f"{self.data.root}: episode {episode.seed} has no end_effector.command or no calibration, so"
                " no pose map can be drawn; set simulator.pose_map=false, or simulator.kinematics for joints"
            )
        maps = render_pose_map(
            poses,
            torch.from_numpy(c2w).transpose(0, 1),
            torch.from_numpy(episode.intrinsic),
            self.spec.size,
            self.style,
        )
        return maps.transpose(0, 1).numpy()
