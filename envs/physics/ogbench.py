"""OGBench's manipulation as a task suite: a UR5e with cubes, a drawer, a window, buttons (Park et al., 2025).

Scenes and targets are drawn as the package does to collect data; of its targets those are taken that belong
to the task. It is installed without its dependencies, of which only dm_control's model files are needed.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from envs.embodiment import ActionKind, Arm, Camera, Embodiment
from envs.physics.mujoco_suite import MujocoSuite, World, steps_per_frame
from envs.physics.noisy_oracle import NoisyOracle
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

SIM_HZ = 20.0  # at which OGBench's own step takes actions
CAMERAS = ("front", "front_pixels")
COLOURS = ("red", "blue")
# Scene of each task, and the kind of its target there.
TASKS = {
    "cube-single": ("single", "cube"),
    "cube-double": ("double", "cube"),
    "scene-cube": ("scene", "cube"),
    "scene-drawer": ("scene", "drawer"),
    "scene-window": ("scene", "window"),
    "scene-button": ("scene", "button"),
}
SLIDES = {"drawer_slide": (-0.16, 0.0), "window_slide": (0.0, 0.2)}  # m, between which OGBench draws them
_MARK = 0.4  # opacity of the mark where a cube shall go
_OVER = 0.05  # m by which a cube's target must lie higher to be on top of another
INSTALL = (
    "python -m pip install gymnasium==1.4.0 dm-env==1.6 dm-tree==0.1.10 lxml==6.1.3 && "
    "python -m pip install --no-deps dm_control==1.0.41 ogbench==1.2.2"
)


class OGBench(MujocoSuite):
    """Tasks of OGBench's cube and scene environments whose start and target are drawn from the seed.

    Actions are [dx, dy, dz, dyaw, gripper] in -1..1: 1 moves the target of the hand 5 cm or 0.3 rad from
    where it is, or closes the gripper, in each of the SIM_HZ steps; an action is held for a whole frame. The
    state is the hand's position in metres, cosine and sine of its yaw, and how far the gripper is closed,
    0..1.

    Args:
        control_hz: actions and frames per second, a divisor of SIM_HZ.
        hold: seconds for which OGBench's own success condition must be met in every frame; 0 is its own rule,
            success at any of its steps.
        size: (height, width) of every picture.
        cameras: names out of CAMERAS, in the views' order.
        calibrated: whether intrinsics and camera poses are told.
        starts: which of those drawn, by where cubes lie and how far drawer and window are open: all, inner,
            or outer, unseen where inner ones are learned from; see starts.belongs.

    Raises:
        SuiteError: if ogbench is not installed, or an option does not fit.
    """

    tasks = tuple(TASKS)
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
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # dm_control looks for a screen, which nothing here needs
                self._open, self._oracles = _package()
        except ImportError as error:
            raise SuiteError(f"task=ogbench needs more packages ({error}): {INSTALL}") from error
        check_cameras(cameras, CAMERAS)
        check_starts(starts)
        super().__init__(size, cameras)
        self._starts = starts
        self.substeps = steps_per_frame(control_hz, SIM_HZ)
        self.condition = HeldCondition(hold, control_hz)
        self._envs: dict[str, Any] = {}
        self.embodiment = Embodiment(
            robot="ur5e",
            action_names=("delta_x", "delta_y", "delta_z", "delta_yaw", "gripper"),
            action_kind=ActionKind.END_EFFECTOR,
            delta=True,
            arms=(Arm("arm", (0, 1, 2, 3), 4, (-1.0, 1.0)),),
            state_names=("x", "y", "z", "cos_yaw", "sin_yaw", "closed"),
            cameras=tuple(Camera(name, size, None, calibrated) for name in cameras),
            fps=control_hz,
        )

    def reset(self, task: str, seed: int) -> None:
        """Draw things and target of `task` from `seed`; a drawer or window that is meant is unlocked."""
        check_task(task, self.tasks)
        self._scene, self._kind = TASKS[task]
        if self._scene not in self._envs:
            self._envs[self._scene] = self._open[self._scene]()
        self._env = env = self._envs[self._scene]
        env.reset(seed=seed)
        while not belongs(self._starts, *_drawn(env, self._scene)):
            env.reset()  # goes on with what the seed began
        env._model.vis.quality.offsamples = 0
        if self._kind in ("drawer", "window"):
            env._cur_button_states[:] = 1
            env._apply_button_states()
        while getattr(env, "_target_task", "cube") != self._kind or self._met():
            env.set_new_target(return_info=False)
        self.command = np.zeros(5)
        self._see()
        self._start = self._distance()
        self.condition.reset()
        self._satisfied = False

    def carry_out(self, action: Array) -> None:
        """Hold one action [5] for a frame; what exceeds -1..1 is cut.

        Raises:
            ValueError: if it is not finite or has another shape.
        """
        action = checked_action(action, self.embodiment.action_names)
        self.command = np.clip(action, -1.0, 1.0)
        self._satisfied = False
        for _ in range(self.substeps):
            self._env.step(self.command)
            self._satisfied |= bool(self._env._success)
        self._see()
        self.condition.update(self._satisfied)

    def world(self) -> World:
        """See MujocoSuite."""
        return World(f"ogbench/{self._scene}", self._env._model, self._env._data)

    def observe(self) -> Observation:
        """Hand, gripper, and how the task stands; progress is the share of the target's distance made up."""
        intrinsic, c2w = self.calibration()
        seen = self._seen
        yaw = float(seen["proprio/effector_yaw"][0])
        state = (*seen["proprio/effector_pos"], np.cos(yaw), np.sin(yaw), *seen["proprio/gripper_opening"])
        left = self._distance() / self._start
        return Observation(
            state=np.array(state),
            command=self.command.copy(),
            instruction=self._instruction(),
            success=self.condition.success,
            progress=1.0 if self._satisfied else float(np.clip(1.0 - left, 0.0, 0.99)),
            intrinsic=intrinsic,
            c2w=c2w,
        )

    def privileged(self) -> dict[str, Array]:
        """object_poses [2, 7]: metres and quaternion of up to two cubes, zeros where there is no second; goal
        [3] in metres, of the cube, handle or button that is meant.
        """
        seen, poses = self._seen, np.zeros((2, 7))
        for k in range(self._env._num_cubes):
            block = (seen[f"privileged/block_{k}_pos"], seen[f"privileged/block_{k}_quat"])
            poses[k] = np.concatenate(block)
        return {"object_poses": poses, "goal": np.array(self._places()[1])}

    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        """OGBench's closed-loop oracle of the target's kind, bent by noise; see NoisyOracle."""
        oracle = self._oracles[self._kind](env=self._env)
        oracle.reset(None, self._seen)
        low, high = self._env._arm_sampling_bounds
        oracle._final_pos, oracle._final_yaw = rng.uniform(low, high), rng.uniform(-np.pi, np.pi)
        return NoisyOracle(
            lambda: oracle.select_action(None, self._seen),
            lambda: rng.uniform(low, high) - self._seen["proprio/effector_pos"],
            noise_level,
            rng,
            1 / self.embodiment.fps,
        )

    def _met(self) -> bool:
        """Whether the target is met as things stand."""
        self._env.pre_step()
        self._env.post_step()
        return bool(self._env._success)

    def _see(self) -> None:
        """Take down how things stand, and show where the cube that is meant shall go."""
        env = self._env
        mujoco.mj_kinematics(env._model, env._data)
        self._seen: dict[str, Any] = env.compute_ob_info()
        for k, geoms in enumerate(env._cube_target_geom_ids_list):
            shown = self._kind == "cube" and k == env._target_block
            env._model.geom_rgba[geoms, 3] = _MARK * shown

    def _places(self) -> tuple[Array, Array]:
        """Where the thing that is meant is, and where it shall be, in metres."""
        seen, kind = self._seen, self._kind
        if kind == "cube":
            return seen[f"privileged/block_{self._env._target_block}_pos"], seen[
                "privileged/target_block_pos"
            ]
        if kind == "button":  # the hand must come to it
            return seen["proprio/effector_pos"], seen["privileged/target_button_top_pos"]
        return seen[f"privileged/{kind}_handle_pos"], seen[f"privileged/target_{kind}_handle_pos"]

    def _distance(self) -> float:
        here, there = self._places()
        return max(1e-6, float(np.linalg.norm(np.subtract(here, there))))

    def _instruction(self) -> str:
        env = self._env
        if self._kind == "cube":
            colour = COLOURS[env._target_block]
            if self._places()[1][2] > _OVER:
                return f"put the {colour} cube on the {COLOURS[1 - env._target_block]} cube"
            return f"move the {colour} cube to its mark"
        if self._kind == "button":
            return f"press the {('left', 'right')[env._target_button]} button"
        opened = {"drawer": env._target_drawer_pos < -0.08, "window": env._target_window_pos > 0.1}
        return f"{'open' if opened[self._kind] else 'close'} the {self._kind}"


