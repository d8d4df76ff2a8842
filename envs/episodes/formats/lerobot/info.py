"""A robot in the info.json of a LeRobot data set.

Feature names and shapes are most of its description, arms and grippers included where names tell them; the
rest stands in features.action.info.worldloop, which LeRobot's tools carry along, and may be missing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from math import inf
from typing import Any, Literal, TypeVar

from envs.embodiment import PYTHON, ActionKind, Arm, Camera, Embodiment, EmbodimentError, Robot
from envs.episodes.formats.lerobot.names import feature_names, guess_action, guess_arms
from envs.targets import ConfigError, options

T = TypeVar("T")
INFO_KEY = "worldloop"  # of a feature's info, for what LeRobot has no place for
IMAGE_PREFIX = "observation.images."
_OWN = f"features.action.info.{INFO_KEY}"


def to_info(robot: Embodiment) -> dict[str, Any]:
    """What stands in features.action.info.worldloop: all that feature names and shapes do not say."""
    plain = asdict(robot)
    for known in ("robot", "action_names", "state_names", "fps"):
        plain.pop(known)
    if robot.kinematics is not None and robot.kinematics.model.startswith(PYTHON):
        plain["kinematics"] = None  # data name no code
    plain["action_kind"] = robot.action_kind.value
    plain["cameras"] = {
        camera.name: {"wrist": camera.wrist, "calibrated": camera.calibrated} for camera in robot.cameras
    }
    return plain


@dataclass(frozen=True)
class Description:
    """What may stand in features.action.info.worldloop; None where names decide. See docs/own_data.md."""

    action_kind: Literal["end_effector", "joints", "other"] | None = None
    delta: bool | None = None
    arms: tuple[Mapping[str, Any], ...] | None = None
    cameras: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    main_camera: str | None = None
    kinematics: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class CameraDescription:
    """What may stand there of a camera; see Camera."""

    wrist: str | None = None
    calibrated: bool = False


def from_info(info: Mapping[str, Any]) -> Embodiment:
    """The robot that a LeRobot data set was recorded with.

    Args:
        info: its info.json.

    Raises:
        EmbodimentError: naming the key or feature that is missing or cannot be.
    """
    features, cameras = _checked_features(info)
    action, state = (feature_names(features[name]) for name in ("action", "observation.state"))
    guessed, changes = guess_action(action)
    own = _own_section(features)
    if unknown := sorted(own.cameras.keys() - cameras.keys()):
        raise EmbodimentError(f"{_OWN}.cameras names {unknown}, but the data show {sorted(cameras)}")
    seen = {
        name: _options(CameraDescription, one, f"{_OWN}.cameras.{name}") for name, one in own.cameras.items()
    }
    kind = guessed if own.action_kind is None else ActionKind(own.action_kind)
    return Embodiment(
        robot=str(info.get("robot_type") or "unknown"),
        action_names=action,
        action_kind=kind,
        delta=changes if own.delta is None else own.delta,
        arms=guess_arms(action, kind)
        if own.arms is None
        else tuple(_options(Arm, arm, f"{_OWN}.arms.{k}") for k, arm in enumerate(own.arms)),
        state_names=state,
        cameras=tuple(
            Camera(name, _layout(features[key])[:2], **asdict(seen.get(name, CameraDescription())))
            for name, key in cameras.items()
        ),
        fps=float(info["fps"]),
        main_camera=own.main_camera or "",
        kinematics=None if own.kinematics is None else _robot(own.kinematics),
    )


def _checked_features(info: Any) -> tuple[Mapping[str, Any], dict[str, str]]:
    """The features of info.json and its cameras, where the robot can be made of them.

    Raises:
        EmbodimentError: see from_info.
    """
    if not isinstance(info, Mapping):
        raise EmbodimentError("info.json holds no dictionary; the file is damaged")
    features, fps = info.get("features"), info.get("fps")
    if not isinstance(features, Mapping) or not all(isinstance(one, Mapping) for one in features.values()):
        raise EmbodimentError(f"features={features!r} should hold a dictionary for each feature by its name")
    for name, one in features.items():
        for key in ("info", "video_info"):
            if not isinstance(one.get(key) or {}, Mapping):
                raise EmbodimentError(f"features.{name}.{key}={one[key]!r} should be a dictionary")
    cameras, depth = camera_features(features), depth_features(features)
    missing = [name for name in ("action", "observation.state") if name not in features]
    if not cameras:
        missing.append(f"{IMAGE_PREFIX}*")
    if missing:
        raise EmbodimentError(
            f"features {missing} are missing from info.json, which has {sorted(features)}"
            + (f", of which {depth} are taken for depth" if depth else "")
            + "; Worldloop needs images, action and observation.state"
        )
    if isinstance(fps, bool) or not isinstance(fps, (int, float)) or not 0 < fps < inf:
        raise EmbodimentError(f"fps={fps!r} should be the number of frames per second, above 0")
    for name in ("action", "observation.state"):
        shape_in(features, name)
    return features, cameras


def arms_are_said(features: Mapping[str, Any]) -> bool:
    """Whether a data set says itself which numbers are an arm's, instead of leaving it to names."""
    return _own_section(features).arms is not None


