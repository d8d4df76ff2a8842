"""Cameras over gym-aloha's table: its own, and three of ours that see more of the task in small pictures.

The package's cameras stand far off: in 64 pixels its cube is four wide. Its two on the wrists see 20 degrees,
no more than what is between the fingers.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from envs.physics.aloha.arms import SIDES, Array

# Our names of cameras -> the model's. "vis" looks at the left hand from the front and turns with it.
CAMERAS = {
    "scene": "scene",
    "left_hand": "left_hand",
    "right_hand": "right_hand",
    "top": "top",
    "angle": "angle",
    "vis": "front_close",
    "left_pillar": "left_pillar",
    "right_pillar": "right_pillar",
    "left_wrist": "left_wrist",
    "right_wrist": "right_wrist",
}
_EYE, _POINT, _FOVY = (0.0, -0.05, 0.55), (0.0, 0.5, 0.15), 42.0  # of "scene": m, m looked at, degrees
_HAND_EYE, _HAND_FOVY = (-0.1, 0.0, 0.16), 50.0  # in the gripper's frame, as the package's wrist cameras


def wrist_of(camera: str) -> str | None:
    """The arm that a camera is mounted on, None if it is on none."""
    side, _, mount = camera.partition("_")
    return side if mount in ("hand", "wrist") else None


def load_model(path: str) -> mujoco.MjModel:
    """One of gym-aloha's models with our cameras added, and without anti-aliasing.

    Args:
        path: of its XML file.
    """
    spec = mujoco.MjSpec.from_file(path)
    spec.worldbody.add_camera(name="scene", pos=_EYE, quat=_looking(_EYE, _POINT), fovy=_FOVY)
    for side in SIDES:
        spec.body(f"vx300s_{side}/gripper_link").add_camera(
            name=f"{side}_hand",
            pos=_HAND_EYE,
            fovy=_HAND_FOVY,
            mode=mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY,
            targetbody=f"vx300s_{side}/camera_focus",
        )
    model = spec.compile()
    model.vis.quality.offsamples = 0
    return model


def _looking(eye: tuple[float, ...], point: tuple[float, ...]) -> Array:
    """Quaternion [4] (w first) of a camera that looks from one point to another, upright."""
    back = np.subtract(eye, point) / np.linalg.norm(np.subtract(eye, point))
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    turn = np.stack((right, np.cross(back, right), back), 1)
    quaternion: Array = Rotation.from_matrix(turn).as_quat(scalar_first=True)
    return quaternion
