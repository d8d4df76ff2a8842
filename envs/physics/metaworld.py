"""Meta-World as a task suite: one Sawyer arm, 50 tasks with scripted experts (Yu et al., CoRL 2019).

The package `metaworld` pins an older MuJoCo than ours but works with ours, so it is installed without its
dependencies; `make setup` does.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.embodiment import ActionKind, Arm, Camera, Embodiment
from envs.physics.render import calibration, offscreen_for
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

# Names that do not read as thing, verb, manner.
_INSTRUCTIONS = {
    "assembly": "put the ring onto the peg",
    "basketball": "put the ball into the basket",
    "bin-picking": "move the puck to the other bin",
    "coffee-button": "press the button of the coffee machine",
    "coffee-pull": "pull the mug away from the coffee machine",
    "coffee-push": "push the mug under the coffee machine",
    "disassemble": "take the ring off the peg",
    "hammer": "hammer the nail into the wall",
    "hand-insert": "put the gripper into the hole",
    "peg-unplug-side": "unplug the peg sideways",
    "pick-out-of-hole": "pick the puck out of the hole",
    "pick-place": "pick up the puck and bring it to the goal",
    "pick-place-wall": "pick up the puck and bring it over the wall to the goal",
    "push": "push the puck to the goal",
    "push-back": "push the puck back to the goal",
    "push-wall": "push the puck around the wall to the goal",
    "reach": "reach the goal",
    "reach-wall": "reach the goal over the wall",
    "shelf-place": "place the block on the shelf",
    "soccer": "kick the ball into the goal",
    "stick-pull": "pull the thermos with the stick",
    "stick-push": "push the thermos with the stick",
    "sweep": "sweep the puck off the table",
    "sweep-into": "sweep the puck into the hole",
}
_MANNERS = {"topdown": "from above", "wall": "behind the wall", "side": "sideways", "back": "back"}


def instruction_of(task: str) -> str:
    """A task's name as words: 'drawer-open-v3' is 'open the drawer'."""
    name = task.rsplit("-v", 1)[0]
    if name in _INSTRUCTIONS:
        return _INSTRUCTIONS[name]
    thing, verb, *manner = name.split("-")
    return " ".join([verb, "the", thing, *(_MANNERS[word] for word in manner)])


class MetaWorld(TaskSuite):
    """Tasks of Meta-World v3 whose start and goal are drawn from the seed.

    Actions are [dx, dy, dz, gripper] in -1..1: 1 moves the hand's target by 1 cm in each of the SIM_HZ steps,
    or closes the gripper. An action is held for a whole frame. The state is what the robot knows of itself:
    the hand's position in metres and the gripper's opening, 0..1.

    Args:
        control_hz: actions and frames per second, a divisor of SIM_HZ.
        hold: seconds that Meta-World's own success condition must hold.
        size: (height, width) of every picture.
        cameras: names out of CAMERAS, in the views' order.
        calibrated: whether intrinsics and camera poses are told.

    Raises:
        SuiteError: if metaworld is not installed, or an option does not fit.
    """

    def __init__(
        self,
        control_hz: Positive,
        hold: NonNegative,
        size: tuple[int, int],
        cameras: tuple[str, ...],
        calibrated: bool,
    ):
        try:
            import metaworld
            from metaworld.policies import ENV_POLICY_MAP
        except ImportError as error:
            raise SuiteError(f"task=metaworld needs more packages ({error}): {INSTALL}") from error
        warnings.filterwarnings("ignore", "Constant.s. may be too high")  # its experts' saturated actions
        if SIM_HZ % control_hz:
            raise SuiteError(
                f"task.suite.control_hz={control_hz} must divide {SIM_HZ}: 5, 8, 10, 16, 20, 40 or 80"
            )
        check_cameras(cameras, CAMERAS)
        self._classes: dict[str, Any] = metaworld.ALL_V3_ENVIRONMENTS
        self._experts: dict[str, Any] = ENV_POLICY_MAP
        self.tasks = tuple(sorted(set(self._classes) & set(self._experts)))
        self.size, self.substeps = size, round(SIM_HZ / control_hz)
        self.condition = HeldCondition(hold, control_hz)
        self._envs: dict[str, Any] = {}
        self._views = tuple(SCENE[1] if name == SCENE[0] else name for name in cameras)
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
            self._envs[task] = _open(self._classes[task])
        self._task, self._env = task, self._envs[task]
        self._env.seed(seed)
        self._env.reset()
        # It lays things out after it has last worked out where everything is: pictures would show them, and
        # its observation tell them, where they lay the time before.
        mujoco.mj_forward(self._env.model, self._env.data)
        self._env._get_obs()  # becomes the observation before
        self._sight = self._env._get_obs()
        self.command = np.zeros(4)
        self._reward, self._info = self._env.evaluate_state(self._sight, self.command)
        self.condition.reset()

    def step(self, action: Array) -> None:
        """Hold one action [4] for a frame; what exceeds -1..1 is cut.

        Raises:
            ValueError: if it is not finite or has another shape.
        """
        action = checked_action(action, self.embodiment.action_names)
        self.command = np.clip(action, -1.0, 1.0)
        for _ in range(self.substeps):
            self._sight, self._reward, _, _, self._info = self._env.step(self.command)
        self.condition.update(self._satisfied())

    def render(self) -> NDArray[np.uint8]:
        """Pictures uint8 [V, 3, H, W] without shadows and reflections."""
        return self._render(self.size, False)

    def picture(self, size: tuple[int, int]) -> NDArray[np.uint8]:
        """Pictures with shadows, of any size."""
        return self._render(size, True)

    def segment(self) -> NDArray[np.uint8]:
        """See TaskSuite.segment."""
        offscreen = offscreen_for(self._task, self._env.model, self.size)
        return offscreen.segment(self._env.model, self._env.data, self._views)

    def observe(self) -> Observation:
        """Hand, gripper, and how the task stands; progress is a tenth of Meta-World's shaped reward."""
        intrinsic, c2w = None, None
        if self.embodiment.calibrated:
            intrinsic, c2w = calibration(self._env.model, self._env.data, self._views, self.size)
        return Observation(
            state=self._sight[:4].copy(),
            command=self.command.copy(),
            instruction=instruction_of(self._task),
            success=self.condition.success,
            progress=1.0 if self._satisfied() else float(np.clip(self._reward / 10.0, 0.0, 1.0)),
            intrinsic=intrinsic,
            c2w=c2w,
        )

    def privileged(self) -> dict[str, Array]:
        """Meta-World's full observation less what the robot knows: object_poses [2, 7] (metres and
        quaternion, zeros where there is no second), and goal [3] in metres.
        """
        return {"object_poses": self._sight[4:18].reshape(2, 7).copy(), "goal": self._sight[36:39].copy()}

    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        """Meta-World's scripted policy of the task, bent by noise; see NoisyPolicy."""
        policy = self._experts[self._task]()
        return NoisyPolicy(
            policy.get_action, lambda: self._sight.copy(), noise_level, rng, 1 / self.embodiment.fps
        )

    def _satisfied(self) -> bool:
        return bool(self._info["success"])

    def _render(self, size: tuple[int, int], shadows: bool) -> NDArray[np.uint8]:
        offscreen = offscreen_for(self._task, self._env.model, size)
        return offscreen.render(self._env.model, self._env.data, self._views, shadows)


