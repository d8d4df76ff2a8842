"""gym-aloha as a task suite: two ViperX arms moved by joint commands, as in ACT (Zhao et al., RSS 2023).

The tasks, their models and their rewards are the package's own; the pictures are rendered here, because its
environment renders three of 480 x 640 pixels at every step. It asks for packages that nothing here needs, so
it is installed without its dependencies; `make setup` does.
"""

from __future__ import annotations

import importlib
import warnings
from types import MappingProxyType
from typing import Any

import numpy as np

from envs.embodiment import ActionKind, Arm, Camera, Embodiment
from envs.physics.aloha.arms import JOINTS, SIDES, ArmKinematics, Array, Hands
from envs.physics.aloha.cameras import CAMERAS, load_model, wrist_of
from envs.physics.aloha.experts import NoisyScript
from envs.physics.aloha.scripts import Insertion, Script, TransferCube
from envs.physics.mujoco_suite import MujocoSuite, World, steps_per_frame
from envs.physics.starts import STARTS, belongs, check_starts
from envs.physics.suite import (
    Expert,
    HeldCondition,
    Observation,
    SuiteError,
    check_cameras,
    check_task,
    checked_action,
)
from envs.ranges import NonNegative, Positive
from envs.rng import Stream, episode_rng

SIM_HZ = 50.0  # at which gym-aloha's own step takes actions
MAX_SPEED = 4.0  # rad/s that a command may change by; much faster ones make the simulation unstable
MAX_REWARD = 4  # of its rewards, which is success
_INSTRUCTIONS = {
    "transfer_cube": "pick up the red cube with the right arm and hand it to the left arm",
    "insertion": "pick up the red peg and the blue socket and insert the peg into the socket",
}
_SCRIPTS: dict[str, type[Script]] = {"transfer_cube": TransferCube, "insertion": Insertion}
# Low and high x, y in metres of the cube, or of the peg and the socket, where gym-aloha draws them.
_GROUND = {
    "transfer_cube": np.array([(0.0, 0.4), (0.2, 0.6)]),
    "insertion": np.array([(0.1, 0.4, -0.2, 0.4), (0.2, 0.6, -0.1, 0.6)]),
}
INSTALL = (
    "python -m pip install gymnasium==1.4.0 dm-env==1.6 dm-tree==0.1.10 lxml==6.1.3 && "
    "python -m pip install --no-deps dm_control==1.0.41 gym-aloha==0.1.5"
)


class Aloha(MujocoSuite):
    """gym-aloha's cube transfer and insertion, laid out as its environment does for the same seed.

    Actions are 14 absolute joint commands: for the left, then the right arm six joints in radians and the
    gripper, 0 closed to 1 open. Within a frame the command in force goes over into the next in a straight
    line. The state is the 14 joints as they are, in the same order and units.

    Args:
        control_hz: actions and frames per second, a divisor of SIM_HZ.
        hold: seconds for which a task's full reward must be met in every frame; 0 is gym-aloha's own rule,
            success at any of its steps.
        size: (height, width) of every picture.
        cameras: names out of cameras.CAMERAS, in the views' order.
        calibrated: whether intrinsics and camera poses are told.
        starts: which of those drawn: all, inner, or outer, unseen where inner ones are learned from; see
            starts.belongs.

    Raises:
        SuiteError: if gym-aloha is not installed, or an option does not fit.
    """

    tasks = tuple(_INSTRUCTIONS)
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
                importlib.import_module("gym_aloha.tasks.sim")
        except ImportError as error:
            raise SuiteError(f"task=aloha needs more packages ({error}): {INSTALL}") from error
        check_cameras(cameras, CAMERAS)
        check_starts(starts)
        super().__init__(size, tuple(CAMERAS[name] for name in cameras))
        self.substeps = steps_per_frame(control_hz, SIM_HZ)
        self.condition = HeldCondition(hold, control_hz)
        self._benches: dict[str, _Bench] = {}
        self._starts = starts
        names = tuple(f"{side}_{part}" for side in SIDES for part in (*JOINTS, "gripper"))
        self.embodiment = Embodiment(
            robot="aloha",
            action_names=names,
            action_kind=ActionKind.JOINTS,
            delta=False,
            arms=tuple(
                Arm(side, tuple(range(7 * k, 7 * k + 6)), 7 * k + 6, (1.0, 0.0))
                for k, side in enumerate(SIDES)
            ),
            state_names=names,
            cameras=tuple(Camera(name, size, wrist_of(name), calibrated) for name in cameras),
            fps=control_hz,
        )

    def reset(self, task: str, seed: int) -> None:
        """Draw the places of cube, or peg and socket, from `seed`."""
        if task not in self._benches:
            check_task(task, self.tasks)
            self._benches[task] = _Bench(task, self._starts)
        self._task, self._bench = task, self._benches[task]
        self._bench.reset(seed)
        self.condition.reset()

    def carry_out(self, action: Array) -> None:
        """Go over to one command [14] in the course of a frame; what exceeds the joints' limits or speed is
        cut.

        Raises:
            ValueError: if it is not finite or has another shape.
        """
        action = checked_action(action, self.embodiment.action_names)
        self._bench.step(action, self.substeps)
        self.condition.update(self._bench.satisfied)

    def world(self) -> World:
        """See MujocoSuite."""
        return World(f"aloha/{self._task}", self._bench.model, self._bench.data)

    def observe(self) -> Observation:
        """Joints, and how the task stands; progress is a quarter of gym-aloha's reward of 0 to 4."""
        bench = self._bench
        intrinsic, c2w = self.calibration()
        return Observation(
            state=bench.state(),
            command=bench.command.copy(),
            instruction=_INSTRUCTIONS[self._task],
            success=self.condition.success,
            progress=1.0 if bench.satisfied else bench.reward / MAX_REWARD,
            intrinsic=intrinsic,
            c2w=c2w,
        )

    def privileged(self) -> dict[str, Array]:
        """object_poses [2, 7]: metres and quaternion of the cube, then zeros, or of peg and socket."""
        poses = self._bench.objects()
        return {"object_poses": np.pad(poses, ((0, 2 - len(poses)), (0, 0)))}

    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        """The task's script for both hands, bent by noise; see NoisyScript."""
        bench = self._bench
        script, period = _SCRIPTS[self._task](), 1 / self.embodiment.fps
        return NoisyScript(script, bench.arms, bench.look, bench.command, noise_level, rng, period)