def _drawn(env: Any, scene: str) -> tuple[Array, Array, Array]:
    """Where cubes lie and how far drawer and window are open, in metres [n], and between what it is drawn."""
    slides = SLIDES if scene == "scene" else {}
    places = [env._data.joint(f"object_joint_{k}").qpos[:2] for k in range(env._num_cubes)]
    drawn = np.concatenate([*places, *(env._data.joint(name).qpos for name in slides)])
    low, high = (
        np.concatenate([np.tile(bound, len(places)), [ends[end] for ends in slides.values()]])
        for end, bound in enumerate(env._object_sampling_bounds)
    )
    return drawn, low, high


def _package() -> tuple[dict[str, Callable[[], Any]], dict[str, Any]]:
    """What opens each scene, and the oracle of each kind of target."""
    from ogbench.manipspace.envs.cube_env import CubeEnv
    from ogbench.manipspace.envs.scene_env import SceneEnv
    from ogbench.manipspace.oracles.markov.button_markov import ButtonMarkovOracle
    from ogbench.manipspace.oracles.markov.cube_markov import CubeMarkovOracle
    from ogbench.manipspace.oracles.markov.drawer_markov import DrawerMarkovOracle
    from ogbench.manipspace.oracles.markov.window_markov import WindowMarkovOracle

    # Without `visualize_info` cubes do not change their colour when they arrive, which would be telling.
    how = {"mode": "data_collection", "terminate_at_goal": False, "visualize_info": False}
    scenes = {
        "single": lambda: CubeEnv("single", **how),
        "double": lambda: CubeEnv("double", **how),
        "scene": lambda: SceneEnv("scene", **how),
    }
    oracles = {
        "cube": CubeMarkovOracle,
        "drawer": DrawerMarkovOracle,
        "window": WindowMarkovOracle,
        "button": ButtonMarkovOracle,
    }
    return scenes, oracles
