"""Ranges of grippers that names alone say, against what was recorded."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from envs.conditioning.units import RESOLUTION
from envs.embodiment import Embodiment
from envs.episodes.episode import EpisodeError
from envs.episodes.formats.lerobot.files import column_array, open_parquet
from envs.files import files_below

log = logging.getLogger(__name__)
_BEYOND = 0.5  # of a range, by which recorded values that are of it may leave it
_FILLED = 0.1  # of a range, that recorded values which are of it fill at least


def with_recorded_grippers(robot: Embodiment, folders: Sequence[Path]) -> Embodiment:
    """The robot of LeRobot data sets, whose arms names tell, its grippers' ranges by what is recorded.

    Recorded actions that lie far outside of a guessed range, or hardly fill it, are of another unit: the
    range then goes from the least to the greatest of them, open at the side at which the guess is. Tells so
    once in a process. Actions that cannot be read, or in which a gripper never moves, change nothing.
    """
    if not robot.grippers:
        return robot
    bounds = [one for folder in folders if (one := _bounds(folder, robot.action_dim)) is not None]
    if not bounds:
        return robot
    low, high = np.min([least for least, _ in bounds], 0), np.max([most for _, most in bounds], 0)
    arms = []
    for arm in robot.arms:
        if arm.gripper is not None:
            least, most = float(low[arm.gripper]), float(high[arm.gripper])
            if not _goes_with(arm.gripper_range, least, most):
                opened, closed = arm.gripper_range
                recorded = (least, most) if opened < closed else (most, least)
                _warn(str(folders[0]), robot.action_names[arm.gripper], arm.gripper_range, recorded)
                arm = replace(arm, gripper_range=recorded)
        arms.append(arm)
    return replace(robot, arms=tuple(arms))


def _goes_with(guess: tuple[float, float], least: float, most: float) -> bool:
    """Whether values between `least` and `most` may be of a gripper with that range."""
    if not most - least > RESOLUTION:  # nor if they are NaN
        return True
    low, high = min(guess), max(guess)
    width = high - low
    inside = low - _BEYOND * width <= least and most <= high + _BEYOND * width
    return inside and most - least >= _FILLED * width


@cache  # once in a process
def _warn(folder: str, name: str, guess: tuple[float, float], found: tuple[float, float]) -> None:
    log.warning(
        "%s: %s goes from %.4g to %.4g, which is not the range of a gripper open at %.4g and closed at"
        " %.4g, as names say it; taken to be open at %.4g and closed at %.4g. Say gripper_range in"
        " features.action.info.worldloop.arms of meta/info.json if it is another.",
        *(folder, name, min(found), max(found), *guess, *found),
    )


def _bounds(folder: Path, size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Least and greatest recorded value of each number of an action, [A] each; None if nothing tells."""
    return _read_bounds(folder, size, (folder / "meta/info.json").stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _read_bounds(
    folder: Path, size: int, written: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """See `_bounds`: from LeRobot's statistics, or from the rows themselves; read once as `written`."""
    try:
        stats = json.loads((folder / "meta/stats.json").read_text())["action"]
        low, high = (np.asarray(stats[key], np.float64).reshape(size) for key in ("min", "max"))
        return low, high
    except (OSError, ValueError, KeyError, TypeError):
        pass  # written by another program, which keeps none
    lows, highs = [], []
    try:
        for path in (path for path in files_below(folder / "data") if path.suffix == ".parquet"):
            rows = column_array(open_parquet(path).read(columns=["action"]), "action")
            if len(rows):
                lows.append(rows.min(0))
                highs.append(rows.max(0))
        return np.min(lows, 0).astype(np.float64), np.max(highs, 0).astype(np.float64)
    except (EpisodeError, OSError, ValueError, KeyError, pa.ArrowInvalid):
        return None  # whoever opens the recordings says what is wrong with them