class _Bench:
    """One of gym-aloha's tasks in dm_control's physics."""

    def __init__(self, task: str, starts: str):
        from dm_control import mujoco
        from gym_aloha import utils
        from gym_aloha.constants import ASSETS_DIR
        from gym_aloha.tasks import sim

        self._sim = sim
        self._draw: Any = {
            "transfer_cube": utils.sample_box_pose,
            "insertion": lambda seed: np.concatenate(utils.sample_insertion_pose(seed)),
        }[task]
        self._starts, self._ground = starts, _GROUND[task]
        self._task: Any = {"transfer_cube": sim.TransferCubeTask, "insertion": sim.InsertionTask}[task]()
        self.model = load_model(str(ASSETS_DIR / f"bimanual_viperx_{task}.xml"))
        self._physics = mujoco.Physics.from_model(mujoco.wrapper.MjModel(self.model))
        self.data = self._physics.data.ptr
        self._substeps = round(1 / SIM_HZ / self.model.opt.timestep)
        self.arms = ArmKinematics(self.model)
        self._low = np.concatenate((self.arms.low, [[0.0], [0.0]]), 1).flatten()
        self._high = np.concatenate((self.arms.high, [[1.0], [1.0]]), 1).flatten()

        self._speed = np.tile([MAX_SPEED] * len(JOINTS) + [np.inf], 2)

    def reset(self, seed: int) -> None:
        """Lay out the episode that gym-aloha draws from a seed, of which it takes 32 bits; where its start is
        not one of those chosen, from further ones.
        """
        poses, rng = self._draw(seed % 2**32), episode_rng(seed, Stream.START)
        while not belongs(self._starts, poses.reshape(-1, 7)[:, :2].flatten(), *self._ground):
            poses = self._draw(int(rng.integers(2**32)))
        self._sim.BOX_POSE[0] = poses
        self._task.initialize_episode(self._physics)
        self.command = self.state()
        self.reward = self._task.get_reward(self._physics)
        self.satisfied = False

    def step(self, action: Array, periods: int) -> None:
        """Go over to a command [14] within a number of gym-aloha's control periods."""
        before = self.command
        stride = self._speed * periods / SIM_HZ
        goal = np.clip(action, self._low, self._high)
        self.command = np.clip(goal, before - stride, before + stride)
        self.satisfied = False
        # MujocoSuite.step reads MuJoCo's warnings after the frame; dm_control would raise its own error, of
        # one that physics outlives (a full buffer of contacts) as well
        with self._physics.suppress_physics_errors():
            for k in range(1, periods + 1):
                self._task.before_step(before + (self.command - before) * (k / periods), self._physics)
                self._physics.step(self._substeps)
                self.reward = self._task.get_reward(self._physics)
                self.satisfied |= self.reward == MAX_REWARD

    def state(self) -> Array:
        """The joints [14] as they are, in the units of actions."""
        joints: Array = self._task.get_qpos(self._physics)
        return joints

    def objects(self) -> Array:
        """Position and quaternion of each thing [n, 7]."""
        poses: Array = self._task.get_env_state(self._physics)
        return poses.reshape(-1, 7)

    def look(self) -> tuple[Array, Hands]:
        """Things and hands as they are."""
        return self.objects(), self.arms.read(self.data, self.state()[6::7])
