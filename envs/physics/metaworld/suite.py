"""Meta-World as a task suite: one Sawyer arm, 50 tasks with scripted experts (Yu et al., CoRL 2019).

The package `metaworld` pins an older MuJoCo than ours but works with ours, so it is installed without its
dependencies; `make setup` does.
"""

from __future__ import annotations

import sys
import warnings
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from envs.embodiment import ActionKind, Arm, Camera, Embodiment
from envs.physics.metaworld.held_policy import HeldPolicy
from envs.physics.metaworld.noisy_policy import NoisyPolicy
from envs.physics.metaworld.words import instruction_of
from envs.physics.mujoco_suite import MujocoSuite, World, steps_per_frame
from envs.physics.starts import STARTS, belongs, check_starts
from envs.physics.suite import (
    Array,
    Expert,
    HeldCondition,
    Observation,
    SuiteError,
    check_cameras,
    check_task,
    checked_action,
)
from envs.ranges import NonNegative, Positive

SIM_HZ = 80.0  # at which Meta-World's own step takes actions
STRIDE = 0.01  # m the hand's target moves in one such step by an action of 1
# Our own view, from over the robot's right shoulder, tight enough for pictures of 64 pixels and the right way
# up, which Meta-World's corner views are not. It takes the place of the model's camera "corner".
SCENE = ("scene", "corner", (0.72, 0.10, 0.72), (0.0, 0.70, 0.10), 45.0)  # and eye, point looked at, fovy
CAMERAS = {
    "scene": None,
    "corner2": None,
    "corner3": None,
    "corner4": None,
    "topview": None,
    "gripperPOV": "arm",
    "behindGripper": "arm",
}
INSTALL = (
    "python -m pip install 'gymnasium==1.4.0' imageio && python -m pip install --no-deps metaworld==3.1.1"
)


