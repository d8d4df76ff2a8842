"""What task suites on MuJoCo share: pictures, what each pixel shows, calibration, steps per frame, and an
error where physics diverges.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import NamedTuple
from weakref import WeakSet

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.physics.render import Offscreen, calibration, offscreen_for
from envs.physics.suite import Array, SuiteError, TaskSuite

_SLOWEST = 5.0  # frames per second that an error still names
# Contexts for pictures that a process keeps beyond one for each of its suites: these may all be in episodes
# of different tasks, which are rendered by turns, and tasks that are not in play come back.
_SPARE_CONTEXTS = 8
_SUITES: WeakSet[MujocoSuite] = WeakSet()  # of this process
_DIVERGED = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


class SimulationDiverged(RuntimeError):
    """Positions, velocities or accelerations were no longer numbers, or too large: the episode is void."""


class World(NamedTuple):
    """An episode's physics.

    Args:
        assets: a name that models with equal meshes, textures and geoms share.
        model, data: MuJoCo's.
    """

    assets: str
    model: mujoco.MjModel
    data: mujoco.MjData


class MujocoSuite(TaskSuite):
    """A suite whose episodes are MuJoCo worlds; subclasses say by `world` which one is open, and by
    `carry_out` what an action does in it.

    Args:
        size: (height, width) of every picture.
        views: names of the models' cameras, in the order of the embodiment's.
    """

    def __init__(self, size: tuple[int, int], views: tuple[str, ...]):
        self.size, self.views = size, views
        _SUITES.add(self)

    @abstractmethod
    def world(self) -> World:
        """That of the episode which was reset last."""

    @abstractmethod
    def carry_out(self, action: Array) -> None:
        """What TaskSuite.step promises.

        Raises:
            ValueError: if the action [A] is not finite or has another shape.
        """

    def step(self, action: Array) -> None:
        """See TaskSuite.step.

        Raises:
            ValueError: as `carry_out` does.
            SimulationDiverged: if physics did. MuJoCo itself prints a warning, puts all things where the
                model's file has them, and goes on.
        """
        warnings = self.world().data.warning
        for kind in _DIVERGED:
            warnings[kind].number = 0
        self.carry_out(action)
        found = [kind.name for kind in _DIVERGED if warnings[kind].number]
        if found:
            raise SimulationDiverged(
                f"physics diverged under the action {np.round(action, 3).tolist()}: {', '.join(found)}"
            )

    def render(self) -> NDArray[np.uint8]:
        """Pictures uint8 [V, 3, H, W] without shadows and reflections, which cost eight times all else in
        software.
        """
        return self._offscreen(self.size).render(*self._shown(), shadows=False)

    def picture(self, size: tuple[int, int]) -> NDArray[np.uint8]:
        """Pictures with shadows, of any size."""
        return self._offscreen(size).render(*self._shown(), shadows=True)

    def segment(self) -> NDArray[np.uint8]:
        """See TaskSuite.segment."""
        return self._offscreen(self.size).segment(*self._shown())

    def calibration(self) -> tuple[Array, Array] | tuple[None, None]:
        """Intrinsics [V, 3, 3] and camera poses [V, 4, 4], see Observation; None where no camera is
        calibrated.
        """
        if not self.embodiment.calibrated:
            return None, None
        return calibration(*self._shown(), self.size)

    def _shown(self) -> tuple[mujoco.MjModel, mujoco.MjData, tuple[str, ...]]:
        _, model, data = self.world()
        return model, data, self.views

    def _offscreen(self, size: tuple[int, int]) -> Offscreen:
        assets, model, _ = self.world()
        return offscreen_for(assets, model, size, len(_SUITES) + _SPARE_CONTEXTS)


def steps_per_frame(control_hz: float, sim_hz: float) -> int:
    """Steps of a simulation that takes `sim_hz` a second to one frame.

    Raises:
        SuiteError: if that is no whole number; names rates that fit.
    """
    if sim_hz % control_hz:
        rates = [sim_hz / steps for steps in range(1, int(sim_hz / _SLOWEST) + 1)]
        exact = [f"{rate:g}" for rate in reversed(rates) if round(rate, 2) == rate]
        raise SuiteError(
            f"task.suite.control_hz={control_hz} must divide {sim_hz:g}, such as {', '.join(exact)}"
        )
    return round(sim_hz / control_hz)
