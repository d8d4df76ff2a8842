"""Four robots that differ in all that an embodiment may differ in, and random observations of any of them."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from envs.embodiment import ActionKind, Arm, Camera, Embodiment
from envs.specs import C2W, COMMAND, IMAGE, INSTRUCTION_UTF8, INTRINSIC, STATE, WorldSpec, text_to_bytes

POSE = ("x", "y", "z", "roll", "pitch", "yaw")
INSTRUCTIONS = ("push the red block to the green one", "open the drawer", "lift the cube")

# 14-D flange poses and grippers of two arms. Pose and ray maps can be drawn of two of three cameras.
BIMANUAL_POSES = Embodiment(
    robot="two_arms_poses",
    action_names=tuple(f"{arm}_{name}" for arm in ("left", "right") for name in (*POSE, "gripper")),
    action_kind=ActionKind.END_EFFECTOR,
    delta=False,
    arms=(Arm("left", tuple(range(6)), 6), Arm("right", tuple(range(7, 13)), 13)),
    state_names=tuple(f"{arm}_{name}" for arm in ("left", "right") for name in (*POSE, "gripper")),
    cameras=(
        Camera("top", (32, 48), calibrated=True),
        Camera("left_wrist", (32, 48), wrist="left", calibrated=True),
        Camera("right_wrist", (32, 48), wrist="right"),
    ),
    fps=10.0,
)

# 16-D joint targets of two arms of seven joints, each followed by its gripper (GE-Sim's order).
BIMANUAL_JOINTS = Embodiment(
    robot="two_arms_joints",
    action_names=tuple(
        f"{arm}_{name}" for arm in ("left", "right") for name in (*(f"joint{k}" for k in range(7)), "gripper")
    ),
    action_kind=ActionKind.JOINTS,
    delta=False,
    arms=(Arm("left", tuple(range(7)), 7), Arm("right", tuple(range(8, 15)), 15, (0.0, 120.0))),
    state_names=tuple(
        f"{arm}_{name}" for arm in ("left", "right") for name in (*(f"joint{k}" for k in range(7)), "gripper")
    ),
    cameras=(
        Camera("head", (32, 48), calibrated=True),
        Camera("hand_left", (32, 48), wrist="left", calibrated=True),
        Camera("hand_right", (32, 48), wrist="right", calibrated=True),
    ),
    fps=30.0,
    main_camera="head",
)

# 4-D changes of one arm; the state holds more than the action does. Two cameras that stand still.
ARM_DELTAS = Embodiment(
    robot="one_arm_deltas",
    action_names=("delta_x", "delta_y", "delta_z", "gripper"),
    action_kind=ActionKind.END_EFFECTOR,
    delta=True,
    arms=(Arm("arm", (0, 1, 2), 3, (-1.0, 1.0)),),
    state_names=("x", "y", "z", "opening", "speed"),
    cameras=(Camera("corner", (32, 32)), Camera("behind", (32, 32))),
    fps=12.5,
    main_camera="behind",
)

# 7-D joint targets of one arm, with two uncalibrated cameras whose pictures differ in size.
ARM_JOINTS = Embodiment(
    robot="one_arm_joints",
    action_names=(*(f"joint{k}.pos" for k in range(6)), "gripper.pos"),
    action_kind=ActionKind.JOINTS,
    delta=False,
    arms=(Arm("arm", tuple(range(6)), 6, (0.0, 100.0)),),
    state_names=(*(f"joint{k}.pos" for k in range(6)), "gripper.pos"),
    cameras=(Camera("wrist", (48, 64), wrist="arm"), Camera("front", (36, 40))),
    fps=30.0,
)

EMBODIMENTS = {robot.robot: robot for robot in (BIMANUAL_POSES, BIMANUAL_JOINTS, ARM_DELTAS, ARM_JOINTS)}


def world_spec(robot: Embodiment, size: tuple[int, int] = (32, 32), chunk: int = 4) -> WorldSpec:
    """What a world shows of a robot, with every conditioning that it allows."""
    return WorldSpec(robot, size, chunk, robot.calibrated and robot.commands_poses, robot.calibrated)


def intrinsics(spec: WorldSpec, *batch: int) -> Tensor:
    """Pinhole intrinsics float32 [*batch, V, 3, 3] in pixels, with a field of view of about 53 degrees."""
    height, width = spec.size
    one = torch.tensor([[float(width), 0.0, width / 2], [0.0, float(width), height / 2], [0.0, 0.0, 1.0]])
    return one.expand(*batch, spec.views, 3, 3) * _calibrated(spec)


def camera_poses(spec: WorldSpec, *batch: int) -> Tensor:
    """Camera-to-world poses float32 [*batch, V, 4, 4]: a metre up, looking down, side by side."""
    poses = torch.eye(4).expand(*batch, spec.views, 4, 4).clone()
    poses[..., 1, 1] = poses[..., 2, 2] = -1.0
    poses[..., 2, 3] = 1.0
    poses[..., 0, 3] = 0.1 * torch.arange(spec.views, dtype=torch.float32)
    return poses * _calibrated(spec)


def recorded_cameras(spec: WorldSpec, *batch: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """`intrinsics` [V, 3, 3] and `camera_poses` [*batch, V, 4, 4] as an Episode or a suite has them: NaN of
    cameras that are not calibrated.
    """
    unknown = torch.where(_calibrated(spec) > 0, 0.0, torch.nan)
    return (intrinsics(spec) + unknown).numpy(), (camera_poses(spec, *batch) + unknown).numpy()


def _calibrated(spec: WorldSpec) -> Tensor:
    """1 of calibrated cameras, 0 of others, [V, 1, 1]."""
    return torch.tensor([float(camera.calibrated) for camera in spec.embodiment.cameras])[:, None, None]


def observations(spec: WorldSpec, batch: int, seed: int = 0) -> TensorDict:
    """Random observations [batch] with the keys, shapes and dtypes that an environment of `spec` shows."""
    g = torch.Generator().manual_seed(seed)
    td = TensorDict({}, [batch])
    td[IMAGE] = torch.randint(0, 256, (batch, spec.views, 3, *spec.size), dtype=torch.uint8, generator=g)
    td[STATE] = torch.randn(batch, spec.state_dim, generator=g)
    td[COMMAND] = torch.randn(batch, spec.action_dim, generator=g)
    td[INSTRUCTION_UTF8] = text_to_bytes([INSTRUCTIONS[k % len(INSTRUCTIONS)] for k in range(batch)])
    if spec.embodiment.calibrated:
        td[INTRINSIC], td[C2W] = intrinsics(spec, batch), camera_poses(spec, batch)
    return td
