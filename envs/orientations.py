"""What names of numbers say: their words, and which of an action or a state tell orientations."""

from __future__ import annotations

import re
from collections.abc import Sequence

_ANGLES = ("roll", "pitch", "yaw")
_JOINTS = ("joint", "waist", "shoulder", "elbow", "wrist", "forearm", "neck", "head")
_VECTORS = (
    ("wx", "wy", "wz"),
    ("rotvec",),
    ("rot", "vec"),
    ("axis", "angle"),
    ("axisangle",),
)  # as LeRobot and others say
_QUATERNIONS = (("qw", "qx", "qy", "qz"), ("quat",), ("quaternion",))


def words_of(name: str) -> list[str]:
    """The words of a name in lower case, whether dots, underscores, digits or capitals divide them:
    kLeftShoulderPitch and k_left.shoulder1_pitch have the same.
    """
    return [word for word in re.split(r"[^a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()) if word]


def orientations(names: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Positions of the numbers that tell orientations, by their names, in order.

    Single angles are called roll, pitch or yaw and are no joint's (left_roll, but not wrist_roll); three in a
    row are a rotation vector if they are called wx, wy, wz, or have rotvec, axis_angle or axisangle in their
    names; four in a row a quaternion if they are called qx, qy, qz, qw in any order, or have quat or
    quaternion in them.
    """
    words = [words_of(name) for name in names]
    found: list[tuple[int, ...]] = []
    place = 0
    while place < len(words):
        group: tuple[int, ...] = ()
        if words[place] and words[place][-1] in _ANGLES and not {*words[place]} & {*_JOINTS}:
            group = (place,)
        for size, kinds in ((3, _VECTORS), (4, _QUATERNIONS)):
            some = words[place : place + size]
            if len(some) == size and any(_called(some, kind) for kind in kinds):
                group = tuple(range(place, place + size))
        if group:
            found.append(group)
        place += max(1, len(group))
    return tuple(found)


def _called(some: Sequence[Sequence[str]], kind: tuple[str, ...]) -> bool:
    """Whether names end in these words, each in one, or all have them."""
    if len(kind) == len(some):
        return sorted(words[-1] if words else "" for words in some) == sorted(kind)
    return all({*kind} <= {*words} for words in some)
