"""What names of numbers tell in a LeRobot data set: which are an arm's, which a gripper, what actions are."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from math import prod
from typing import Any

from envs.embodiment import ActionKind, Arm
from envs.orientations import words_of

_AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_ARM_JOINTS = ("joint", "waist", "shoulder", "elbow", "wrist", "forearm")


def feature_names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """A name for every number of a feature of info.json, each another one.

    LeRobot has lists, nested lists, dictionaries of lists ({"motors": [...]}, {"axes": [...]}) and
    dictionaries of positions ({"delta_x": 0, ...}); numbers without fitting names are called by position.
    Names that repeat are told apart by the keys that they stand under (left.joint_0), as far as these differ,
    and what still repeats by numbers.
    """
    size = prod(feature["shape"])
    paths = list(_paths(feature.get("names")))
    if not paths or len(paths) != size:
        return tuple(f"{k}" for k in range(size))
    if len({path[-1] for path in paths}) < size:
        while min(map(len, paths)) > 1 and len({path[0] for path in paths}) == 1:
            paths = [path[1:] for path in paths]
    else:
        paths = [path[-1:] for path in paths]
    return _numbered([".".join(path) for path in paths])


def _paths(names: Any, above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Each name in order, after the keys that it stands under."""
    if isinstance(names, Mapping):
        if all(isinstance(part, int) for part in names.values()):
            yield from ((*above, str(name)) for name in sorted(names, key=names.__getitem__))
            return
        for key, part in names.items():
            yield from _paths(part, (*above, str(key)))
    elif isinstance(names, (list, tuple)):
        for part in names:
            yield from _paths(part, above)
    elif names is not None:
        yield (*above, str(names))


def _numbered(names: Sequence[str]) -> tuple[str, ...]:
    """Names of which those that repeat get numbers behind them: a, a, b -> a_0, a_1, b."""
    count, used = Counter(names), {name for name, times in Counter(names).items() if times == 1}
    out = []
    for name in names:
        if count[name] > 1:
            name = next(f"{name}_{k}" for k in range(len(names) + len(used)) if f"{name}_{k}" not in used)
            used.add(name)
        out.append(name)
    return tuple(out)


def guess_arms(names: Sequence[str], kind: ActionKind) -> tuple[Arm, ...]:
    """The arms and grippers of an action, as far as its names tell; () where they do not.

    left_... and right_... are two arms, names without a side one arm called "arm". Of poses, x y z (roll
    pitch yaw) belong to an arm; of joints, those named after a joint of an arm, such as left_waist,
    shoulder_pan.pos or joint_3. What is called gripper is the arm's gripper; whatever else there is, such as
    a head or wheels, belongs to none.
    """
    words = [words_of(re.sub("delta", "", name, flags=re.IGNORECASE)) for name in names]
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
