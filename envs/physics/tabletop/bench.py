"""The two arms in one MuJoCo world at a time: carry out actions, say how the goal stands."""

from __future__ import annotations

from abc import ABC, abstractmethod

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.physics.mujoco_suite import steps_per_frame
from envs.physics.suite import HeldCondition, checked_action
from envs.physics.tabletop.actions import ActionInterface, Target
from envs.physics.tabletop.arms import ArmKinematics
from envs.physics.tabletop.scene import ARMS, FINGER_TRAVEL, HOME

Array = NDArray[np.float64]
GLIDE = 0.025  # s between joint targets: arms glide instead of jerking at the control rate


class Goal(ABC):
    """What an episode asks for."""

    @abstractmethod
    def satisfied(self, data: mujoco.MjData) -> bool:
        """Whether the task's condition is met at this moment."""

    @abstractmethod
    def progress(self, data: mujoco.MjData) -> float:
        """True progress in 0..1."""

    @abstractmethod
    def object_poses(self, data: mujoco.MjData) -> Array:
        """True poses [objects, 4] = [x, y, z, heading] of what the task is about, in metres and radians."""


class Bench:
    """The true world for one episode at a time; states and commands are float64.

    Args:
        actions: class of its commands.
        control_hz: actions and frames per second.
        hold: seconds an episode's condition must hold.
    """

    goal: Goal
    target: Target
    model: mujoco.MjModel
    data: mujoco.MjData

    def __init__(self, actions: type[ActionInterface], control_hz: float, hold: float):
        self.control_hz = control_hz
        self.arms = ArmKinematics()
        self.actions = actions(self.arms, control_hz)
        self.condition = HeldCondition(hold, control_hz)
        robot = self.arms.model
        steps = steps_per_frame(control_hz, round(1.0 / robot.opt.timestep, 6))
        wanted = 1.0 / (control_hz * GLIDE)
        self.glides = min((n for n in range(1, steps + 1) if steps % n == 0), key=lambda n: abs(n - wanted))
        self.substeps = steps // self.glides
        self._slides = np.array([[robot.joint(f"{s}_slide_{t}").qposadr[0] for t in "ab"] for s in ARMS])

    # -- episode ---------------------------------------------------------------------------------------------
    def begin(self, model: mujoco.MjModel, data: mujoco.MjData, goal: Goal, poses: Array) -> None:
        """Take over a world whose things lie where they should.

        Args:
            model: made from the robot's file by adding things to it.
            data: of the model.
            goal: of the episode.
            poses: [2, 7] flange poses and grippers that the arms start at.
        """
        self.model, self.data, self.goal = model, data, goal
        joints = self.arms.solve(poses[:, :6], np.stack([HOME, HOME]), iterations=100)
        self.target = Target(joints, poses[:, 6])
        self.actions.begin(self.target, poses)
        data.qpos[self.arms.qpos] = joints
        self._set_targets(joints, self.target.grippers)
        mujoco.mj_forward(model, data)
        self.condition.reset()

    def step(self, action: Array) -> None:
        """Carry out one absolute action [A] for one control period.

        Raises:
            ValueError: if it is not finite or has another shape.
        """
        action = checked_action(action, self.actions.names)
        before = self.target
        self.target = after = self.actions.advance(action, before)
        for k in range(self.glides):
            joints = before.joints + (after.joints - before.joints) * (k + 1) / self.glides
            self._set_targets(joints, after.grippers)
            mujoco.mj_step(self.model, self.data, nstep=self.substeps)
        mujoco.mj_forward(self.model, self.data)
        self.condition.update(self.goal.satisfied(self.data))

    def _set_targets(self, joints: Array, grippers: Array) -> None:
        for k in range(len(ARMS)):
            self.data.ctrl[k * 9 : k * 9 + 7] = joints[k]
            self.data.ctrl[k * 9 + 7 : k * 9 + 9] = (1.0 - grippers[k]) * FINGER_TRAVEL

    # -- what is known --------------------------------------------------------------------------------------
    def state(self) -> Array:
        """Joint state [16]: seven joints in radians and the gripper (1 closed) of left and right arm."""
        grippers = 1.0 - self.data.qpos[self._slides].mean(1) / FINGER_TRAVEL
        return np.concatenate((self.data.qpos[self.arms.qpos], grippers[:, None]), 1).flatten()

    def flanges(self) -> Array:
        """Flange poses [2, 6] that the arms really have, in metres and radians."""
        return self.arms.read(self.data)
