"""What a task suite shows and says, checked against its embodiment: all that is learned is built for that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.physics.suite import Array, Observation, SuiteError, TaskSuite

_SLACK = 1e-6  # by which rounding may carry progress beyond 0..1


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


def observation(suite: TaskSuite, before: Observation | None = None) -> Observation:
    """What the suite says, its numbers as arrays of floats, success a bool and progress a float.

    At the start of an episode intrinsics and camera poses are held to what its embodiment calls calibrated,
    too: ray maps and pose maps are drawn only once all episodes are collected, which is too late to find that
    they cannot be.

    Args:
        before: what it said before in the same episode; None at its start.

    Raises:
        SuiteError: if that is not what Observation says; names the class and the field.
        ValueError: if physics came to numbers that are not finite after the start; that is one episode's.
    """
    seen, robot = suite.observe(), suite.embodiment
    says = f"task.suite: {type(suite).__name__}.observe gives"
    if not isinstance(seen, Observation):
        raise SuiteError(f"{says} a {type(seen).__name__}; give an envs.physics.suite.Observation")
    if not isinstance(seen.instruction, str):
        raise SuiteError(f"{says} instruction={seen.instruction!r}; give the task in words, as a text")
    due: dict[str, tuple[int, ...]] = {"state": (robot.state_dim,), "command": (robot.action_dim,)}
    if seen.poses is not None:
        due["poses"] = (len(robot.arms), 7)
    given = {name: _floats(says, name, getattr(seen, name), shape) for name, shape in due.items()}
    given["progress"] = _floats(says, "progress", seen.progress, ())
    progress = float(given["progress"])
    for name, value in given.items():
        if not np.isfinite(value).all():
            kind = SuiteError if before is None else ValueError
            raise kind(f"{says} {name} {value.tolist()}, which is not finite")
    if not -_SLACK <= progress <= 1 + _SLACK:
        raise SuiteError(f"{says} progress={progress:g}; it is RL's reward in physics: bring it to 0..1")
    success = np.asarray(seen.success)
    if success.dtype != bool or success.size != 1:
        raise SuiteError(f"{says} success={seen.success!r}; give a bool")
    if before is not None and before.success and not success.item():
        raise SuiteError(
            f"{says} success=False after it was True in the same episode; once true it stays true, or whoever"
            " looks later counts a failure: keep it by HeldCondition (envs/physics/suite.py)"
        )
    if before is None:
        for name, edge in (("intrinsic", 3), ("c2w", 4)):
            _check_cameras(suite, name, getattr(seen, name), edge)
    eyes = {"intrinsic": seen.intrinsic, "c2w": seen.c2w}
    given |= {name: np.asarray(value) for name, value in eyes.items() if value is not None}
    found = {**given, "progress": min(max(progress, 0.0), 1.0), "success": success.item()}
    return replace(seen, **found)


def beginning(suite: TaskSuite) -> Observation:
    """What the suite says at the start of an episode that somebody is to play.

    Raises:
        SuiteError: see observation.
        ValueError: if the task is done there; that is one episode's.
    """
    seen = observation(suite)
    if seen.success:
        raise ValueError(
            f"task.suite: {type(suite).__name__}.observe gives success=True at the start of an episode, which"
            " would count as a success of whoever does nothing; let reset draw again until the task is not"
            " done"
        )
    return seen


def privileged(suite: TaskSuite, before: Mapping[str, Sequence[Array]]) -> dict[str, Array]:
    """What only physics knows.

    Args:
        before: by name, of the frames before in the same episode.

    Raises:
        SuiteError: if the shape of one changes.
    """
    known = suite.privileged()
    for name, value in known.items():
        rows = before.get(name)
        if rows and np.shape(value) != np.shape(rows[0]):
            raise SuiteError(
                f"task.suite: {type(suite).__name__}.privileged gives {name} {list(np.shape(value))} after"
                f" {list(np.shape(rows[0]))}; its shape is the suite's, whatever the task and the frame"
            )
    return known


def _floats(says: str, name: str, given: Any, shape: tuple[int, ...]) -> Array:
    """A field of an observation as an array of floats of this shape."""
    try:
        known = isinstance(given, np.ndarray) and given.dtype.kind == "f"
        value = given if known else np.asarray(given, np.float64)
    except (TypeError, ValueError) as error:
        raise SuiteError(
            f"{says} {name}={given!r}, which are no numbers; give float {list(shape)}"
        ) from error
    if given is None or (value.shape != shape and (shape or value.size != 1)):
        found = "nothing" if given is None else f"numbers {list(value.shape)}"
        raise SuiteError(
            f"{says} {found} for {name}, of which its embodiment makes float {list(shape)}; correct either"
        )
    return value.reshape(shape)


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
