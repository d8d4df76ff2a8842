"""One recorded episode, whatever it came from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.embodiment import Embodiment
from envs.episodes.pictures import resize_frames, resize_intrinsics

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


class EpisodeError(ValueError):
    """A recorded episode or data set is damaged, foreign or incomplete; the message names the file and the
    fix.
    """


@dataclass
class Episode:
    """T video frames with everything known at each of them; frame 0 is the start.

    What a source does not know is None. Only the camera poses of an uncalibrated camera among calibrated ones
    are NaN.

    Args:
        frames: uint8 [T, V, 3, H, W] RGB.
        commands: float32 [T, A], row t the action that led to frame t; row 0 is the command in force at the
            start, of changes zeros but for grippers.
        states: float32 [T, S], LeRobot's observation.state.
        instruction: the task in words; "" if nobody said it.
        embodiment: the robot and its cameras.
        source: who acted ("expert", "noisy", "random", "policy-<n>") or where the episode comes from.
        seed: the episode's seed or number.
        success: bool [T], True from the frame on at which the task is done; None if nobody labelled it.
        intrinsic: float32 [V, 3, 3] in pixels; NaN for an uncalibrated camera.
        c2w: float32 [T, V, 4, 4] camera to world, OpenCV convention; NaN for an uncalibrated camera.
        poses: float32 [T, arms, 7] commanded flange poses [x, y, z, roll, pitch, yaw, gripper 0 open .. 1
            closed], where the source knows them and the command does not say them. A source that knows
            measured ones alone gives these, with the grippers as commanded.
        reward: float32 [T], of the action that led to each frame.
        privileged: float32 [T, ...] by name, what only physics knows; only evaluation reads it.
        present: bool [T], frames of which there is a picture; others are black. All by default.

    Raises:
        EpisodeError: if lengths disagree, or numbers are missing here and there.
    """

    frames: NDArray[np.uint8]
    commands: Floats
    states: Floats
    instruction: str
    embodiment: Embodiment
    source: str = ""
    seed: int = 0
    success: Bools | None = None
    intrinsic: Floats | None = None
    c2w: Floats | None = None
    poses: Floats | None = None
    reward: Floats | None = None
    privileged: dict[str, Floats] = field(default_factory=dict)
    present: Bools = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        robot = self.embodiment
        length, views = self.frames.shape[:2]
        if views != len(robot.cameras):
            raise self._error(f"frames hold {views} views, but {robot.robot} has cameras {list(robot.views)}")
        if self.present is None:
            self.present = np.ones(length, bool)
        shapes = {
            "commands": (length, robot.action_dim),
            "states": (length, robot.state_dim),
            "success": (length,),
            "intrinsic": (views, 3, 3),
            "c2w": (length, views, 4, 4),
            "poses": (length, len(robot.arms), 7),
            "reward": (length,),
            "present": (length,),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            if value.shape != shape:
                raise self._error(
                    f"{name} has shape {value.shape}, but {robot.robot} makes it {shape}; correct the"
                    " embodiment or the data"
                )
            kind = np.dtype(bool) if name in ("success", "present") else np.dtype(np.float32)
            if value.dtype != kind:
                setattr(self, name, value.astype(kind))
            if name not in ("c2w", "intrinsic") and not np.isfinite(value).all():
                raise self._error(f"{name} holds NaN or infinite values; what is unknown is left out")
        if (self.c2w is None) != (self.intrinsic is None):
            raise self._error("c2w and intrinsic are known together or not at all")
        if self.c2w is not None and self.intrinsic is not None:
            self._check_cameras(self.c2w, self.intrinsic)
        for name, value in self.privileged.items():
            if len(value) != length or not np.isfinite(value).all():
                raise self._error(
                    f"privileged {name} must hold {length} rows without NaN; leave out what does not exist"
                )

    def _check_cameras(self, c2w: Floats, intrinsic: Floats) -> None:
        for view, camera in enumerate(self.embodiment.cameras):
            known = np.isfinite(c2w[:, view]), np.isfinite(intrinsic[view])
            if camera.calibrated and not all(part.all() for part in known):
                raise self._error(f"camera {camera.name} is calibrated, but c2w or intrinsic holds NaN")
            if not camera.calibrated and any(part.any() for part in known):
                raise self._error(
                    f"camera {camera.name} has poses in c2w or intrinsic; say calibrated=True in the"
                    " embodiment, or NaN throughout"
                )

    def _error(self, text: str) -> EpisodeError:
        return EpisodeError(f"episode {self.seed} of {self.source or 'unknown source'}: {text}")

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the pictures."""
        return self.frames.shape[-2], self.frames.shape[-1]

    @property
    def succeeded(self) -> bool | None:
        """Whether the episode ended in success; None if nobody labelled it."""
        return None if self.success is None else bool(self.success[-1])

    def take(self, rows: slice | NDArray[np.int64]) -> Episode:
        """The episode of some of its frames only."""
        part: dict[str, Any] = {}
        for name in ("frames", "commands", "states", "present", "success", "c2w", "poses", "reward"):
            value = getattr(self, name)
            part[name] = None if value is None else value[rows]
        known = {name: value[rows] for name, value in self.privileged.items()}
        return replace(self, **part, privileged=known)

    def resized(self, size: tuple[int, int]) -> Episode:
        """The episode with pictures of another (height, width); intrinsics are scaled alike."""
        if size == self.size:
            return self
        intrinsic = self.intrinsic
        return replace(
            self,
            frames=resize_frames(self.frames, size, self.present),
            intrinsic=None if intrinsic is None else resize_intrinsics(intrinsic, self.size, size),
            embodiment=self.embodiment.at(size),
        )

    @classmethod
    def from_track(cls, track: Any, source: str, embodiment: Embodiment) -> Episode:
        """The episode that a bench recorded.

        Args:
            track: with `rows` (lists by name: frames, commands, states, success, and where the bench knows
                them c2w, poses, reward and `privileged`, a dictionary of lists), seed, instruction,
                intrinsic.
            source: who acted.
            embodiment: the bench's robot.
        """
        rows = dict(track.rows)
        privileged = rows.pop("privileged", None) or getattr(track, "privileged", None) or {}

        def stacked(name: str, kind: Any) -> Any:
            values = rows.get(name) or [None]
            return None if values[0] is None else np.stack(values).astype(kind)

        intrinsic = getattr(track, "intrinsic", None)
        frames = np.stack(rows["frames"])
        return cls(
            frames=frames,
            commands=stacked("commands", np.float32),
            states=stacked("states", np.float32),
            instruction=track.instruction,
            embodiment=embodiment.at((frames.shape[-2], frames.shape[-1])),
            source=source,
            seed=int(track.seed),
            success=stacked("success", bool),
            intrinsic=None if intrinsic is None else np.asarray(intrinsic, np.float32),
            c2w=stacked("c2w", np.float32),
            poses=stacked("poses", np.float32),
            reward=stacked("reward", np.float32),
            privileged={name: np.stack(part).astype(np.float32) for name, part in privileged.items()},
        )
