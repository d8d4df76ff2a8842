"""Angles and units of recorded commands as networks, kinematics and pose maps take them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from envs.conditioning.turns import Turns
from envs.embodiment import Embodiment
from envs.episodes.episode import EpisodeError

_TURNS = 4 * math.pi  # of a joint or an angle commanded in radians, at most
_REACH = 10.0  # metres from the origin, at most


def turned_steadily(robot: Embodiment, commands: NDArray[np.float32]) -> NDArray[np.float32]:
    """Commands [T, A] of an episode whose orientations do not jump: networks learn from differences.

    Each is told the way that is nearest to the one before (see Turns).
    """
    turns = Turns(robot.action_dim, robot.action_rotations)
    told = torch.from_numpy(commands).double()
    turns.fit(told)
    out = told.numpy().copy()
    angles = [number for number in turns.angles if turns.turn[number] > 0]
    out[:, angles] = np.unwrap(out[:, angles], axis=0)
    if turns.wholes:
        told = torch.from_numpy(out)
        for frame in range(1, len(told)):
            told[frame] = turns.nearest(told[frame], told[frame - 1])
    return out.astype(np.float32)


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


def check_poses(robot: Embodiment, commands: NDArray[np.float32], where: Path) -> None:
    """See that commanded flange poses [T, A] may be metres and radians, as pose maps and wrist cameras take
    them.

    Raises:
        EpisodeError: if one is too large for that; names the data set, `where`.
    """
    kinds = (("metres", "millimetres", 0, _REACH), ("radians", "degrees", 3, _TURNS))
    for unit, other, first, limit in kinds:
        numbers = [number for arm in robot.arms for number in arm.numbers[first : first + 3]]
        most = np.abs(commands[:, numbers]).max(0)
        if (most > limit).any():
            far = int(most.argmax())
            raise EpisodeError(
                f"{where}: {robot.action_names[numbers[far]]} is commanded to {most[far]:.4g}, which is not"
                f" in {unit}, as poses of calibrated cameras take it; convert {other} before, say"
                ' "action_kind": "other" in features.action.info.worldloop, or leave calibration.* out'
            )
