"""The tabletop as a task suite: two arms at a table, commanded by end-effector poses or by joints.

What all its suites share stands in `TwoArmSuite`; `Tabletop` is the smallest of them.
"""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from envs.embodiment import Camera, Embodiment
from envs.physics.mujoco_suite import MujocoSuite, World
from envs.physics.suite import (
    Array,
    Expert,
    Observation,
    SuiteError,
    check_cameras,
    check_task,
)
from envs.physics.tabletop.actions import ACTIONS, JointActions
from envs.physics.tabletop.arms import DOWN
from envs.physics.tabletop.bench import Bench
from envs.physics.tabletop.scene import CAMERAS, TIP_HEIGHT, TOOL_OFFSET
from envs.physics.tabletop.tasks import TASKS, TabletopTask
from envs.ranges import NonNegative, Positive


class TwoArmSuite(MujocoSuite):
    """Two 7-DoF arms with parallel grippers and calibrated cameras; subclasses lay out episodes.

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

    instruction: str

    offers = MappingProxyType({"actions": tuple(ACTIONS), "cameras": tuple(CAMERAS)})

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
        kind = ACTIONS[actions]
        super().__init__(size, cameras)
        self._bench = Bench(kind, control_hz, hold)
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

    def carry_out(self, action: Array) -> None:
        """Carry out one absolute action [A]; too fast or too far is carried out as far as limits allow."""
        self._bench.step(action)

    def world(self) -> World:
        """See MujocoSuite."""
        return World(type(self).__name__, self._bench.model, self._bench.data)

    def observe(self) -> Observation:
        """Joint state, calibration, and how the task stands."""
        bench = self._bench
        intrinsic, c2w = self.calibration()
        return Observation(
            state=bench.state(),
            command=bench.actions.command.copy(),
            instruction=self.instruction,
            success=bench.condition.success,
            progress=bench.goal.progress(bench.data),
            intrinsic=intrinsic,
            c2w=c2w,
            poses=None if self.embodiment.kinematics is None else bench.actions.poses,
        )

    def privileged(self) -> dict[str, Array]:
        """True object poses [objects, 4] = [x, y, z, heading] and true flange poses [2, 6]."""
        bench = self._bench
        return {"object_poses": bench.goal.object_poses(bench.data), "flange_poses": bench.flanges()}


class Tabletop(TwoArmSuite):
    """The tasks of tasks.TASKS, each in a model of its own; options are those of TwoArmSuite."""

    tasks = tuple(TASKS)
    _task: TabletopTask

    def __init__(
        self,
        actions: str,
        control_hz: Positive,
        hold: NonNegative,
        size: tuple[int, int],
        cameras: tuple[str, ...],
    ):
        super().__init__(actions, control_hz, hold, size, cameras)
        self._made: dict[str, TabletopTask] = {}

    def reset(self, task: str, seed: int) -> None:
        """Lay out the start of `task` that `seed` draws."""
        check_task(task, self.tasks)
        if task not in self._made:
            self._made[task] = TASKS[task]()
        self._task = self._made[task]
        start = self._task.reset(seed)
        self.instruction = start.instruction
        poses = np.array([[*tip, TIP_HEIGHT + TOOL_OFFSET, *DOWN, 1.0] for tip in start.fingertips])
        self._bench.begin(self._task.model, self._task.data, self._task, poses)

    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        """The task's expert moves one arm's fingertips; the other arm, heights and angles stay."""
        bench = self._bench
        behaviour = self._task.expert(bench.data, noise_level, rng, 1 / self.embodiment.fps)
        start = bench.actions.poses.copy()

        def act() -> Array:
            poses = start.copy()
            tip = bench.actions.poses[behaviour.arm, :2]
            poses[behaviour.arm, :2] = behaviour.fingertip(tip)
            return bench.actions.encode(poses, bench.target)

        return act
