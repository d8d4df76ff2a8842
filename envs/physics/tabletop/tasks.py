"""Tasks of the bench: where things stand at the start, what the words ask for, how far along it is, when it
is done.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCK_COLOURS = {
    "red": (0.80, 0.13, 0.12),
    "purple": (0.50, 0.16, 0.62),
    "yellow": (0.93, 0.82, 0.10),
    "pink": (0.95, 0.45, 0.65),
}
TARGET_COLOURS = {"green": (0.15, 0.68, 0.28), "blue": (0.12, 0.38, 0.85), "white": (0.95, 0.95, 0.95)}


@dataclass
class Layout:
    """One start of a task, drawn from a seed. Positions in metres on the table, colours RGB in 0..1."""

    block: Array  # [2] xy
    block_yaw: float
    block_half: float  # half edge length
    target: Array  # [2] xy
    grippers: Array  # [2, 2] xy of the left and right fingertips
    block_rgb: tuple[float, float, float]
    target_rgb: tuple[float, float, float]
    table_rgb: tuple[float, float, float]
    instruction: str
    arm: int  # 0 left, 1 right: the arm on the block's side


@dataclass
class Push:
    """Bring the block onto the target with the arm on the block's side.

    Args:
        radius: success distance between block and target centres in metres.
        hold: seconds the distance must stay within the radius; being there for a moment is no success.
        scale: distance in metres at which progress is zero.
    """

    radius: float = 0.05
    hold: float = 0.4
    scale: float = 0.30
    name: str = field(default="push", init=False)

    def sample(self, rng: np.random.Generator) -> Layout:
        """Draw a start: a block in front of one gripper and a target 10 to 20 cm further on."""
        arm = int(rng.integers(2))
        side = 1.0 if arm == 0 else -1.0
        block = np.array([rng.uniform(0.13, 0.23), side * rng.uniform(0.05, 0.24)])
        heading = rng.uniform(-0.5, 0.5)
        distance = rng.uniform(0.10, 0.19)
        target = block + distance * np.array([np.cos(heading), np.sin(heading)])
        target[1] = np.clip(target[1], -0.30, 0.30)
        # The other arm stays by its own base, away from the block.
        grippers = np.array([[rng.uniform(0.01, 0.06), s * rng.uniform(0.10, 0.24)] for s in (1.0, -1.0)])
        block_name = str(rng.choice(list(BLOCK_COLOURS)))
        target_name = str(rng.choice(list(TARGET_COLOURS)))
        shade = rng.uniform(0.75, 1.1)
        table = np.clip(np.array([0.72, 0.60, 0.46]) * shade + rng.uniform(-0.06, 0.06, 3), 0.0, 1.0)
        return Layout(
            block=block,
            block_yaw=float(rng.uniform(-0.5, 0.5)),
            block_half=float(rng.uniform(0.027, 0.033)),
            target=target,
            grippers=grippers,
            block_rgb=BLOCK_COLOURS[block_name],
            target_rgb=TARGET_COLOURS[target_name],
            table_rgb=(float(table[0]), float(table[1]), float(table[2])),
            instruction=f"push the {block_name} block onto the {target_name} disc",
            arm=arm,
        )

    def distance(self, block: Array, target: Array) -> float:
        """Distance in metres between the centres of block and target, on the table."""
        return float(np.hypot(*(block[:2] - target[:2])))

    def progress(self, distance: float) -> float:
        """Progress in [0, 1]: 1 on the target, falling linearly to 0 at `scale` metres."""
        return float(np.clip(1.0 - distance / self.scale, 0.0, 1.0))


TASKS = {"push": Push}
