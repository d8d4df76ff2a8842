"""Angles of recorded commands as networks and kinematics take them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from envs.embodiment import ActionKind, Embodiment
from envs.episodes.episode import EpisodeError

_TURNS = 4 * math.pi  # of a joint commanded in radians, at most


def turned_steadily(robot: Embodiment, commands: NDArray[np.float32]) -> NDArray[np.float32]:
    """Commands [T, A] of an episode whose roll, pitch and yaw, in radians, do not jump by a whole turn where
    they pass pi: networks learn from differences.
    """
    out = commands.copy()
    if robot.commands_poses and robot.action_kind is ActionKind.END_EFFECTOR:
        for arm in robot.arms:
            angles = list(arm.numbers[3:6])
            out[:, angles] = np.unwrap(commands[:, angles].astype(np.float64), axis=0)
    return out


def check_radians(robot: Embodiment, commands: NDArray[np.float32], where: Path) -> None:
    """See that joint commands [T, A] may be radians, as kinematics take them.

    Raises:
        EpisodeError: if one is too large for that; names the data set, `where`.
    """
    joints = [number for arm in robot.arms for number in arm.numbers]
    most = float(np.abs(commands[:, joints]).max())
    if most > _TURNS:
        raise EpisodeError(
            f"{where}: a joint is commanded to {most:.4g}, which is no angle in radians, as kinematics take"
            " it; convert degrees before, or leave kinematics out"
        )
