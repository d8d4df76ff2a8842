"""What a robot is, as data: the names and kinds of its action and state, its cameras, its rate.

Every shape, head, encoder, transform, server and test is built from an `Embodiment`. Data sets carry it along
(envs/episodes/formats/lerobot/info.py). Nothing here imports torch, so physics workers start fast.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from math import inf
from typing import Any

from envs.orientations import orientations, words_of


class EmbodimentError(ValueError):
    """A description of a robot contradicts itself or its data; the message names the key and the fix."""


class ActionKind(str, Enum):
    """What the numbers of an action are.

    END_EFFECTOR: per arm a flange pose [x, y, z, roll, pitch, yaw] in metres and radians (or fewer of them),
    and a gripper. JOINTS: per arm joint positions in radians, and a gripper. OTHER: numbers whose meaning is
    the robot's own affair.
    """

    END_EFFECTOR = "end_effector"
    JOINTS = "joints"
    OTHER = "other"


@dataclass(frozen=True)
class Arm:
    """The part of an action that moves one arm.

    Args:
        name: such as "left".
        numbers: positions of its pose or joints in the action vector, in order.
        gripper: position of its gripper in the action vector, None without one.
        gripper_range: the gripper's values when open and when closed.
        gripper_readings: those that a state has of it; None where they are the same.
    """

    name: str
    numbers: tuple[int, ...]
    gripper: int | None = None
    gripper_range: tuple[float, float] = (0.0, 1.0)
    gripper_readings: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        read = ("gripper_readings",) if self.gripper_readings is not None else ()
        _as_tuples(self, "numbers", "gripper_range", *read)


@dataclass(frozen=True)
class Camera:
    """One camera.

    Args:
        name: as in observation.images.<name>.
        size: (height, width) in pixels, as recorded.
        wrist: name of the arm it is mounted on; None if it stands still or moves by itself.
        calibrated: whether intrinsics and camera-to-world poses are known.
    """

    name: str
    size: tuple[int, int]
    wrist: str | None = None
    calibrated: bool = False

    def __post_init__(self) -> None:
        _as_tuples(self, "size")


def _as_tuples(part: Any, *fields: str) -> None:
    """Fields of a description that may be given as lists; it is compared as a whole."""
    for name in fields:
        object.__setattr__(part, name, tuple(getattr(part, name)))


PYTHON = "python:"  # before the import path of a function, where the path of a robot's file may stand


@dataclass(frozen=True)
class Robot:
    """A robot description file and the names in it, for forward kinematics of joint commands.

    Args:
        model: path of a URDF or MJCF file, or python:package.module.function around a library that gives
            flange poses (see envs/geometry/kinematics.py).
        joints: per arm the names of its joints, in the action's order.
        flanges: per arm the body (URDF link) or site whose pose is the end-effector pose.
        held: joints that stand still, such as head and waist, and their values in radians.
    """

    model: str
    joints: tuple[tuple[str, ...], ...]
    flanges: tuple[str, ...]
    held: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Embodiment:
    """A robot as far as learning it needs to know.

    Args:
        robot: its name, LeRobot's `robot_type`.
        action_names: a name for each of the A numbers of an action.
        action_kind: what they are.
        delta: whether an action is a change (of pose or joints) instead of a target.
        arms: which numbers belong to which arm; () if unknown.
        state_names: a name for each of the S numbers of observation.state.
        cameras: V of them, in the order in which views are stacked.
        fps: frames, and so actions, per second.
        main_camera: name of the camera to look at first, where one must be chosen; "" is the first fixed one.
        kinematics: of the robot, if known; makes end-effector poses of joint commands.

    Raises:
        EmbodimentError: if positions lie outside the action, or positions or names are unknown or doubled.
    """

    robot: str
    action_names: tuple[str, ...]
    action_kind: ActionKind
    delta: bool
    arms: tuple[Arm, ...]
    state_names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    fps: float
    main_camera: str = ""
    kinematics: Robot | None = None

    def __post_init__(self) -> None:
        _as_tuples(self, "action_names", "arms", "state_names", "cameras")
        for field_name in ("action_names", "state_names"):
            given = getattr(self, field_name)
            doubled = sorted({name for name in given if given.count(name) > 1})
            if not given or doubled:
                why = f"holds {doubled} more than once" if doubled else "is empty"
                raise EmbodimentError(
                    f"{self.robot}: {field_name} {why}; there is at least one number, and each has a name of"
                    " its own"
                )
        if not 0 < self.fps < inf:
            raise EmbodimentError(f"{self.robot}: fps={self.fps} must be frames per second, above 0")
        names = [camera.name for camera in self.cameras]
        if not names or len(set(names)) != len(names):
            raise EmbodimentError(f"{self.robot}: cameras {names} must be at least one, with different names")
        if self.main_camera and self.main_camera not in names:
            raise EmbodimentError(f"{self.robot}: main_camera={self.main_camera!r} is not one of {names}")
        known = {arm.name for arm in self.arms}
        for camera in self.cameras:
            if camera.wrist is not None and camera.wrist not in known:
                raise EmbodimentError(
                    f"{self.robot}: camera {camera.name} is on the wrist of {camera.wrist!r};"
                    f" arms are {known}"
                )
        if len(known) < len(self.arms):
            raise EmbodimentError(
                f"{self.robot}: arms {[arm.name for arm in self.arms]} need different names"
            )
        taken: dict[int, str] = {}
        for arm in self.arms:
            used = [*arm.numbers, *([] if arm.gripper is None else [arm.gripper])]
            if any(not 0 <= number < self.action_dim for number in used):
                raise EmbodimentError(
                    f"{self.robot}: arm {arm.name} uses numbers {used} of an action of {self.action_dim}"
                )
            for number in used:
                if number in taken:
                    raise EmbodimentError(
                        f"{self.robot}: number {number} of the action is of arm {taken[number]} and again of"
                        f" arm {arm.name} (numbers {list(arm.numbers)}, gripper {arm.gripper}); each is one's"
                    )
                taken[number] = arm.name
            for name in ("gripper_range", "gripper_readings"):
                ends = getattr(arm, name)
                if ends is not None and ends[0] == ends[1]:
                    raise EmbodimentError(f"{self.robot}: arm {arm.name} has {name}={ends}, which is empty")

    # -- sizes
    @property
    def action_dim(self) -> int:
        """Numbers of an action, A."""
        return len(self.action_names)

    @property
    def state_dim(self) -> int:
        """Numbers of observation.state, S."""
        return len(self.state_names)

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the cameras, in order."""
        return tuple(camera.name for camera in self.cameras)

    @property
    def main_view(self) -> int:
        """Position of the main camera."""
        if self.main_camera:
            return self.views.index(self.main_camera)
        return next((k for k, camera in enumerate(self.cameras) if camera.wrist is None), 0)

    def views_of(self, cameras: str | Sequence[str]) -> tuple[int, ...]:
        """Positions of the cameras that are meant: "all", "main", or some names.

        Raises:
            ValueError: if none is named, or one that the robot does not have.
        """
        if isinstance(cameras, str):
            if cameras not in ("all", "main"):
                raise ValueError(f"cameras={cameras!r} must be all, main or a list of {list(self.views)}")
            return tuple(range(len(self.views))) if cameras == "all" else (self.main_view,)
        unknown = [name for name in cameras if name not in self.views]
        if unknown or not cameras:
            raise ValueError(f"cameras={list(cameras)} must be some of {self.robot}'s {list(self.views)}")
        return tuple(self.views.index(name) for name in cameras)

    @property
    def wrists(self) -> tuple[int | None, ...]:
        """Per camera the position of the arm it is mounted on, None where it stands still."""
        arms = [arm.name for arm in self.arms]
        return tuple(None if camera.wrist is None else arms.index(camera.wrist) for camera in self.cameras)

    @property
    def grippers(self) -> tuple[int, ...]:
        """Positions of the grippers in the action vector."""
        return tuple(arm.gripper for arm in self.arms if arm.gripper is not None)

    @cached_property  # asked for each chunk
    def changes(self) -> tuple[int, ...]:
        """Positions of an action's numbers that are 0 while the robot stays as it is: of changes all but
        grippers, else velocities by their names, such as x.vel of a base beside positions of an arm.
        """
        if self.delta:
            return tuple(number for number in range(self.action_dim) if number not in self.grippers)
        words = [{*words_of(name)} for name in self.action_names]
        return tuple(number for number, some in enumerate(words) if some & {"vel", "velocity"})

    @property
    def action_rotations(self) -> tuple[tuple[int, ...], ...]:
        """Positions of an action's orientations: of commanded poses and by names, as `orientations` finds
        them; () where it commands changes.
        """
        if self.delta:
            return ()
        poses = self.action_kind is ActionKind.END_EFFECTOR
        angles = [number for arm in self.arms for number in arm.numbers[3:6]] if poses else []
        named = [group for group in orientations(self.action_names) if not {*group} & {*angles}]
        return tuple(sorted([*((number,) for number in angles), *named]))

    @property
    def state_rotations(self) -> tuple[tuple[int, ...], ...]:
        """Positions of a state's orientations, as `orientations` finds them by names."""
        return orientations(self.state_names)

    # -- what it allows
    @property
    def calibrated_views(self) -> tuple[int, ...]:
        """Positions of the cameras that are calibrated."""
        return tuple(k for k, camera in enumerate(self.cameras) if camera.calibrated)

    @property
    def calibrated(self) -> bool:
        """Whether some camera is calibrated: there are camera poses, and ray maps can be made; both are zeros
        of the other cameras.
        """
        return bool(self.calibrated_views)

    @property
    def commands_poses(self) -> bool:
        """Whether a command says, or kinematics tell, where every flange will be: pose maps can be drawn."""
        if self.delta or not self.arms:
            return False
        if self.action_kind is ActionKind.END_EFFECTOR:
            return all(len(arm.numbers) == 6 for arm in self.arms)
        return self.action_kind is ActionKind.JOINTS and self.kinematics is not None

    def at(self, size: tuple[int, int]) -> Embodiment:
        """The same robot whose pictures are brought to one size (height, width)."""
        return replace(self, cameras=tuple(replace(camera, size=size) for camera in self.cameras))

    def differs(self, other: Embodiment) -> str:
        """The first thing in which another robot's numbers or cameras mean something else, in words; "" if
        nothing.
        """
        for name in ("action_names", "action_kind", "delta", "state_names", "views", "fps"):
            mine, theirs = getattr(self, name), getattr(other, name)
            if mine != theirs:
                return f"{name} is {mine} of {self.robot}, but {theirs} of {other.robot}"
        return ""