class MetaWorld(MujocoSuite):
    """Tasks of Meta-World v3 whose start and goal are drawn from the seed.

    Actions are [dx, dy, dz, gripper] in -1..1: 1 moves the hand's target by 1 cm in each of the SIM_HZ steps,
    or closes the gripper. An action is held for a whole frame. The state is what the robot knows of itself:
    the hand's position in metres and the gripper's opening, 0..1.

    Args:
        control_hz: actions and frames per second, a divisor of SIM_HZ.
        hold: seconds for which Meta-World's own success condition must be met in every frame; 0 is its own
            rule, success at any of its steps. A button springs back: where nothing can hold, ask for nothing.
        size: (height, width) of every picture.
        cameras: names out of CAMERAS, in the views' order.
        calibrated: whether intrinsics and camera poses are told.
        starts: which of those drawn: all, inner, or outer, unseen where inner ones are learned from; see
            starts.belongs.

    Raises:
        SuiteError: if metaworld is not installed, or an option does not fit.
    """

    offers = MappingProxyType({"cameras": tuple(CAMERAS), "starts": STARTS})

    def __init__(
        self,
        control_hz: Positive,
        hold: NonNegative,
        size: tuple[int, int],
        cameras: tuple[str, ...],
        calibrated: bool,
        starts: str,
    ):
        try:
            import metaworld
            from metaworld.policies import ENV_POLICY_MAP
        except ImportError as error:
            raise SuiteError(f"task=metaworld needs more packages ({error}): {INSTALL}") from error
        warnings.filterwarnings("ignore", "Constant.s. may be too high")  # its experts' saturated actions
        check_cameras(cameras, CAMERAS)
        check_starts(starts)
        super().__init__(size, tuple(SCENE[1] if name == SCENE[0] else name for name in cameras))
        self._classes: dict[str, Any] = metaworld.ALL_V3_ENVIRONMENTS
        self._experts: dict[str, Any] = ENV_POLICY_MAP
        self.tasks = tuple(sorted(set(self._classes) & set(self._experts)))
        self.substeps = steps_per_frame(control_hz, SIM_HZ)
        self.condition = HeldCondition(hold, control_hz)
        self._envs: dict[str, Any] = {}
        self._starts = starts
        self._task = ""
        names = ("x", "y", "z", "gripper")
        self.embodiment = Embodiment(
            robot="sawyer",
            action_names=("delta_x", "delta_y", "delta_z", "gripper"),
            action_kind=ActionKind.END_EFFECTOR,
            delta=True,
            arms=(Arm("arm", (0, 1, 2), 3, (-1.0, 1.0)),),
            state_names=names,
            cameras=tuple(Camera(name, size, CAMERAS[name], calibrated) for name in cameras),
            fps=control_hz,
        )

    def reset(self, task: str, seed: int) -> None:
        """Draw object and goal of `task` from `seed`."""
        if task not in self._envs:
            check_task(task, self.tasks)
            self._envs[task] = _open(self._classes[task], self._starts)
        self._task, self._env = task, self._envs[task]
        self._env.seed(seed)
        self._env.reset()
        # It lays things out after it has last worked out where everything is: pictures would show them, and
        # its observation tell them, where they lay the time before.
        mujoco.mj_forward(self._env.model, self._env.data)
        self._env._get_obs()  # becomes the observation before
        self._sight = self._env._get_obs()
        self.command = np.zeros(4)
        self._reward, info = self._env.evaluate_state(self._sight, self.command)
        self._satisfied = bool(info["success"])
        self.condition.reset()

    def carry_out(self, action: Array) -> None:
        """Hold one action [4] for a frame; what exceeds -1..1 is cut.

        Raises:
            ValueError: if it is not finite or has another shape.
        """
        action = checked_action(action, self.embodiment.action_names)
        self.command = np.clip(action, -1.0, 1.0)
        self._satisfied = False
        for _ in range(self.substeps):
            self._sight, self._reward, _, _, info = self._env.step(self.command)
            self._satisfied |= bool(info["success"])
        self.condition.update(self._satisfied)

    def world(self) -> World:
        """See MujocoSuite."""
        return World(self._task, self._env.model, self._env.data)

    def observe(self) -> Observation:
        """Hand, gripper, and how the task stands; progress is a tenth of Meta-World's shaped reward."""
        intrinsic, c2w = self.calibration()
        return Observation(
            state=self._sight[:4].copy(),
            command=self.command.copy(),
            instruction=instruction_of(self._task),
            success=self.condition.success,
            progress=1.0 if self._satisfied else float(np.clip(self._reward / 10.0, 0.0, 1.0)),
            intrinsic=intrinsic,
            c2w=c2w,
        )

    def privileged(self) -> dict[str, Array]:
        """Meta-World's full observation less what the robot knows: object_poses [2, 7] (metres and
        quaternion, zeros where there is no second), and goal [3] in metres.
        """
        return {"object_poses": self._sight[4:18].reshape(2, 7).copy(), "goal": self._sight[36:39].copy()}

    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        """Meta-World's scripted policy of the task, bent by noise; see HeldPolicy, NoisyPolicy."""
        policy, hold = self._experts[self._task](), HeldPolicy(self._env, self.substeps)
        return NoisyPolicy(
            policy.get_action, lambda: self._sight.copy(), hold, noise_level, rng, 1 / self.embodiment.fps
        )


def _open(factory: Any, starts: str) -> Any:
    """One of Meta-World's environments, whose starts come from its seed and whose goal experts can see."""
    env = factory()
    draw = env._get_state_rand_vec

    def chosen() -> Array:
        space, drawn = env._random_reset_space, draw()
        while not belongs(starts, drawn, space.low, space.high):
            drawn = draw()
        return drawn

    env._get_state_rand_vec = chosen
    env._partially_observable = False
    vars(env).pop(
        "sawyer_observation_space", None
    )  # cached, and it clips goals to zero while they are hidden
    env._freeze_rand_vec, env.seeded_rand_vec, env._set_task_called = False, True, True
    env.max_path_length = sys.maxsize  # horizons are ours
    env.model.vis.quality.offsamples = 0
    _, name, eye, point, fovy = SCENE
    _aim(env.model.camera(name), np.array(eye), np.array(point), fovy)
    return env


def _aim(camera: Any, eye: Array, point: Array, fovy: float) -> None:
    """Let a camera of the model look from one point to another, upright."""
    back = (eye - point) / np.linalg.norm(eye - point)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    turn = np.stack((right, np.cross(back, right), back), 1)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, turn.flatten())
    camera.pos[:], camera.quat[:], camera.fovy[:] = eye, quat, fovy
