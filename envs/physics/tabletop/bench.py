"""One MuJoCo bench with one task: lay out an episode, carry out actions, render, say how the task stands."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.physics.render import offscreen_for
from envs.physics.suite import HeldCondition
from envs.physics.tabletop.actions import ActionInterface, Target
from envs.physics.tabletop.arms import DOWN, ArmKinematics
from envs.physics.tabletop.scene import ARMS, FINGER_TRAVEL, HOME, ROBOT_FILE, TIP_HEIGHT, TOOL_OFFSET
from envs.physics.tabletop.tasks import Start, TabletopTask

Array = NDArray[np.float64]
GLIDE = 0.025  # s between joint targets: arms glide instead of jerking at the control rate


class Bench:
    """The true world for one episode at a time; states and commands are float64.

    Args:
        task: of all its episodes.
        actions: class of its commands.
        control_hz: actions and frames per second.
        hold: seconds the task's condition must hold.
        cameras: to render, in order.
    """

    def __init__(
        self,
        task: TabletopTask,
        actions: type[ActionInterface],
        control_hz: float,
        hold: float,
        cameras: tuple[str, ...],
    ):
        spec = mujoco.MjSpec.from_file(str(ROBOT_FILE))
        task.add_objects(spec)
        self.task, self.control_hz, self.cameras = task, control_hz, cameras
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.arms = ArmKinematics(self.model)
        self.actions = actions(self.arms, control_hz)
        self.condition = HeldCondition(hold, control_hz)
        self.glides = max(1, round(1.0 / (control_hz * GLIDE)))
        self.substeps = max(1, round(1.0 / (control_hz * self.glides * self.model.opt.timestep)))
        self._slides = np.array([[self.model.joint(f"{s}_slide_{t}").qposadr[0] for t in "ab"] for s in ARMS])
        self.start: Start
        self.target: Target

    # -- episode ---------------------------------------------------------------------------------------------
    def reset(self, seed: int) -> None:
        """Lay out the task drawn from `seed`; the same seed gives the same episode, bit for bit."""
        mujoco.mj_resetData(self.model, self.data)
        self.start = self.task.begin(self.model, self.data, np.random.default_rng(seed))
        self.model.geom("table").rgba[:3] = self.start.table_rgb
        poses = np.array([[*tip, TIP_HEIGHT + TOOL_OFFSET, *DOWN, 1.0] for tip in self.start.fingertips])
        joints = self.arms.solve(poses[:, :6], np.stack([HOME, HOME]), iterations=100)
        self.target = Target(joints, poses[:, 6])
        self.actions.begin(self.target, poses)
        self.data.qpos[self.arms.qpos] = joints
        self._set_targets(joints, self.target.grippers)
        mujoco.mj_forward(self.model, self.data)
        self.condition.reset()

    def step(self, action: Array) -> None:
        """Carry out one absolute action [A] for one control period.

        Raises:
            ValueError: if it is not finite or has another shape.
        """
        action = np.asarray(action, dtype=np.float64)
        names = self.actions.names
        if action.shape != (len(names),) or not np.isfinite(action).all():
            raise ValueError(
                f"an action of this bench is {len(names)} finite numbers {list(names)}, got {action}"
            )
        before = self.target
        self.target = after = self.actions.advance(action, before)
        for k in range(self.glides):
            joints = before.joints + (after.joints - before.joints) * (k + 1) / self.glides
            self._set_targets(joints, after.grippers)
            mujoco.mj_step(self.model, self.data, nstep=self.substeps)
        mujoco.mj_forward(self.model, self.data)
        self.condition.update(self.task.satisfied(self.data))

    def _set_targets(self, joints: Array, grippers: Array) -> None:
        for k in range(len(ARMS)):
            self.data.ctrl[k * 9 : k * 9 + 7] = joints[k]
            self.data.ctrl[k * 9 + 7 : k * 9 + 9] = (1.0 - grippers[k]) * FINGER_TRAVEL

    # -- what can be seen and known --------------------------------------------------------------------------
    def state(self) -> Array:
        """Joint state [16]: seven joints in radians and the gripper (1 closed) of left and right arm."""
        grippers = 1.0 - self.data.qpos[self._slides].mean(1) / FINGER_TRAVEL
        return np.concatenate((self.data.qpos[self.arms.qpos], grippers[:, None]), 1).flatten()

    def flanges(self) -> Array:
        """Flange poses [2, 6] that the arms really have, in metres and radians."""
        return self.arms.read(self.data)

    def render(self, size: tuple[int, int], shadows: bool) -> NDArray[np.uint8]:
        """Pictures uint8 [V, 3, H, W]."""
        offscreen = offscreen_for(type(self.task).__name__, self.model, size)
        return offscreen.render(self.model, self.data, self.cameras, shadows)
