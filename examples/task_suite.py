"""Your own task suite: a dot that moves to the square which the words name.

worldloop run experiment=smoke 'hydra.searchpath=[file://examples/configs]' task=dot
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.embodiment import ActionKind, Arm, Camera, Embodiment
from envs.physics.suite import Expert, HeldCondition, Observation, TaskSuite, check_noise_level, check_task

COLOURS = {"red": (220, 50, 40), "green": (40, 190, 70), "blue": (50, 90, 220)}
SIZE = 32  # pixels a side
STEP, NEAR = 0.15, 0.12  # largest move per action and distance of success, in widths of the picture


class DotToSquare(TaskSuite):
    """One "arm" with two delta actions and one camera; two squares of different colours, one of which is
    meant.
    """

    tasks = ("reach",)
    embodiment = Embodiment(
        robot="dot",
        action_names=("delta_x", "delta_y"),
        action_kind=ActionKind.END_EFFECTOR,
        delta=True,
        arms=(Arm("dot", (0, 1)),),
        state_names=("x", "y"),
        cameras=(Camera("above", (SIZE, SIZE)),),
        fps=5.0,
    )

    def __init__(self) -> None:
        self.held = HeldCondition(hold=0.4, fps=self.embodiment.fps)

    def reset(self, task: str, seed: int) -> None:
        """See TaskSuite."""
        check_task(task, self.tasks)
        rng = np.random.default_rng(seed)
        self.names = list(rng.permutation(list(COLOURS))[:2])
        self.squares = np.array([rng.uniform(0.15, 0.45, 2), rng.uniform(0.55, 0.85, 2)])
        self.place, self.action = rng.uniform(0.1, 0.9, 2), np.zeros(2)
        self.start = self._distance()
        self.held.reset()

    def step(self, action: NDArray[Any]) -> None:
        """See TaskSuite; actions in -1..1."""
        self.action = np.clip(action, -1, 1)
        self.place = np.clip(self.place + STEP * self.action, 0.02, 0.98)
        self.held.update(self._distance() < NEAR)

    def render(self) -> NDArray[np.uint8]:
        """See TaskSuite."""
        picture = np.full((SIZE, SIZE, 3), 230, np.uint8)
        y, x = np.mgrid[:SIZE, :SIZE] / SIZE
        for name, square in zip(self.names, self.squares, strict=True):
            picture[(abs(x - square[0]) < 0.1) & (abs(y - square[1]) < 0.1)] = COLOURS[name]
        picture[(x - self.place[0]) ** 2 + (y - self.place[1]) ** 2 < 0.07**2] = 20
        return picture.transpose(2, 0, 1)[None].copy()

    def observe(self) -> Observation:
        """See TaskSuite."""
        progress = float(np.clip(1 - self._distance() / max(self.start, NEAR), 0, 1))
        words = f"move the dot to the {self.names[0]} square"
        return Observation(self.place.copy(), self.action.copy(), words, self.held.success, progress)

    def privileged(self) -> dict[str, NDArray[Any]]:
        """See TaskSuite."""
        return {"squares": self.squares.copy()}

    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        """See TaskSuite."""
        check_noise_level(noise_level)

        def act() -> NDArray[Any]:
            good = np.clip((self.squares[0] - self.place) / STEP, -1, 1)
            return np.clip((1 - noise_level) * good + noise_level * rng.normal(0, 1, 2), -1, 1)

        return act

    def _distance(self) -> float:
        return float(np.linalg.norm(self.squares[0] - self.place))