def _own_section(features: Mapping[str, Any]) -> Description:
    return _options(Description, (features["action"].get("info") or {}).get(INFO_KEY, {}), _OWN)


def _options(kind: type[T], section: Any, key: str) -> T:
    """A dataclass from our part of info.json, checked as configs are."""
    if not isinstance(section, Mapping):
        raise EmbodimentError(f"{key}={section!r} should be a dictionary")
    try:
        return options(kind, section, key)
    except ConfigError as error:
        raise EmbodimentError(str(error)) from error


def _robot(section: Mapping[str, Any]) -> Robot:
    model = section.get("model")
    if str(model).startswith(PYTHON):
        raise EmbodimentError(
            f"kinematics.model={model} of a data set names code, which is never run; remove it from info.json"
            " and say simulator.kinematics in the config"
        )
    told = {name: value for name, value in section.items() if value is not None}
    return _options(Robot, told, f"{_OWN}.kinematics")


def described_here(features: Mapping[str, Any]) -> bool:
    """Whether a data set carries our description, and so may have columns of ours."""
    return INFO_KEY in (features["action"].get("info") or {})


def camera_features(features: Mapping[str, Any]) -> dict[str, str]:
    """The feature of each camera by the camera's name, in order: every feature of images or video but depth.

    LeRobot's observation.images.top is the camera "top"; pusht's observation.image is the camera "image".

    Raises:
        EmbodimentError: if one of them has no shape of a picture.
    """
    cameras: dict[str, str] = {}
    for key, feature in features.items():
        if feature.get("dtype") not in ("image", "video") or _marked_depth(feature):
            continue
        shape = shape_in(features, key)
        if not 2 <= len(shape) <= 3:
            raise EmbodimentError(f"features.{key}.shape={shape} should be [height, width, channels]")
        if _looks_like_depth(feature):
            continue
        name = key.removeprefix(IMAGE_PREFIX).removeprefix("observation.")
        cameras[key if name in cameras else name] = key
    return cameras


def depth_features(features: Mapping[str, Any]) -> list[str]:
    """Features of images or video that nobody marks as depth, but that cannot be in colour: those of one
    channel or of more than 8 bits.
    """
    return [
        key
        for key, feature in features.items()
        if feature.get("dtype") in ("image", "video")
        and not _marked_depth(feature)
        and _looks_like_depth(feature)
    ]


def _about(feature: Mapping[str, Any]) -> dict[str, Any]:
    return {**(feature.get("video_info") or {}), **(feature.get("info") or {})}


def _marked_depth(feature: Mapping[str, Any]) -> bool:
    about = _about(feature)
    return bool(about.get("is_depth_map") or about.get("video.is_depth_map"))


def _looks_like_depth(feature: Mapping[str, Any]) -> bool:
    deep = str(_about(feature).get("video.pix_fmt")).startswith("gray1")  # gray10le .. gray16le
    return deep or _layout(feature)[2] == 1


def shape_in(features: Mapping[str, Any], name: str) -> list[int]:
    """The shape of a feature.

    Raises:
        EmbodimentError: if it has none.
    """
    shape = features[name].get("shape")
    whole = isinstance(shape, (list, tuple)) and all(type(n) is int and n > 0 for n in shape)
    if not whole or not shape:
        raise EmbodimentError(f"features.{name}.shape={shape!r} should be a list of whole numbers above 0")
    return list(shape)


def _layout(feature: Mapping[str, Any]) -> tuple[int, int, int]:
    """(height, width, channels) of an image feature, whose shape may be [H, W, C] or [C, H, W]; `names` says
    which.
    """
    shape, names = [*feature["shape"], 1][:3], list(feature.get("names") or ())
    named = bool(names) and str(names[0]) in ("channel", "channels", "c")
    if named or (not names and shape[0] in (1, 3) and shape[-1] not in (1, 3)):
        return shape[1], shape[2], shape[0]
    return shape[0], shape[1], shape[2]
