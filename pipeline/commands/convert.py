"""Recordings from elsewhere to LeRobot v3.0 and back, and pictures that show whether calibration holds."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from envs.conditioning import CANVAS, PoseMapStyle, end_effector_poses, render_pose_map
from envs.episodes import Episode, EpisodeError, LeRobotDataset, LeRobotWriter
from envs.episodes.formats.foreign import read_foreign
from envs.episodes.formats.gesim import write_bundle
from envs.episodes.formats.recordings import Cut
from envs.files import atomic, remove, write_json
from envs.geometry.kinematics import Kinematics
from pipeline.graph.owner import held_files, owning

_HALF = ".converting.json"  # in an unfinished target: what it is made of


def read_any(source: Path, cut: Cut | None = None) -> Iterator[Episode]:
    """Episodes of a LeRobot data set or of any known foreign format, so far as they are wanted."""
    cut = cut or Cut()
    if not (source / "meta/info.json").exists():
        return read_foreign(source, cut)
    size = (cut.size[0], cut.size[1]) if cut.size else None
    return (cut.of(episode) for episode in LeRobotDataset(source, size, privileged=True))


def convert(source: Path, target: Path, cut: Cut) -> int:
    """Write `source` as a LeRobot data set, or a LeRobot data set as GE-Sim 2.0 bundles, a folder each. What
    was interrupted goes on after the episodes that are there.

    Returns:
        How many episodes.

    Raises:
        EpisodeError: if the source is damaged or unknown, or the target holds something else.
        RunInUse: if another process converts into the same folder.
    """
    with owning(target, f"convert {source} {target}", "choose another folder", passing=True):
        half = target / _HALF
        wanted = {"source": str(source.resolve()), "frames": cut.frames, "size": list(cut.size)}
        if not half.exists():
            if set(target.iterdir()) - held_files(target):
                raise EpisodeError(f"{target} is not empty; choose a new folder")
            write_json(half, wanted)
        elif (begun := json.loads(half.read_text())) != wanted:
            raise EpisodeError(f"{target} holds half of another conversion, {begun}; choose a new folder")
        try:
            count = _write(source, target, cut)
        except EpisodeError:
            if set(target.iterdir()) - held_files(target) == {half}:  # nothing yet that could be gone on with
                remove(half)
            raise
        remove(half)
        return count


def _write(source: Path, target: Path, cut: Cut) -> int:
    """What `convert` does to a folder that it owns."""
    back = (source / "meta/info.json").exists()
    count = 0
    writer: LeRobotWriter | None = None
    for number, episode in enumerate(tqdm(read_any(source, cut), desc="convert", unit="ep")):
        count += 1
        bundle = target / f"episode_{number:06d}"
        if back:
            if not bundle.exists():
                with atomic(bundle) as part:
                    write_bundle(part, episode)
            continue
        writer = writer or LeRobotWriter(target, episode.embodiment)
        if number >= writer.episodes:
            writer.write([episode])
    return count


def overlay(
    frame: NDArray[np.uint8], pose_map: NDArray[np.uint8], strength: float = 0.6
) -> NDArray[np.uint8]:
    """A pose map laid over a frame, both uint8 [3, H, W] -> RGB uint8 [H, W, 3]."""
    drawn = (pose_map != CANVAS).any(0)[..., None]
    mixed = (1 - strength) * frame.transpose(1, 2, 0) + strength * pose_map.transpose(1, 2, 0)
    return np.where(drawn, mixed, frame.transpose(1, 2, 0)).round().astype(np.uint8)


def why_bare(episode: Episode) -> str:
    """Why no grippers can be drawn into an episode's pictures; "" if they can."""
    robot = episode.embodiment
    if episode.c2w is None:
        return f"nothing is drawn: cameras {list(robot.views)} of {robot.robot} are not calibrated"
    if episode.poses is None and not robot.commands_poses:
        return (
            f"nothing is drawn: the actions of {robot.robot} ({robot.action_kind.value}, delta={robot.delta})"
            " do not say where its flanges will be, and no flange poses were recorded"
        )
    return ""


def inspect(
    source: Path, target: Path, cut: Cut, style: PoseMapStyle, rows: int = 4, episodes: int = 8
) -> list[Path]:
    """A picture per episode: some of its frames, a row each with all views side by side, the commanded
    grippers drawn over them, or a word about why they are not. Where cameras record pictures of different
    sizes, and no size is asked for, all take the main camera's.
    """
    target.mkdir(parents=True, exist_ok=True)
    made: list[Path] = []
    warned: set[str] = set()
    cut = cut if cut.size else replace(cut, size=_common_size(source))
    for number, episode in enumerate(islice(read_any(source, cut), episodes)):
        shown = np.flatnonzero(episode.present)
        shown = shown[np.linspace(0, len(shown) - 1, min(rows, len(shown))).round().astype(int)]
        part, bare = episode.take(shown), why_bare(episode)
        if bare and bare not in warned:
            tqdm.write(f"{source.name}, from episode {number} on: {bare}")
            warned.add(bare)
        maps = np.full_like(part.frames, CANVAS) if bare else _pose_maps(part, style)
        sheet = np.concatenate(
            [
                np.concatenate(
                    [overlay(frame, drawn) for frame, drawn in zip(views, drawings, strict=True)], 1
                )
                for views, drawings in zip(part.frames, maps, strict=True)
            ]
        )
        path = target / f"{source.name}-{number:03d}.png"
        cv2.imwrite(str(path), sheet[..., ::-1])
        made.append(path)
    return made


def _common_size(source: Path) -> tuple[int, ...]:
    """The main camera's (height, width) of a LeRobot data set whose cameras' differ, () elsewhere."""
    if not (source / "meta/info.json").exists():
        return ()
    robot = LeRobotDataset(source, (1, 1)).recorded
    sizes = {camera.size for camera in robot.cameras}
    return robot.cameras[robot.main_view].size if len(sizes) > 1 else ()


def _pose_maps(episode: Episode, style: PoseMapStyle) -> NDArray[np.uint8]:
    """Pose maps uint8 [T, V, 3, H, W]; uncalibrated cameras among others stay bare."""
    assert episode.c2w is not None and episode.intrinsic is not None
    robot = episode.embodiment
    if robot.commands_poses:  # as worlds are told them
        kinematics = None if robot.kinematics is None else Kinematics(robot.kinematics)
        poses = end_effector_poses(robot, torch.from_numpy(episode.commands), kinematics)
    else:
        assert episode.poses is not None
        poses = torch.from_numpy(episode.poses)
    c2w = torch.from_numpy(episode.c2w).nan_to_num().transpose(0, 1)
    intrinsic = torch.from_numpy(episode.intrinsic).nan_to_num()
    return render_pose_map(poses, c2w, intrinsic, episode.size, style).transpose(0, 1).numpy()
