"""Which numbers of an action or a state tell orientations, as far as names tell."""

from __future__ import annotations

import re
from collections.abc import Sequence

_ANGLES = ("roll", "pitch", "yaw")
_JOINTS = ("joint", "waist", "shoulder", "elbow", "wrist", "forearm", "neck", "head")
_VECTORS = (("wx", "wy", "wz"), ("rotvec",), ("axis", "angle"), ("axisangle",))  # as LeRobot and others say
_QUATERNIONS = (("qw", "qx", "qy", "qz"), ("quat",), ("quaternion",))


def orientations(names: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Positions of the numbers that tell orientations, by their names, in order.

    Single angles are called roll, pitch or yaw and are no joint's (left_roll, but not wrist_roll); three in a
    row are a rotation vector if they are called wx, wy, wz, or have rotvec, axis_angle or axisangle in their
    names; four in a row a quaternion if they are called qx, qy, qz, qw in any order, or have quat or
    quaternion in them.
    """
    words = [[word for word in re.split(r"[^a-z]+", name.lower()) if word] for name in names]
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