class NoisyPolicy:
    """A scripted policy that is bent towards chance, whatever its task.

    Noise moves where things and goal are believed to be, adds a slowly varying offset to the motion, and
    interrupts the policy by random way-points about the thing; at 1 nothing else is left.

    Args:
        policy: full observation [39] -> action [4].
        sight: () -> the full observation now.
        noise_level: 0 is the policy itself, 1 pays no heed to the task.
        rng: of the noise.
        period: seconds between two calls.

    Raises:
        ValueError: if the noise level lies outside [0, 1].
    """

    def __init__(
        self,
        policy: Callable[[Array], Array],
        sight: Callable[[], Array],
        noise_level: float,
        rng: np.random.Generator,
        period: float,
    ):
        check_noise_level(noise_level)
        self.policy, self.sight, self.noise_level, self.rng = policy, sight, noise_level, rng
        self.keep = 0.8 ** (period / 0.1)
        self.start = 0.1 * noise_level**2 * period / 0.1  # chance that a way-point interrupts, per action
        self.frames = max(1, round(1.0 / period))  # of one way-point
        self.drift = np.zeros(3)
        self.object_bias, self.goal_bias = rng.normal(0.0, 0.03 * noise_level, (2, 3))
        self.left, self.waypoint, self.grip = 0, np.zeros(3), 0.0

    def __call__(self) -> Array:
        """The next action [4] in -1..1."""
        seen = self.sight()
        if self.left == 0 and (self.noise_level >= 1.0 or self.rng.random() < self.start):
            self.left = self.frames
            self.waypoint = seen[4:7] + self.rng.normal(0.0, 0.1, 3)
            self.grip = float(self.rng.choice((-1.0, 1.0)))
        if self.left:
            self.left -= 1
            action = np.append(10.0 * (self.waypoint - seen[:3]), self.grip)
        else:
            seen[4:7] += self.object_bias
            seen[36:39] += self.goal_bias
            action = np.asarray(self.policy(seen), dtype=np.float64)
        scale = 0.3 * self.noise_level * np.sqrt(1 - self.keep**2)
        self.drift = self.keep * self.drift + self.rng.normal(0.0, scale, 3)
        action = np.clip(action, -1.0, 1.0)
        action[:3] += self.drift
        return np.clip(action, -1.0, 1.0)


def _open(factory: Any) -> Any:
    """One of Meta-World's environments, whose starts come from its seed and whose goal experts can see."""
    env = factory()
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
