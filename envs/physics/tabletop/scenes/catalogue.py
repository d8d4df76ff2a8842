"""What scenes are made of: twenty objects (shape, size, colour, mass), two containers, two tables, two mats.

An object's frame stands in the middle of its underside; its longer side lies along y. Metres, radians,
kilograms.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rgb = tuple[float, float, float]
FRICTION = (0.5, 0.01, 0.001)  # of objects and tables: sliding, torsional, rolling


@dataclass(frozen=True)
class Part:
    """A box of half sizes [3], or an upright cylinder of half sizes (radius, radius, half height).

    Args:
        half: its half sizes.
        at: its middle.
        round: whether it is a cylinder.
    """

    half: tuple[float, float, float]
    at: tuple[float, float, float]
    round: bool = False

    def outline(self) -> Array:
        """Points [n, 2] on the table whose convex hull is the part's outline from above."""
        if self.round:
            angles = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
            return self.at[:2] + self.half[0] * np.stack((np.cos(angles), np.sin(angles)), 1)
        corners = np.array([(x, y) for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
        return self.at[:2] + corners * self.half[:2]


@dataclass(frozen=True)
class Pinch:
    """A place where two fingers can take an object from above.

    Args:
        angle: of the line along which the fingers close; None where any will do.
        width: between the fingers.
        low: the lowest and
        high: the highest point of what lies between them.
        at: its middle.
    """

    angle: float | None
    width: float
    low: float
    high: float
    at: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Shape:
    """Parts, places to take it, and how far it reaches along y where two hands press it."""

    parts: tuple[Part, ...]
    pinches: tuple[Pinch, ...]
    press: float


def _box(x: float, y: float, z: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Part:
    """A box of full sizes that stands `at` (the middle of its underside)."""
    return Part((x / 2, y / 2, z / 2), (at[0], at[1], at[2] + z / 2))


def _cylinder(radius: float, height: float, bottom: float = 0.0) -> Part:
    return Part((radius, radius, height / 2), (0.0, 0.0, bottom + height / 2), True)


ALONG_X, ALONG_Y = 0.0, np.pi / 2
SHAPES = {
    "cube": Shape(
        (_box(0.050, 0.050, 0.050),),
        (Pinch(ALONG_X, 0.050, 0.0, 0.050), Pinch(ALONG_Y, 0.050, 0.0, 0.050)),
        0.025,
    ),
    "brick": Shape((_box(0.046, 0.092, 0.038),), (Pinch(ALONG_X, 0.046, 0.0, 0.038),), 0.046),
    "can": Shape((_cylinder(0.026, 0.070),), (Pinch(None, 0.052, 0.0, 0.070),), 0.026),
    "disc": Shape((_cylinder(0.028, 0.026),), (Pinch(None, 0.056, 0.0, 0.026),), 0.028),
    "bar": Shape((_box(0.026, 0.092, 0.028),), (Pinch(ALONG_X, 0.026, 0.0, 0.028),), 0.046),
    "mug": Shape(
        (_cylinder(0.026, 0.056), _box(0.026, 0.010, 0.036, (0.034, 0.0, 0.010))),
        (Pinch(ALONG_Y, 0.052, 0.0, 0.056),),
        0.026,
    ),
    "bottle": Shape(
        (_cylinder(0.024, 0.052), _cylinder(0.011, 0.030, 0.052)),
        (Pinch(None, 0.048, 0.0, 0.052),),
        0.024,
    ),
    "cross": Shape(
        (_box(0.026, 0.090, 0.030), _box(0.090, 0.026, 0.030)),
        (Pinch(ALONG_X, 0.026, 0.0, 0.030, (0.0, 0.030)), Pinch(ALONG_X, 0.026, 0.0, 0.030, (0.0, -0.030))),
        0.045,
    ),
    "tee": Shape(
        (_box(0.026, 0.090, 0.030, (-0.020, 0.0, 0.0)), _box(0.044, 0.028, 0.030, (0.015, 0.0, 0.0))),
        (Pinch(ALONG_Y, 0.028, 0.0, 0.030, (0.015, 0.0)),),
        0.045,
    ),
    "tower": Shape(
        (_box(0.052, 0.052, 0.030), _box(0.028, 0.028, 0.034, (0.0, 0.0, 0.030))),
        (Pinch(ALONG_X, 0.028, 0.030, 0.064), Pinch(ALONG_Y, 0.028, 0.030, 0.064)),
        0.026,
    ),
    "bridge": Shape(
        (
            _box(0.040, 0.024, 0.030, (0.0, 0.033, 0.0)),
            _box(0.040, 0.024, 0.030, (0.0, -0.033, 0.0)),
            _box(0.040, 0.090, 0.016, (0.0, 0.0, 0.030)),
        ),
        (Pinch(ALONG_X, 0.040, 0.010, 0.046),),
        0.045,
    ),
}
COLOURS: dict[str, Rgb] = {
    "red": (0.82, 0.10, 0.10),
    "orange": (0.98, 0.50, 0.05),
    "yellow": (0.96, 0.86, 0.12),
    "green": (0.10, 0.58, 0.20),
    "blue": (0.10, 0.25, 0.85),
    "purple": (0.50, 0.14, 0.62),
}


@dataclass(frozen=True)
class Thing:
    """An object.

    Args:
        colour: of COLOURS.
        kind: of SHAPES.
        size: 1 for the sizes that stand in SHAPES.
        mass: in kilograms.
    """

    colour: str
    kind: str
    size: float
    mass: float

    @property
    def words(self) -> str:
        """What it is called."""
        return f"{self.colour} {self.kind}"

    @property
    def shape(self) -> Shape:
        """Its shape at its size."""
        return _scaled(SHAPES[self.kind], self.size)

    @property
    def top(self) -> float:
        """Its height."""
        return max(part.at[2] + part.half[2] for part in self.shape.parts)

    def extent(self, heading: float, direction: float) -> tuple[float, float]:
        """How far it reaches against and along a direction on the table, as seen from its frame.

        Args:
            heading: of the thing.
            direction: angle in the world.
        """
        line = np.array([np.cos(direction - heading), np.sin(direction - heading)])
        reach = np.concatenate([part.outline() for part in self.shape.parts]) @ line
        return float(reach.min()), float(reach.max())

    def add_to(self, spec: mujoco.MjSpec, name: str) -> None:
        """Put it into a model as a free body of some name."""
        body = spec.worldbody.add_body(name=name)
        body.add_freejoint(name=name)
        volumes = [float(np.prod(part.half)) for part in self.shape.parts]
        for part, volume in zip(self.shape.parts, volumes, strict=True):
            _add_geom(body, part, COLOURS[self.colour], mass=self.mass * volume / sum(volumes))


def _scaled(shape: Shape, size: float) -> Shape:
    def triple(numbers: tuple[float, float, float]) -> tuple[float, float, float]:
        return size * numbers[0], size * numbers[1], size * numbers[2]

    parts = tuple(Part(triple(part.half), triple(part.at), part.round) for part in shape.parts)
    pinches = tuple(
        Pinch(
            pinch.angle,
            size * pinch.width,
            size * pinch.low,
            size * pinch.high,
            (size * pinch.at[0], size * pinch.at[1]),
        )
        for pinch in shape.pinches
    )
    return Shape(parts, pinches, size * shape.press)


def _named(*things: Thing) -> dict[str, Thing]:
    return {f"{thing.colour}_{thing.kind}": thing for thing in things}


THINGS = _named(
    Thing("red", "cube", 1.0, 0.12),
    Thing("blue", "cube", 0.86, 0.08),
    Thing("yellow", "brick", 1.0, 0.16),
    Thing("green", "brick", 0.88, 0.11),
    Thing("orange", "can", 1.0, 0.15),
    Thing("purple", "can", 0.88, 0.10),
    Thing("green", "disc", 1.0, 0.08),
    Thing("red", "disc", 0.90, 0.06),
    Thing("blue", "bar", 1.0, 0.09),
    Thing("yellow", "bar", 0.90, 0.07),
    Thing("purple", "mug", 1.0, 0.13),
    Thing("orange", "mug", 0.90, 0.10),
    Thing("green", "bottle", 1.0, 0.14),
    Thing("blue", "bottle", 0.92, 0.11),
    Thing("red", "tee", 1.0, 0.10),
    Thing("purple", "cross", 1.0, 0.11),
    Thing("orange", "tower", 1.0, 0.12),
    Thing("blue", "tower", 0.90, 0.09),
    Thing("yellow", "bridge", 1.0, 0.12),
    Thing("red", "bridge", 0.90, 0.09),
)

INNER = 0.056  # m from a container's middle to its wall
OUTER = 0.062  # m to where it ends
BOTTOM = 0.006  # m that things in a container lie above the table
RIM = 0.026  # m of the wall's upper edge above the table
CONTAINERS = {"bowl": 8, "tray": 4}  # and the number of their walls
TABLES: dict[str, Rgb] = {"oak": (0.74, 0.60, 0.43), "slate": (0.42, 0.46, 0.52)}
CONTAINER_COLOURS: dict[str, Rgb] = {"pink": (0.96, 0.52, 0.72), "turquoise": (0.15, 0.78, 0.78)}
MAT_COLOURS: dict[str, Rgb] = {"white": (0.95, 0.95, 0.95), "black": (0.07, 0.07, 0.08)}
MAT = 0.045  # m, half a mat's side
MAT_HEIGHT = 0.0015  # m, half


def add_container(spec: mujoco.MjSpec, name: str, kind: str, rgb: Rgb) -> None:
    """A container that stands where data.mocap_pos says."""
    body = spec.worldbody.add_body(name=name, mocap=True)
    walls, middle = CONTAINERS[kind], (INNER + OUTER) / 2
    half = OUTER * np.tan(np.pi / walls)
    if walls > 4:
        floor = Part((OUTER, OUTER, BOTTOM / 2), (0.0, 0.0, BOTTOM / 2), True)
    else:
        floor = Part((OUTER, OUTER, BOTTOM / 2), (0.0, 0.0, BOTTOM / 2))
    _add_geom(body, floor, (0.72 * rgb[0], 0.72 * rgb[1], 0.72 * rgb[2]))
    for k in range(walls):
        angle = 2 * np.pi * k / walls
        wall = Part(
            ((OUTER - INNER) / 2, half, RIM / 2), (middle * np.cos(angle), middle * np.sin(angle), RIM / 2)
        )
        _add_geom(body, wall, rgb, turn=angle)


def add_mat(spec: mujoco.MjSpec, name: str, rgb: Rgb) -> None:
    """A mat, which things pass over as if it were painted on the table, where data.mocap_pos says."""
    body = spec.worldbody.add_body(name=name, mocap=True)
    geom = _add_geom(body, Part((MAT, MAT, MAT_HEIGHT), (0.0, 0.0, 0.0)), rgb)
    geom.contype, geom.conaffinity = 0, 0


def _add_geom(
    body: mujoco.MjsBody, part: Part, rgb: Rgb, mass: float = 0.0, turn: float = 0.0
) -> mujoco.MjsGeom:
    kinds = mujoco.mjtGeom
    return body.add_geom(
        type=kinds.mjGEOM_CYLINDER if part.round else kinds.mjGEOM_BOX,
        size=[part.half[0], part.half[2], 0.0] if part.round else list(part.half),
        pos=list(part.at),
        quat=[np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)],
        rgba=[*rgb, 1.0],
        mass=mass,
        friction=list(FRICTION),
        condim=4,
        contype=1,
        conaffinity=3,
    )
