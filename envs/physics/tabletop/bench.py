"""One MuJoCo bench: reset from a seed, step by 14-D commands, render its cameras, say how the task stands."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.physics.render import offscreen_for
from envs.physics.tabletop.arms import ArmKinematics, matrix_to_rpy, rpy_to_matrix
from envs.physics.tabletop.scene import (
    ARMS,
    BASE,
    FINGER_TRAVEL,
    HOME,
    REACH,
    SHOULDER,
    TOOL_OFFSET,
    VIEWS,
    WRIST,
    build_mjcf,
)
from envs.physics.tabletop.tasks import TASKS, Layout

Array = NDArray[np.float64]
TIP_HEIGHT = 0.020  # m above the table at which fingertips travel
# box of the fingertips, metres; of it each arm reaches a part
LOW = np.array([-0.04, -0.42, TIP_HEIGHT - 0.012])
HIGH = np.array([0.46, 0.42, 0.35])
# s between joint targets: commands are interpolated, so that arms glide instead of jerking at the control
# rate
GLIDE = 0.025
MAX_SPEED = 0.6  # m/s a command may move a fingertip; faster commands are slowed down, not refused


def frames_held(hold: float, control_hz: float) -> int:
    """Frames in a row that make a condition held for `hold` seconds."""
    return max(1, round(hold * control_hz))


@dataclass(frozen=True)
class BenchConfig:
    """Options of the bench.

    Args:
        task: a name in tasks.TASKS.
        control_hz: commands and video frames per second.
        hold: seconds the task's condition must hold.
        size: (height, width) of every view in pixels.
        views: cameras to render, in order.
    """

    task: str = "push"
    control_hz: float = 10.0
    hold: float = 0.4
    size: tuple[int, int] = (64, 64)
    views: tuple[str, ...] = VIEWS

    def __post_init__(self) -> None:
        if self.task not in TASKS:
            raise ValueError(f"task.name={self.task!r} is unknown; choose one of {sorted(TASKS)}")
        unknown = [view for view in self.views if view not in VIEWS]
        if unknown:
            raise ValueError(
                f"task.views holds {unknown}, which this bench has not; its cameras are {list(VIEWS)}"
            )


class Bench:
    """The true world for one episode at a time; states and commands are float64 NumPy arrays."""

    def __init__(self, config: BenchConfig):
        self.config = config
        self.task = TASKS[config.task](hold=config.hold)
        self.hold = frames_held(config.hold, config.control_hz)
        self.model = mujoco.MjModel.from_xml_string(build_mjcf())
        self.data = mujoco.MjData(self.model)
        self.ik = ArmKinematics(self.model)
        self.glides = max(1, round(1.0 / (config.control_hz * GLIDE)))
        self.substeps = max(1, round(1.0 / (config.control_hz * self.glides * self.model.opt.timestep)))
        self._slides = np.array([[self.model.joint(f"{s}_slide_{t}").qposadr[0] for t in "ab"] for s in ARMS])
        self._block = self.model.joint("block").qposadr[0]
        self._cams = [self.model.camera(v).id for v in config.views]
        self.layout: Layout
        self.command: Array  # [14] the last absolute command
        self.joints: Array  # [2, 7] the last joint targets
        self.held = 0
        # true from the step on at which the condition has held for the last `hold` control steps
        self.success = False

    # -- episode ---------------------------------------------------------------------------------------------
    def reset(self, seed: int) -> None:
        """Lay out the task drawn from `seed`; the same seed gives the same episode, bit for bit."""
        rng = np.random.default_rng(seed)
        layout = self.layout = self.task.sample(rng)
        mujoco.mj_resetData(self.model, self.data)
        model = self.model
        model.geom("block").size[:] = layout.block_half
        model.geom("block").rgba[:3] = layout.block_rgb
        model.geom("table").rgba[:3] = layout.table_rgb
        model.site("target").rgba[:3] = layout.target_rgb
        model.site("target").pos[:2] = layout.target
        half = layout.block_yaw / 2
        self.data.qpos[self._block : self._block + 7] = [
            *layout.block,
            layout.block_half,
            np.cos(half),
            0,
            0,
            np.sin(half),
        ]
        self.command = np.concatenate(
            [[*tip, TIP_HEIGHT + TOOL_OFFSET, np.pi, 0.0, 0.0, 1.0] for tip in layout.grippers]
        ).astype(np.float64)
        self.joints = self.ik.solve(self.command, np.stack([HOME, HOME]), iterations=100)
        self.data.qpos[self.ik.qpos] = self.joints
        self._set_targets(self.joints)
        mujoco.mj_forward(self.model, self.data)
        self.held, self.success = 0, False

    def step(self, command: Array) -> None:
        """Carry out one absolute 14-D command for one control period.

        Raises:
            ValueError: if the command is not finite or has another shape.
        """
        command = np.asarray(command, dtype=np.float64)
        if command.shape != (14,) or not np.isfinite(command).all():
            raise ValueError(f"a command must be 14 finite numbers [x,y,z,roll,pitch,yaw,g]x2, got {command}")
        self.command = self._limit(command)
        before, after = self.joints, self.ik.solve(self.command, self.joints)
        for k in range(self.glides):
            self._set_targets(before + (after - before) * (k + 1) / self.glides)
            mujoco.mj_step(self.model, self.data, nstep=self.substeps)
        self.joints = after
        mujoco.mj_forward(self.model, self.data)
        self.held = self.held + 1 if self.distance < self.task.radius else 0
        self.success = self.success or self.held >= self.hold

    def _limit(self, command: Array) -> Array:
        out = command.copy()
        stride = MAX_SPEED / self.config.control_hz
        offset = np.array([0.0, 0.0, TOOL_OFFSET])
        for k, side in enumerate(ARMS):
            xyz = out[k * 7 : k * 7 + 3]
            move = xyz - self.command[k * 7 : k * 7 + 3]
            length = float(np.linalg.norm(move))
            xyz = self.command[k * 7 : k * 7 + 3] + move * min(1.0, stride / max(length, 1e-9))
            xyz = np.clip(xyz, LOW + offset, HIGH + offset)
            # What lies too far away is reached for as far as the arm goes, at the height that was asked for.
            wrist = xyz - WRIST * rpy_to_matrix(out[k * 7 + 3 : k * 7 + 6])[:, 2] - (*BASE[side], SHOULDER)
            away = float(np.linalg.norm(wrist[:2]))
            furthest = float(np.sqrt(max(REACH**2 - wrist[2] ** 2, 0.0)))
            xyz[:2] -= wrist[:2] * max(0.0, 1 - furthest / max(away, 1e-9))
            out[k * 7 : k * 7 + 3] = xyz
            out[k * 7 + 6] = np.clip(out[k * 7 + 6], 0.0, 1.0)
        return out

    def _set_targets(self, joints: Array) -> None:
        for k in range(2):
            self.data.ctrl[k * 9 : k * 9 + 7] = joints[k]
            self.data.ctrl[k * 9 + 7 : k * 9 + 9] = (1.0 - self.command[k * 7 + 6]) * FINGER_TRAVEL

    # -- what can be seen and known
    # ---------------------------------------------------------------------------
    @property
    def distance(self) -> float:
        """Metres between block and target."""
        return self.task.distance(self.data.qpos[self._block : self._block + 2], self.layout.target)

    @property
    def block(self) -> Array:
        """Place [4] of the block: its centre in metres and its heading, the angle of its own x axis about the
        vertical in radians.
        """
        w, x, y, z = self.data.qpos[self._block + 3 : self._block + 7]
        heading = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return np.array([*self.data.qpos[self._block : self._block + 3], heading])

    def state(self) -> Array:
        """Joint state [16] = left joints (7, rad), left gripper, right joints (7), right gripper; 1 is
        closed.
        """
        grip = 1.0 - self.data.qpos[self._slides].mean(1) / FINGER_TRAVEL
        joints = self.data.qpos[self.ik.qpos]
        return np.concatenate([joints[0], grip[:1], joints[1], grip[1:]])

    def achieved(self) -> Array:
        """Flange poses [14] that the arms really have, in the layout of commands."""
        grip = self.state()[[7, 15]]
        parts = []
        for k, site in enumerate(self.ik.sites):
            rpy = matrix_to_rpy(self.data.site_xmat[site].reshape(3, 3), self.command[k * 7 + 3 : k * 7 + 6])
            parts += [self.data.site_xpos[site], rpy, grip[k : k + 1]]
        return np.concatenate(parts)

    def cameras(self) -> tuple[Array, Array]:
        """Pinhole intrinsics [V, 3, 3] in pixels and camera-to-world [V, 4, 4] in the OpenCV convention."""
        height, width = self.config.size
        intrinsic = np.zeros((len(self._cams), 3, 3))
        c2w = np.tile(np.eye(4), (len(self._cams), 1, 1))
        for k, cam in enumerate(self._cams):
            focal = 0.5 * height / np.tan(np.deg2rad(self.model.cam_fovy[cam]) / 2)
            intrinsic[k] = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
            c2w[k, :3, :3] = self.data.cam_xmat[cam].reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
            c2w[k, :3, 3] = self.data.cam_xpos[cam]
        return intrinsic, c2w

    def render(
        self, views: tuple[str, ...] | None = None, size: tuple[int, int] | None = None, shadows: bool = False
    ) -> NDArray[np.uint8]:
        """Render views as uint8 [V, 3, H, W]; another size or shadows are for pictures that people look at."""
        offscreen = offscreen_for(self.model, size or self.config.size)
        return offscreen.render(self.model, self.data, views or self.config.views, shadows)
