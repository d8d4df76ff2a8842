"""The tabletop as a task suite: two arms at a table, commanded by end-effector poses or by joints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from envs.embodiment import Camera, Embodiment
from envs.physics.render import calibration
from envs.physics.suite import (
    Array,
    Expert,
    Observation,
    SuiteError,
    TaskSuite,
    check_cameras,
    check_task,
)
from envs.physics.tabletop.actions import ACTIONS, JointActions
from envs.physics.tabletop.bench import Bench
from envs.physics.tabletop.scene import CAMERAS
from envs.physics.tabletop.tasks import TASKS
from envs.ranges import NonNegative, Positive


class Tabletop(TaskSuite):
    """Two 7-DoF arms with parallel grippers, calibrated cameras, and the tasks of tasks.TASKS.

    Args:
        actions: "end_effector" for 14 absolute numbers [x, y, z, roll, pitch, yaw, gripper] of the left and
            right flange, or "joints" for 16 absolute numbers [seven joints, gripper] of both arms.
        control_hz: actions and frames per second.
        hold: seconds the task's condition must hold.
        size: (height, width) of every picture.
        cameras: names out of head (fixed), hand_left and hand_right (on the wrists), in the views' order.

    Raises:
        SuiteError: if there is no such kind of action or camera.
    """

    tasks = tuple(TASKS)

    def __init__(
        self,
        actions: str,
        control_hz: Positive,
        hold: NonNegative,
        size: tuple[int, int],
        cameras: tuple[str, ...],
    ):
        if actions not in ACTIONS:
            raise SuiteError(f"task.suite.actions={actions!r} is unknown; choose one of {sorted(ACTIONS)}")
        check_cameras(cameras, CAMERAS)
        self.size, self._hold = size, hold
        self._actions = kind = ACTIONS[actions]
        self._benches: dict[str, Bench] = {}
        self._bench: Bench
        self.embodiment = Embodiment(
            robot="worldloop_tabletop",
            action_names=kind.names,
            action_kind=kind.kind,
            delta=False,
            arms=kind.layout,
            state_names=JointActions.names,
            cameras=tuple(Camera(name, size, CAMERAS[name], calibrated=True) for name in cameras),
            fps=control_hz,
            kinematics=kind.kinematics(),
        )

    def reset(self, task: str, seed: int) -> None:
        """Lay out the start of `task` that `seed` draws."""
        if task not in self._benches:
            check_task(task, self.tasks)
            self._benches[task] = Bench(
                TASKS[task](), self._actions, self.embodiment.fps, self._hold, self.embodiment.views
            )
        self._bench = self._benches[task]
        self._bench.reset(seed)

    def step(self, action: Array) -> None:
        """Carry out one absolute action [A]; too fast or too far is carried out as far as limits allow."""
        self._bench.step(action)

    def render(self) -> NDArray[np.uint8]:
        """Pictures uint8 [V, 3, H, W] without shadows, which cost eight times all else in software."""
        return self._bench.render(self.size, shadows=False)

    def picture(self, size: tuple[int, int]) -> NDArray[np.uint8]:
        """Pictures with shadows, of any size."""
        return self._bench.render(size, shadows=True)

    def observe(self) -> Observation:
        """Joint state, calibration, and how the task stands."""
        bench = self._bench
        intrinsic, c2w = calibration(bench.model, bench.data, bench.cameras, self.size)
        return Observation(
            state=bench.state(),
            command=bench.actions.command.copy(),
            instruction=bench.start.instruction,
            success=bench.condition.success,
            progress=bench.task.progress(bench.data),
            intrinsic=intrinsic,
            c2w=c2w,
            poses=None if self.embodiment.kinematics is None else bench.actions.poses,
        )

    def privileged(self) -> dict[str, Array]:
        """True object poses [objects, 4] = [x, y, z, heading] and true flange poses [2, 6]."""
        bench = self._bench
        return {"object_poses": bench.task.object_poses(bench.data), "flange_poses": bench.flanges()}

    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        """The task's expert moves one arm's fingertips; the other arm, heights and angles stay."""
        bench = self._bench
        behaviour = bench.task.expert(bench.data, noise_level, rng, 1 / self.embodiment.fps)
        start = bench.actions.poses.copy()

        def act() -> Array:
            poses = start.copy()
            tip = bench.actions.poses[behaviour.arm, :2]
            poses[behaviour.arm, :2] = behaviour.fingertip(tip)
            return bench.actions.encode(poses, bench.target)

        return act
