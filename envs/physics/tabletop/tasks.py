"""Tasks of the bench: their objects, how an episode starts, what the words ask for, when it is done.

A task is a class here and a line in TASKS. It adds its objects to the robot's model, so nothing else of the
bench knows them.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.physics.suite import check_noise_level
from envs.physics.tabletop.bench import Goal
from envs.physics.tabletop.experts import Drifting, FingertipExpert, PushExpert, WaypointWalk
from envs.physics.tabletop.scene import ROBOT_FILE
from envs.rng import Stream, episode_rng

Array = NDArray[np.float64]
BLOCK_COLOURS = {
    "red": (0.80, 0.13, 0.12),
    "purple": (0.50, 0.16, 0.62),
    "yellow": (0.93, 0.82, 0.10),
    "pink": (0.95, 0.45, 0.65),
}
TARGET_COLOURS = {"green": (0.15, 0.68, 0.28), "blue": (0.12, 0.38, 0.85), "white": (0.95, 0.95, 0.95)}


@dataclass
class Start:
    """What a task draws from a seed for the bench to begin with.

    Args:
        instruction: the task in words.
        fingertips: [2, 2] xy in metres of the left and right fingertips.
        table_rgb: colour of the table, 0..1.
    """

    instruction: str
    fingertips: Array
    table_rgb: Array


class TabletopTask(Goal):
    """One task: objects in a model of its own, the start of an episode, its condition and its expert."""

    def __init__(self) -> None:
        spec = mujoco.MjSpec.from_file(str(ROBOT_FILE))
        self.add_objects(spec)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def reset(self, seed: int) -> Start:
        """Lay out the start that a seed draws; the same seed gives the same, bit for bit."""
        mujoco.mj_resetData(self.model, self.data)
        start = self.begin(self.model, self.data, episode_rng(seed, Stream.START))
        self.model.geom("table").rgba[:3] = start.table_rgb
        return start

    @abstractmethod
    def add_objects(self, spec: mujoco.MjSpec) -> None:
        """Put the task's bodies and marks into the robot's model, before it is compiled."""

    @abstractmethod
    def begin(self, model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> Start:
        """Draw a start, and lay out the task's objects accordingly in model and data."""

    @abstractmethod
    def expert(
        self, data: mujoco.MjData, noise_level: float, rng: np.random.Generator, period: float
    ) -> FingertipExpert:
        """The scripted behaviour of the episode that has just begun, in [0, 1] from expert to chance."""


class Push(TabletopTask):
    """Bring the block onto the disc with the arm on the block's side: centres within RADIUS metres."""

    RADIUS: ClassVar[float] = 0.05
    SCALE: ClassVar[float] = 0.30  # m of distance at which progress is zero

    def add_objects(self, spec: mujoco.MjSpec) -> None:
        """A flat disc as a mark on the table, and a block that can be pushed."""
        spec.worldbody.add_site(
            name="target",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[self.RADIUS, 0.0008, 0.0],
            pos=[0.3, 0.0, 0.0008],
        )
        block = spec.worldbody.add_body(name="block", pos=[0.2, 0.1, 0.03])
        block.add_freejoint(name="block")
        block.add_geom(
            name="block",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.03, 0.03, 0.03],
            mass=0.15,
            friction=[0.45, 0.01, 0.001],
            contype=1,
            conaffinity=3,
        )

    def begin(self, model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> Start:
        """A block in front of one gripper and a disc 10 to 19 cm further on, in colours that are named."""
        arm = int(rng.integers(2))
        side = 1.0 if arm == 0 else -1.0
        block = np.array([rng.uniform(0.13, 0.23), side * rng.uniform(0.05, 0.24)])
        heading = rng.uniform(-0.5, 0.5)
        distance = rng.uniform(0.10, 0.19)
        target = block + distance * np.array([np.cos(heading), np.sin(heading)])
        target[1] = np.clip(target[1], -0.30, 0.30)
        # The other arm stays by its own base, away from the block.
        fingertips = np.array([[rng.uniform(0.01, 0.06), s * rng.uniform(0.10, 0.24)] for s in (1.0, -1.0)])
        block_name = str(rng.choice(list(BLOCK_COLOURS)))
        target_name = str(rng.choice(list(TARGET_COLOURS)))
        shade = rng.uniform(0.75, 1.1)
        table = np.clip(np.array([0.72, 0.60, 0.46]) * shade + rng.uniform(-0.06, 0.06, 3), 0.0, 1.0)
        turn = float(rng.uniform(-0.5, 0.5)) / 2
        half = float(rng.uniform(0.027, 0.033))

        self.arm, self.half, self.target = arm, half, target
        self.joint = int(model.joint("block").qposadr[0])
        model.geom("block").size[:] = half
        model.geom("block").rgba[:3] = BLOCK_COLOURS[block_name]
        model.site("target").rgba[:3] = TARGET_COLOURS[target_name]
        model.site("target").pos[:2] = target
        data.qpos[self.joint : self.joint + 7] = [*block, half, np.cos(turn), 0.0, 0.0, np.sin(turn)]
        return Start(f"push the {block_name} block onto the {target_name} disc", fingertips, table)

    def satisfied(self, data: mujoco.MjData) -> bool:
        """Whether the block's centre lies on the disc."""
        return self._distance(data) < self.RADIUS

    def progress(self, data: mujoco.MjData) -> float:
        """1 on the disc, falling linearly to 0 at SCALE metres."""
        return float(np.clip(1.0 - self._distance(data) / self.SCALE, 0.0, 1.0))

    def object_poses(self, data: mujoco.MjData) -> Array:
        """Block, then disc; a disc has no heading, which is written as zero."""
        x, y, z, a, b, c, d = data.qpos[self.joint : self.joint + 7]
        heading = np.arctan2(2 * (a * d + b * c), 1 - 2 * (c * c + d * d))
        return np.array([[x, y, z, heading], [*self.target, 0.0, 0.0]])

    def expert(
        self, data: mujoco.MjData, noise_level: float, rng: np.random.Generator, period: float
    ) -> FingertipExpert:
        """Push the block; noise shifts where block and disc are believed to be, and 1 is a random walk."""

        def block() -> Array:
            return np.array(data.qpos[self.joint : self.joint + 2])

        check_noise_level(noise_level)
        target = self.target + rng.normal(0.0, 0.05 * noise_level, 2)
        bias = rng.normal(0.0, 0.05 * noise_level, 2)
        behaviour: FingertipExpert
        if noise_level >= 1.0:
            behaviour = WaypointWalk(self.arm, block, rng, period)
        else:
            behaviour = PushExpert(self.arm, lambda: block() + bias, target, self.half, period)
        return Drifting(behaviour, noise_level, rng, period)

    def _distance(self, data: mujoco.MjData) -> float:
        return float(np.hypot(*(data.qpos[self.joint : self.joint + 2] - self.target)))


TASKS: dict[str, type[TabletopTask]] = {"push": Push}
