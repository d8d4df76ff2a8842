"""Where things lie at the start of an episode, and the MuJoCo model of a scene.

Three columns run away from the robot: two hold an object and a mat each, the third holds both containers. So
each object can be pushed and pulled without meeting another, and every task can be asked for at every start.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.physics.tabletop.scene import ROBOT_FILE
from envs.physics.tabletop.scenes.catalogue import (
    CONTAINER_COLOURS,
    FRICTION,
    MAT_COLOURS,
    MAT_HEIGHT,
    TABLES,
    THINGS,
    add_container,
    add_mat,
)
from envs.physics.tabletop.scenes.scene import Scene
from envs.rng import Stream, episode_rng

Array = NDArray[np.float64]
COLUMNS = (-0.165, 0.0, 0.165)  # m, their places across the table
CONTAINERS_AT = (0.055, 0.225)  # m, along the table
EYE, FOVY = (0.41, 0.0, 0.90), 31.0  # of the head camera: nearer than in the robot's file, to see shapes
OBJECTS = ("thing", "companion")  # names of bodies in the model, as are the colours of containers and mats
MEMORY = 4 * 2**20  # bytes of MuJoCo's arena; its guess is four times that, and a process holds many worlds


@dataclass(frozen=True)
class Layout:
    """Where everything is at the start.

    Args:
        scene: whose object is the first.
        companion: name of the other object.
        objects: [2, 3] place on the table and heading of both.
        containers: place [2] of each by its colour.
        mats: the same.
        hands: [2, 7] fingertip pose [x, y, z, roll, pitch, yaw] and gripper of both hands.
    """

    scene: Scene
    companion: str
    objects: Array
    containers: dict[str, Array]
    mats: dict[str, Array]
    hands: Array


def draw_layout(scene: Scene, companions: tuple[str, ...], seed: int) -> Layout:
    """The start that a seed draws in a scene, whatever the task.

    Args:
        companions: objects of which one lies beside the scene's own.
        seed: of the episode.
    """
    rng = episode_rng(seed, Stream.LAYOUT)
    companion = str(rng.choice(companions))
    columns = rng.permutation(COLUMNS)
    x = rng.uniform(0.11, 0.20, 2)
    y = columns[:2] + rng.uniform(-0.012, 0.012, 2)
    heading = rng.uniform(-0.5, 0.5, 2) + np.pi * rng.integers(2, size=2)
    far = (x < 0.165) | (rng.random(2) < 0.5)  # nearer mats would lie under the hands
    mat_x = x + np.where(far, 1.0, -1.0) * rng.uniform(0.115, 0.13, 2)
    mats = np.stack((mat_x, columns[:2] + rng.uniform(-0.02, 0.02, 2)), 1)
    along = np.array(CONTAINERS_AT) + rng.uniform(-0.015, 0.015, 2)
    across = columns[2] + rng.uniform(-0.010, 0.010, 2)
    hands = np.zeros((2, 7))
    for hand, side in zip(hands, (1.0, -1.0), strict=True):
        hand[:3] = rng.uniform(-0.03, 0.02), side * rng.uniform(0.17, 0.22), rng.uniform(0.12, 0.17)
        hand[3:6] = np.array([np.pi, 0.0, 0.0]) + rng.normal(0.0, (0.06, 0.06, 0.20))
        hand[6] = rng.uniform(0.0, 1.0)
    return Layout(
        scene,
        companion,
        np.stack((x, y, heading), 1),
        _shuffled(CONTAINER_COLOURS, np.stack((along, across), 1), rng),
        _shuffled(MAT_COLOURS, mats, rng),
        hands,
    )


def _shuffled(names: dict[str, tuple[float, float, float]], places: Array, rng: np.random.Generator) -> dict:
    return {str(name): place for name, place in zip(rng.permutation(list(names)), places, strict=True)}


def lay_out(layout: Layout) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A world in which everything lies where a layout says; the caller's arms are not placed yet."""
    scene = layout.scene
    model = _model(scene, layout.companion)
    data = mujoco.MjData(model)
    for name, (x, y, heading) in zip(OBJECTS, layout.objects, strict=True):
        start = model.joint(name).qposadr[0]
        data.qpos[start : start + 7] = [x, y, 0.0, np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)]
    for name, place in (*layout.containers.items(), *layout.mats.items()):
        height = MAT_HEIGHT if name in layout.mats else 0.0
        data.mocap_pos[model.body(name).mocapid[0]] = [*place, height]
    return model, data


@lru_cache(256)
def _model(scene: Scene, companion: str) -> mujoco.MjModel:
    """The model of a scene with another object in it; episodes differ in data alone, so they share it."""
    spec = mujoco.MjSpec.from_file(str(ROBOT_FILE))
    spec.memory = MEMORY
    table = spec.geom("table")
    table.rgba, table.friction, table.condim = [*TABLES[scene.table], 1.0], list(FRICTION), 4
    floor = spec.geom("floor")  # hardly in view, and its texture costs a fifth of rendering
    floor.material, floor.rgba = "", [0.28, 0.29, 0.33, 1.0]
    camera = spec.camera("head")
    camera.pos, camera.fovy = list(EYE), FOVY
    for name, thing in zip(OBJECTS, (scene.thing, companion), strict=True):
        THINGS[thing].add_to(spec, name)
    for name, rgb in CONTAINER_COLOURS.items():
        add_container(spec, name, scene.container, rgb)
    for name, rgb in MAT_COLOURS.items():
        add_mat(spec, name, rgb)
    return spec.compile()
