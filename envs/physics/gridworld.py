"""Coloured squares in a plane, each driven by a velocity of its own: WPE's study of how actions are told.

An action is the pixels by which every square moves until the next frame, in a picture of 256 x 256, whatever
size is rendered. Nothing else moves, so whatever a learned world gets wrong it has not understood of actions.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from envs.embodiment import ActionKind, Camera, Embodiment
from envs.physics.suite import (
    Array,
    Expert,
    HeldCondition,
    Observation,
    SuiteError,
    TaskSuite,
    check_cameras,
    check_noise_level,
    check_task,
    checked_action,
)
from envs.ranges import Count, NonNegative
from envs.rng import Stream, episode_rng

EDGE = 256.0  # pixels of the plane, each way
SIDE = 64.0  # of a square
REACH = 64.0  # pixels that a square moves in a frame at most, each way
COLOURS = {"red": (220, 50, 40), "green": (50, 200, 60), "blue": (50, 80, 230)}
_GROUND = (30, 30, 34)
_NEAR = 24.0  # pixels from the middle that count as there
_FAR = 64.0  # pixels from the middle at which the red square begins, at least


class Gridworld(TaskSuite):
    """The task `centre`: the red square comes to the middle, others wander.

    Squares stay in the picture: a velocity that would carry one out is cut, and scripted behaviour asks for
    none. Later squares lie above earlier ones.

    Args:
        squares: of them, at most three.
        size: (height, width) of the picture.
        cameras: the one there is, ["above"].
        fps: frames per second.
        hold: seconds that the red square must stay in the middle.
    """

    tasks = ("centre",)

    def __init__(
        self,
        squares: Count,
        size: tuple[Count, Count],
        cameras: Sequence[str],
        fps: Count,
        hold: NonNegative,
    ):
        check_cameras(cameras, ["above"])
        if squares > len(COLOURS):
            raise SuiteError(f"task.suite.squares={squares}: there are {len(COLOURS)} colours")
        self.size, self.colours = (size[0], size[1]), tuple(COLOURS)[:squares]
        names = tuple(f"{colour}_{axis}" for colour in self.colours for axis in "xy")
        self.embodiment = Embodiment(
            robot=f"gridworld_{squares}",
            action_names=names,
            action_kind=ActionKind.OTHER,
            delta=True,
            arms=(),
            state_names=names,
            cameras=(Camera("above", self.size),),
            fps=float(fps),
        )
        self._held = HeldCondition(hold, fps)
        self._at, self._last, self._start = np.zeros((squares, 2)), np.zeros(2 * squares), 1.0

    def reset(self, task: str, seed: int) -> None:
        """See TaskSuite."""
        check_task(task, self.tasks)
        rng, low, high = episode_rng(seed, Stream.START), SIDE / 2, EDGE - SIDE / 2
        self._at = rng.uniform(low, high, self._at.shape)
        while self._distance() < _FAR:
            self._at[0] = rng.uniform(low, high, 2)
        self._last, self._start = np.zeros(self._at.size), self._distance()
        self._held.reset()

    def step(self, action: Array) -> None:
        """See TaskSuite."""
        self._last = checked_action(action, self.embodiment.action_names)
        self._at = self._inside(self._at + self._last.reshape(-1, 2).clip(-REACH, REACH))
        self._held.update(self._distance() <= _NEAR)

    def render(self) -> NDArray[np.uint8]:
        """See TaskSuite; edges are smooth, so that pictures tell parts of pixels."""
        out = np.empty((3, *self.size))
        out[:] = np.array(_GROUND)[:, None, None]
        for colour, share in zip(self.colours, self._shares(), strict=True):
            out += share * (np.array(COLOURS[colour])[:, None, None] - out)
        return out.round().astype(np.uint8)[None]

    def segment(self) -> NDArray[np.uint8]:
        """See TaskSuite; all squares are the robot."""
        return (np.max(self._shares(), 0) >= 0.5).astype(np.uint8)[None]

    def observe(self) -> Observation:
        """See TaskSuite; the squares are the robot, and know where they are."""
        progress = float(np.clip(1 - self._distance() / self._start, 0, 1))
        instruction = "bring the red square to the middle"
        return Observation(self._at.flatten(), self._last.copy(), instruction, self._held.success, progress)

    def privileged(self) -> dict[str, Array]:
        """See TaskSuite; the picture is taken to be a metre wide."""
        return {"object_poses": np.concatenate([self._at / EDGE, np.zeros((len(self._at), 1))], 1)}

    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        """See TaskSuite."""
        check_noise_level(noise_level)

        def act() -> Array:
            low, high = SIDE / 2 - self._at, EDGE - SIDE / 2 - self._at
            velocity = rng.uniform(np.maximum(low, -REACH), np.minimum(high, REACH))
            there = (EDGE / 2 - self._at[0]).clip(-REACH, REACH)
            velocity[0] = noise_level * velocity[0] + (1 - noise_level) * there
            return velocity.flatten()

        return act

    def _shares(self) -> list[Array]:
        """Share [H, W] of each pixel that a square covers, square by square."""
        return [np.outer(_covered(y, self.size[0]), _covered(x, self.size[1])) for x, y in self._at]

    def _inside(self, at: Array) -> Array:
        return at.clip(SIDE / 2, EDGE - SIDE / 2)

    def _distance(self) -> float:
        """Of the red square from the middle, in pixels."""
        return float(np.linalg.norm(self._at[0] - EDGE / 2))


def _covered(middle: float, pixels: int) -> Array:
    """Share [pixels] of each pixel of a line that a square around `middle` covers."""
    scale, edges = pixels / EDGE, np.arange(pixels + 1)
    low, high = (middle - SIDE / 2) * scale, (middle + SIDE / 2) * scale
    return (np.minimum(edges[1:], high) - np.maximum(edges[:-1], low)).clip(0, 1)
