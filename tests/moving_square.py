"""A task for any robot: a square goes where the first two numbers of each action say; success in a corner."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.embodiment import Embodiment
from envs.episodes import Episode
from tests.embodiments import recorded_cameras, world_spec

SIZE = (32, 32)
SQUARE = 8  # pixels
SPEED = 0.12  # of the way across, per frame
CORNER = 0.8  # from which on, both ways, the task is done
INSTRUCTION = "move the square to the corner"


def moving_square(
    robot: Embodiment,
    seed: int,
    source: str = "expert",
    length: int = 13,
    labelled: bool = True,
) -> Episode:
    """One episode; an "expert" goes to the corner, anybody else wanders about the middle."""
    rng = np.random.default_rng(seed)
    place = np.empty((length, 2))
    place[0] = rng.uniform(0.0, 0.4, 2)
    for frame in range(1, length):
        step = 1.0 - place[frame - 1] if source == "expert" else rng.normal(0, SPEED, 2)
        limit = 1.0 if source == "expert" else 0.6
        place[frame] = (place[frame - 1] + step.clip(-SPEED, SPEED)).clip(0, limit)
    commands = np.zeros((length, robot.action_dim), np.float32)
    commands[:, :2] = np.diff(place, axis=0, prepend=place[:1]) if robot.delta else place
    states = np.zeros((length, robot.state_dim), np.float32)
    states[:, :2] = place
    spec = world_spec(robot, SIZE)
    intrinsic, c2w = recorded_cameras(spec, length) if robot.calibrated else (None, None)
    return Episode(
        frames=np.stack([picture(at, spec.views) for at in place]),
        commands=commands,
        states=states,
        instruction=INSTRUCTION,
        embodiment=robot.at(SIZE),
        source=source,
        seed=seed,
        success=(place > CORNER).all(1) if labelled else None,
        intrinsic=intrinsic,
        c2w=c2w,
        privileged={"object_pose": place.astype(np.float32)},
    )


def picture(place: NDArray[np.float64], views: int) -> NDArray[np.uint8]:
    """Pictures uint8 [V, 3, H, W] of the square at `place` [2] in 0..1; every other view is mirrored."""
    height, width = SIZE
    out = np.empty((views, 3, height, width), np.uint8)
    out[:] = np.array([40, 60, 80], np.uint8)[:, None, None]
    x, y = (place * (width - SQUARE, height - SQUARE)).round().astype(int)
    out[:, :, y : y + SQUARE, x : x + SQUARE] = np.array([220, 40, 30], np.uint8)[:, None, None]
    out[1::2] = out[1::2, :, :, ::-1]
    return out


def episodes_of(robot: Embodiment, labelled: bool = True) -> list[Episode]:
    """Twenty episodes, every other one a success."""
    return [
        moving_square(robot, seed, "expert" if seed % 2 == 0 else "random", labelled=labelled)
        for seed in range(20)
    ]
