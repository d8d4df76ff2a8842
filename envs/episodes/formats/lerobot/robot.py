"""The robot of a LeRobot data set: what info.json says of it, and what its reader knows besides."""

from __future__ import annotations

from dataclasses import replace
from math import prod
from typing import Any

from envs.embodiment import Embodiment, EmbodimentError
from envs.episodes.formats.lerobot import columns as names
from envs.episodes.formats.lerobot.info import described_here, from_info, shape_in


def agreed_robot(info: dict[str, Any], given: Embodiment | None = None) -> Embodiment:
    """The robot of a data set, as its info.json and the reader's own knowledge say together.

    A data set with our description must agree in all that numbers mean; of another one, names that it lacks
    and what its actions are is taken from the given robot.

    Raises:
        EmbodimentError: if they contradict each other.
    """
    recorded = _known_cameras(from_info(info), info["features"])
    if given is None:
        return recorded
    known = recorded
    if not described_here(info["features"]):
        known = replace(recorded, action_kind=given.action_kind, delta=given.delta)
        for field in ("action_names", "state_names"):
            unnamed = tuple(str(k) for k in range(len(getattr(recorded, field))))
            if getattr(recorded, field) == unnamed and len(getattr(given, field)) == len(unnamed):
                known = replace(known, **{field: getattr(given, field)})
    other = given.differs(known)
    if other:
        raise EmbodimentError(f"the data are of another robot: {other}")
    cameras = tuple(
        replace(mine, size=theirs.size)
        for mine, theirs in zip(alike_calibrated(given, recorded).cameras, recorded.cameras, strict=True)
    )
    return replace(given, cameras=cameras)


def alike_calibrated(robot: Embodiment, other: Embodiment) -> Embodiment:
    """The robot, of whose cameras those are calibrated that are so of the other one, too."""
    cameras = tuple(
        replace(mine, calibrated=mine.calibrated and theirs.calibrated)
        for mine, theirs in zip(robot.cameras, other.cameras, strict=True)
    )
    return replace(robot, cameras=cameras)


def cameras_without_columns(info: dict[str, Any]) -> list[str]:
    """Names of the cameras that info.json says are calibrated, if the columns that tell how are gone."""
    described = from_info(info)
    known = _known_cameras(described, info["features"])
    return [
        mine.name
        for mine, seen in zip(described.cameras, known.cameras, strict=True)
        if mine.calibrated and not seen.calibrated
    ]


def _known_cameras(robot: Embodiment, features: dict[str, Any]) -> Embodiment:
    """The robot whose cameras are calibrated as far as columns say: LeRobot's tools may have removed them,
    and a data set without our description may have poses of every camera.
    """
    if names.C2W not in features or names.INTRINSIC not in features:
        cameras = tuple(replace(camera, calibrated=False) for camera in robot.cameras)
        return replace(robot, cameras=cameras)
    count = prod(shape_in(features, names.C2W)) // 16
    if count == len(robot.calibrated_views):
        return robot
    if count == len(robot.cameras):
        cameras = tuple(replace(camera, calibrated=True) for camera in robot.cameras)
        return replace(robot, cameras=cameras)
    raise EmbodimentError(
        f"{names.C2W} holds poses of {count} cameras, but {len(robot.calibrated_views)} of"
        f" {list(robot.views)} are calibrated; correct features.action.info.worldloop, or remove the column"
    )
