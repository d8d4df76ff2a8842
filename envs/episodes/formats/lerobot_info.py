"""A robot in the info.json of a LeRobot v3.0 data set.

Feature names and shapes are most of its description, arms and grippers included where names tell them; the
rest stands in features.action.info.worldloop, which LeRobot's tools carry along, and may be missing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from math import prod
from typing import Any

from envs.embodiment import PYTHON, ActionKind, Arm, Camera, Embodiment, EmbodimentError, Robot

INFO_KEY = "worldloop"  # of a feature's info, for what LeRobot has no place for
IMAGE_PREFIX = "observation.images."
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_ARM_JOINTS = ("joint", "waist", "shoulder", "elbow", "wrist", "forearm")


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


def from_info(info: Mapping[str, Any]) -> Embodiment:
    """The robot that a LeRobot v3.0 data set was recorded with.

    Args:
        info: its info.json.

    Raises:
        EmbodimentError: naming the feature that is missing, or what stands under our key and cannot be.
    """
    features = info["features"]
    missing = [name for name in ("action", "observation.state") if name not in features]
    cameras = camera_features(features)
    if not cameras:
        missing.append(f"{IMAGE_PREFIX}*")
    if missing:
        raise EmbodimentError(
            f"features {missing} are missing from info.json, which has {sorted(features)};"
            " Worldloop needs images, action and observation.state"
        )
    own = (features["action"].get("info") or {}).get(INFO_KEY, {})
    action, state = (feature_names(features[name]) for name in ("action", "observation.state"))
    kind, delta = guess_action(action)
    about, model = own.get("cameras", {}), own.get("kinematics")
    if unknown := sorted(about.keys() - cameras.keys()):
        raise EmbodimentError(
            f"features.action.info.{INFO_KEY}.cameras names {unknown}, but the data show {sorted(cameras)}"
        )
    try:
        return Embodiment(
            robot=str(info.get("robot_type") or "unknown"),
            action_names=action,
            action_kind=ActionKind(own.get("action_kind", kind)),
            delta=bool(own.get("delta", delta)),
            arms=tuple(_arm(**arm) for arm in own["arms"])
            if "arms" in own
            else guess_arms(action, ActionKind(own.get("action_kind", kind))),
            state_names=state,
            cameras=tuple(
                Camera(name, _image_size(features[key]), **about.get(name, {}))
                for name, key in cameras.items()
            ),
            fps=float(info["fps"]),
            main_camera=own.get("main_camera", ""),
            kinematics=None if model is None else _robot(**model),
        )
    except EmbodimentError:
        raise
    except (TypeError, ValueError) as error:
        raise EmbodimentError(f"features.action.info.{INFO_KEY} cannot be understood: {error}") from error


def _arm(
    name: str,
    numbers: Sequence[int],
    gripper: int | None = None,
    gripper_range: Sequence[float] = (0.0, 1.0),
) -> Arm:
    opened, closed = gripper_range
    return Arm(name, tuple(numbers), gripper, (opened, closed))


def _robot(
    model: str,
    joints: Sequence[Sequence[str]],
    flanges: Sequence[str],
    held: Mapping[str, float] | None = None,
) -> Robot:
    if str(model).startswith(PYTHON):
        raise EmbodimentError(
            f"kinematics.model={model} of a data set names code, which is never run; remove it from info.json"
            " and say simulator.kinematics in the config"
        )
    return Robot(model, tuple(map(tuple, joints)), tuple(flanges), held or {})


def described_here(features: Mapping[str, Any]) -> bool:
    """Whether a data set carries our description, and so may have columns of ours."""
    return INFO_KEY in (features["action"].get("info") or {})


def camera_features(features: Mapping[str, Any]) -> dict[str, str]:
    """The feature of each camera by the camera's name, in order: every feature of images or video but depth.

    LeRobot's observation.images.top is the camera "top"; pusht's observation.image is the camera "image".
    """
    cameras: dict[str, str] = {}
    for key, feature in features.items():
        about = {**(feature.get("video_info") or {}), **(feature.get("info") or {})}
        if feature.get("dtype") not in ("image", "video"):
            continue
        if about.get("is_depth_map") or about.get("video.is_depth_map"):
            continue
        name = key.removeprefix(IMAGE_PREFIX).removeprefix("observation.")
        cameras[key if name in cameras else name] = key
    return cameras


def feature_names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """A name for every number of a feature of info.json.

    LeRobot has lists, nested lists, dictionaries of lists ({"motors": [...]}, {"axes": [...]}) and
    dictionaries of positions ({"delta_x": 0, ...}); numbers without fitting names are called by position.
    """
    size = prod(feature["shape"])
    names = feature.get("names")
    if isinstance(names, Mapping):
        if all(isinstance(part, int) for part in names.values()):
            names = sorted(names, key=names.__getitem__)
        else:
            names = [name for part in names.values() for name in part]
    if names and isinstance(names[0], (list, tuple)):
        names = [name for part in names for name in part]
    if not names or len(names) != size:
        return tuple(f"{k}" for k in range(size))
    return tuple(str(name) for name in names)


def guess_arms(names: Sequence[str], kind: ActionKind) -> tuple[Arm, ...]:
    """The arms and grippers of an action, as far as its names tell; () where they do not.

    left_... and right_... are two arms, names without a side one arm called "arm". Of poses, x y z (roll
    pitch yaw) belong to an arm; of joints, those named after a joint of an arm, such as left_waist,
    shoulder_pan.pos or joint_3. What is called gripper is the arm's gripper; whatever else there is, such as
    a head or wheels, belongs to none.
    """
    words = [re.split(r"[^a-z]+", name.lower().replace("delta", "")) for name in names]
    sides = [next((word for word in parts if word in ("left", "right")), "") for parts in words]
    found = []
    for side in dict.fromkeys(side for side in sides if side) or ("",):
        mine = [k for k in range(len(names)) if sides[k] == side]
        grippers = [k for k in mine if "gripper" in words[k]]
        others = [k for k in mine if k not in grippers]
        numbers = _pose_numbers(others, words) if kind is ActionKind.END_EFFECTOR else ()
        if kind is ActionKind.JOINTS:
            numbers = tuple(k for k in others if any(joint in names[k].lower() for joint in _ARM_JOINTS))
        if not numbers or len(grippers) > 1:
            return ()
        gripper = grippers[0] if grippers else None
        # LeRobot's drivers write a gripper's .pos as 0 closed .. 100 open; else names say no range.
        percent = gripper is not None and kind is ActionKind.JOINTS and words[gripper][-1] == "pos"
        found.append(Arm(side or "arm", numbers, gripper, (100.0, 0.0) if percent else (0.0, 1.0)))
    return tuple(found)


def _pose_numbers(places: Sequence[int], words: Sequence[Sequence[str]]) -> tuple[int, ...]:
    """Which of the places hold x, y, z and, if all three are there, roll, pitch, yaw; () unless each is there
    once.
    """
    at = {axis: [k for k in places if [word for word in words[k] if word][-1:] == [axis]] for axis in _AXES}
    if any(len(at[axis]) != 1 for axis in _AXES[:3]) or any(len(at[axis]) > 1 for axis in _AXES[3:]):
        return ()
    turned = all(at[axis] for axis in _AXES[3:])
    return tuple(at[axis][0] for axis in (_AXES if turned else _AXES[:3]))


def guess_action(names: tuple[str, ...]) -> tuple[ActionKind, bool]:
    """Kind of an action and whether it is a change, as far as its names tell; OTHER where they do not."""
    words = [name.lower() for name in names]
    delta = any("delta" in word for word in words)
    tails = {word.replace("delta", "").split(".")[-1].split("_")[-1] for word in words}
    if {"x", "y", "z"} <= tails:
        return ActionKind.END_EFFECTOR, delta
    jointed = (*_ARM_JOINTS, "motor", ".pos")
    if sum(any(part in word for part in jointed) for word in words) > len(words) // 2:
        return ActionKind.JOINTS, delta
    return ActionKind.OTHER, delta


def _image_size(feature: Mapping[str, Any]) -> tuple[int, int]:
    """(height, width) of an image feature, whose shape may be [H, W, C] or [C, H, W]; `names` says which."""
    shape, names = list(feature["shape"]), list(feature.get("names") or ())
    named = bool(names) and str(names[0]) in ("channel", "channels", "c")
    if named or (not names and shape[0] in (1, 3) and shape[-1] not in (1, 3)):
        return shape[1], shape[2]
    return shape[0], shape[1]
