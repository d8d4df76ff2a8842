"""What a task suite shows and says, checked against its embodiment: all that is learned is built for that."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.physics.suite import Array, Observation, SuiteError, TaskSuite


def rendered(suite: TaskSuite) -> NDArray[np.uint8]:
    """The suite's pictures, uint8 [V, 3, H, W], as its embodiment announces them.

    Raises:
        SuiteError: if they are not.
    """
    shown, cameras = np.asarray(suite.render()), suite.embodiment.cameras
    due = (len(cameras), 3, *cameras[0].size)
    if shown.shape != due or shown.dtype != np.uint8:
        raise SuiteError(
            f"task.suite: {type(suite).__name__}.render gives {shown.dtype} {list(shown.shape)}, but its"
            f" embodiment's cameras make it uint8 {list(due)} (views, 3, height, width); correct either"
        )
    return shown


def first_observation(suite: TaskSuite) -> Observation:
    """What the suite says at the start of an episode, with intrinsics and camera poses of those cameras that
    its embodiment calls calibrated, and of no others. Ray maps and pose maps are drawn only once all episodes
    are collected, which is too late to find that they cannot be.

    Raises:
        SuiteError: if a camera's are missing, of another shape, not finite, or not announced; names it.
    """
    seen = suite.observe()
    for name, edge in (("intrinsic", 3), ("c2w", 4)):
        _check_cameras(suite, name, getattr(seen, name), edge)
    return seen


def _check_cameras(suite: TaskSuite, name: str, given: Array | None, edge: int) -> None:
    """Check one of the matrices [V, edge, edge] that an observation holds; None is allowed where no camera is
    calibrated.
    """
    cameras, says = suite.embodiment.cameras, f"task.suite: {type(suite).__name__}.observe gives"
    calibrated = [camera.name for camera in cameras if camera.calibrated]
    due = (len(cameras), edge, edge)
    if given is None:
        if calibrated:
            raise SuiteError(
                f"{says} no {name}, but its embodiment says calibrated=True of {_named(calibrated)}; give"
                f" {name} {list(due)}, NaN of cameras that are not calibrated, or say calibrated=False"
            )
        return
    if np.shape(given) != due:
        raise SuiteError(
            f"{says} {name} {list(np.shape(given))} for {_named([camera.name for camera in cameras])}, which"
            f" make it {list(due)}; give a matrix for each in their order, NaN where one is not calibrated"
        )
    for camera, matrix in zip(cameras, np.asarray(given, np.float64), strict=True):
        known = np.isfinite(matrix)
        if camera.calibrated and not known.all():
            raise SuiteError(
                f"{says} {name} with NaN or infinite numbers for camera {camera.name}, of which its"
                " embodiment says calibrated=True; give finite ones, or say calibrated=False"
            )
        if not camera.calibrated and known.any():
            raise SuiteError(
                f"{says} {name} for camera {camera.name}, of which its embodiment does not say"
                " calibrated=True; say so, or give NaN in all its places"
            )


def _named(cameras: list[str]) -> str:
    """Cameras by their names, as a sentence goes on."""
    return f"camera{'s' * (len(cameras) > 1)} {', '.join(cameras)}"
