"""Plans of the experts: the essential way-points of each task, from pose, size and heading of its object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.physics.tabletop.scene import ARMS, BASE, FINGER_TRAVEL
from envs.physics.tabletop.scenes.catalogue import BOTTOM, RIM, THINGS, Pinch, Thing
from envs.physics.tabletop.scenes.tasks import Request

Array = NDArray[np.float64]
ABOVE = 0.13  # m above the table that fingertips travel, over all that stands there
CARRIED = 0.10  # m that two hands lift
LOW = 0.012  # m above the table of fingertips that push, pull or press
DEEP = 0.032  # m that fingers reach down along an object
ROOM = 0.012  # m between an open finger and the object
CLEAR = 0.030  # m that a hand comes down away from what it will push or pull
CLOSE_BY = 0.011  # m, of what two hands will press, beside which there is less room
STROKE = 0.105  # m that things are pushed or pulled
SQUEEZE = 0.008  # m that each of two hands is sent into what they press
THICK, WIDE = 0.010, 0.025  # m, half of a closed hand along its flange's x and y
CLOSE, SETTLE = 0.4, 0.2  # s that fingers take to close, and that a hand waits before
SLOW, FAST = 0.25, 0.45  # m/s of fingertips


@dataclass(frozen=True)
class Waypoint:
    """Where both hands go next.

    Args:
        hands: [2, 7] fingertip pose [x, y, z, roll, pitch, yaw] and gripper (1 closed) of left and right.
        phase: what it is essential for ("grasp", "place", "push", "press"), "" on the way.
        speed: m/s of the fingertips on the way there.
        wait: seconds to stay.
    """

    hands: Array
    phase: str = ""
    speed: float = FAST
    wait: float = 0.0


class Sketch:
    """A list of way-points in the making: what is not said stays as it is."""

    def __init__(self, hands: Array):
        self.hands, self.points = hands.copy(), list[Waypoint]()

    def go(self, changes: dict[int, Array], phase: str = "", speed: float = FAST, wait: float = 0.0) -> None:
        """Send hands to new poses [7]; the others stay."""
        for arm, hand in changes.items():
            self.hands[arm] = hand
        self.points.append(Waypoint(self.hands.copy(), phase, speed, wait))


def plan(task: str, request: Request, objects: Array, hands: Array) -> list[Waypoint]:
    """The optimal way-points of a task.

    Args:
        task: of PLANS.
        request: what is asked for.
        objects: [2, 4] = [x, y, z, heading] of what the words name and of the other object, as they are.
        hands: [2, 7] fingertip poses and grippers as they are.
    """
    layout = request.layout
    thing = THINGS[(layout.scene.thing, layout.companion)[request.thing]]
    sketch = Sketch(hands)
    PLANS[task](sketch, thing, objects[0], request)
    return sketch.points


def _slide(sketch: Sketch, thing: Thing, pose: Array, way: float) -> None:
    """Come down behind (`way` 1) or ahead (-1) of it with a closed hand, and move it by STROKE."""
    before, after = thing.extent(pose[3], 0.0)
    edge = -before if way > 0 else after
    arm = _arm_for(pose[:2])
    start = np.array([pose[0] - way * (edge + THICK + CLEAR), pose[1]])
    end = np.array([pose[0] + way * (STROKE - edge - THICK), pose[1]])

    def hand(place: Array, height: float) -> Array:
        # A hand that leans towards what it moves would tip it over.
        return _hand(arm, place, height, 0.0, 1.0, lean=(max(0.0, way) * 0.5, 0.5))

    sketch.go({arm: hand(start, ABOVE)})
    sketch.go({arm: hand(start, LOW)}, "push", SLOW)
    sketch.go({arm: hand(end, LOW)}, "push", SLOW)


def _push(sketch: Sketch, thing: Thing, pose: Array, request: Request) -> None:
    _slide(sketch, thing, pose, 1.0)


def _pull(sketch: Sketch, thing: Thing, pose: Array, request: Request) -> None:
    _slide(sketch, thing, pose, -1.0)


def _bring(sketch: Sketch, thing: Thing, pose: Array, place: Array, lowest: float, under: float) -> None:
    """Take it, and let it go over a place.

    Args:
        lowest: height of fingertips, at least, when they let go.
        under: height of what it is put on.
    """
    pinch, yaw = _best_pinch(thing, pose)
    arm = _arm_for(pose[:2], place)
    offset = _turned(np.array(pinch.at), pose[3])
    grip = max(0.0, 1.0 - (pinch.width / 2 + ROOM) / FINGER_TRAVEL)
    depth = max(LOW, pinch.low, pinch.high - DEEP)
    model = _hand(arm, (pose[:2] + place) / 2, 0.0, yaw, grip, lean=(1.0, 0.3))

    def hand(at: Array, height: float, gripper: float) -> Array:
        return np.array([*(at + offset), height, *model[3:6], gripper])

    release = max(depth + under, lowest)
    sketch.go({arm: hand(pose[:2], depth + 0.06, grip)})
    sketch.go({arm: hand(pose[:2], depth, grip)}, "grasp", SLOW, SETTLE)
    sketch.go({arm: hand(pose[:2], depth, 1.0)}, "grasp", SLOW, CLOSE)
    sketch.go({arm: hand(pose[:2], ABOVE, 1.0)})
    sketch.go({arm: hand(place, ABOVE, 1.0)})
    sketch.go({arm: hand(place, release, 1.0)}, "place", SLOW, SETTLE)
    sketch.go({arm: hand(place, release, grip)}, "place", SLOW, SETTLE)
    sketch.go({arm: hand(place, ABOVE, grip)})


def _pick_place(sketch: Sketch, thing: Thing, pose: Array, request: Request) -> None:
    _bring(sketch, thing, pose, request.place, RIM + 0.004, BOTTOM + 0.004)


def _move_to_aim(sketch: Sketch, thing: Thing, pose: Array, request: Request) -> None:
    _bring(sketch, thing, pose, request.place, 0.0, 0.002)


def _carry(sketch: Sketch, thing: Thing, pose: Array, request: Request) -> None:
    """Press it from both sides with closed hands, lift it, and hold it over the mat."""
    heading = _half_turn(pose[3])
    side = np.array([-np.sin(heading), np.cos(heading)])

    def hands(middle: Array, gap: float, height: float) -> dict[int, Array]:
        away = thing.shape.press + THICK + gap
        return {
            arm: _hand(
                arm, middle + way * away * side, height, heading - way * np.pi / 2, 1.0, lean=(0.0, 0.0)
            )
            for arm, way in enumerate((1.0, -1.0))
        }

    here, place = pose[:2], request.place
    sketch.go(hands(here, CLOSE_BY, ABOVE))
    sketch.go(hands(here, CLOSE_BY, LOW), "press", SLOW)
    sketch.go(hands(here, -SQUEEZE, LOW), "press", SLOW, SETTLE)
    sketch.go(hands(here, -SQUEEZE, LOW + CARRIED), speed=SLOW)
    sketch.go(hands(place, -SQUEEZE, LOW + CARRIED), "place", SLOW)


PLANS: dict[str, Callable[[Sketch, Thing, Array, Request], None]] = {
    "push": _push,
    "pull": _pull,
    "pick_place": _pick_place,
    "move_to_aim": _move_to_aim,
    "carry": _carry,
}


def _arm_for(*places: Array) -> int:
    """The arm whose base is nearer to the farthest of some places."""
    return int(np.argmin([max(np.hypot(*(place - BASE[arm])) for place in places) for arm in ARMS]))


def _best_pinch(thing: Thing, pose: Array) -> tuple[Pinch, float]:
    """The pinch that turns the hand least from straight ahead, and the hand's yaw."""
    options = []
    for pinch in thing.shape.pinches:
        if pinch.angle is None:
            options.append((pinch, 0.0))
        else:  # fingers close along the flange's y, which is a quarter turn from its x; either way round
            options.append((pinch, _half_turn(pose[3] + pinch.angle + np.pi / 2)))
    return min(options, key=lambda option: abs(option[1]))


def _half_turn(angle: float) -> float:
    """An angle up to half turns, in -pi/2..pi/2."""
    return float((angle + np.pi / 2) % np.pi - np.pi / 2)


def _turned(vector: Array, angle: float) -> Array:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]])


def _hand(arm: int, place: Array, height: float, yaw: float, grip: float, lean: tuple[float, float]) -> Array:
    """A hand [7] over a place, which leans outward the further it must reach.

    Args:
        lean: share of the lean along and across the flange's x.
    """
    out = place - BASE[ARMS[arm]]
    away = float(np.hypot(*out))
    along, across = _turned(out / away, -yaw) * np.clip(1.2 * (away - 0.5), -0.15, 0.35)
    return np.array([*place, height, np.pi + lean[1] * across, -lean[0] * along, yaw, grip])
