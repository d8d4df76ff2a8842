"""The numbers of one episode in a LeRobot data set: its rows as the fields of an Episode, checked by column.

LeRobot's own columns are read from any set. Of ours, `command`, `end_effector.command`, `present` and
`privileged.*` are read only from sets that carry our description (info.py): elsewhere they are
somebody else's words.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from envs.commanded_states import as_commands, same_numbers
from envs.embodiment import Embodiment
from envs.episodes.episode import EpisodeError
from envs.episodes.formats.lerobot import columns as names
from envs.episodes.formats.lerobot.columns import PRIVILEGED
from envs.episodes.formats.lerobot.files import column_array
from envs.episodes.formats.lerobot.info import INFO_KEY, described_here
from envs.episodes.pictures import resize_intrinsics

_ANY_SET = {"action", "observation.state", "episode_index", "task_index", names.C2W, names.INTRINSIC}
_ANY_SET |= {names.SOURCE, names.SEED, names.SUCCESS, names.REWARD}
_OUR_SETS = {names.COMMAND, names.POSES, names.PRESENT}
_RENAME = "correct it, or rename the column if it means something else (docs/own_data.md lists Worldloop's)"


def is_read(name: str, features: Mapping[str, Any], privileged: bool) -> bool:
    """Whether a column of numbers belongs to an episode of a data set of these features."""
    ours = described_here(features)
    return name in _ANY_SET or (ours and (name in _OUR_SETS or (privileged and name.startswith(PRIVILEGED))))


def shape_of(name: str, features: Mapping[str, Any]) -> list[int]:
    """Shape of a row of a column; [-1] where nobody says it."""
    about: Mapping[str, Any] = features.get(name, {}).get("info") or {}
    shape: list[int] = about.get(INFO_KEY, {}).get("shape", [-1])
    return shape


def numbers_of(
    table: pa.Table, robot: Embodiment, recorded: Embodiment, features: Mapping[str, Any]
) -> dict[str, Any]:
    """All fields of an episode that are numbers, by name; None where nobody knows them.

    Args:
        table: its rows, of columns that `is_read` names.
        robot: the robot, its cameras in the size that pictures are brought to.
        recorded: the same robot with cameras of the recorded size.

    Raises:
        EpisodeError: naming the column that cannot be what its name says.
    """
    length = len(table)

    def read(name: str, width: int | None = None) -> NDArray[Any] | None:
        if name not in table.column_names:
            return None
        values = column_array(table, name)
        if width is not None and values.shape[1] != width:
            raise EpisodeError(
                f"column {name} holds {values.shape[1]} numbers a row, but {robot.robot} makes it {width};"
                f" {_RENAME}"
            )
        return values

    action, states = read("action"), read("observation.state")
    assert action is not None and states is not None
    command = read(names.COMMAND, robot.action_dim)
    first = first_command(robot, action, states) if command is None else command[0]
    reward = read(names.REWARD)
    known: dict[str, Any] = {
        "commands": np.concatenate([first[None], action[:-1]]).astype(np.float32),
        "states": states.astype(np.float32),
        "present": _flags(table, names.PRESENT),
        "success": _flags(table, names.SUCCESS),
        "reward": None,
    }
    if known["success"] is not None:
        # Row t says what the action taken there led to; the last row's belongs to the last frame seen.
        done = known["success"]
        # What was done stays done, also where a suite says it of each step by itself.
        known["success"] = np.logical_or.accumulate(np.concatenate([[False], done[:-1]]))
        known["success"][-1] |= done[-1]
    if reward is not None:
        known["reward"] = np.concatenate([[0.0], reward[:-1, 0]]).astype(np.float32)
        known["reward"][-1] += reward[-1, 0]
    cameras, views = list(robot.calibrated_views), len(robot.cameras)
    c2w = read(names.C2W, 16 * len(cameras)) if cameras else None
    intrinsic = read(names.INTRINSIC, 9 * len(cameras)) if cameras else None
    if c2w is not None and intrinsic is not None:
        known["c2w"] = np.full((length, views, 4, 4), np.nan, np.float32)
        known["c2w"][:, cameras] = c2w.reshape(length, -1, 4, 4)
        known["intrinsic"] = np.full((views, 3, 3), np.nan, np.float32)
        known["intrinsic"][cameras] = intrinsic[0].reshape(-1, 3, 3)
        for view in cameras:
            sizes = recorded.cameras[view].size, robot.cameras[view].size
            known["intrinsic"][view] = resize_intrinsics(known["intrinsic"][view], *sizes)
    poses = read(names.POSES, 7 * len(robot.arms)) if robot.arms else None
    if poses is not None:
        known["poses"] = poses.reshape(length, -1, 7).astype(np.float32)
    known["privileged"] = {
        name[len(PRIVILEGED) :]: column_array(table, name)
        .reshape(length, *shape_of(name, features))
        .astype(np.float32)
        for name in table.column_names
        if name.startswith(PRIVILEGED)
    }
    return known


def first_command(robot: Embodiment, action: NDArray[Any], states: NDArray[Any]) -> NDArray[Any]:
    """The command [A] in force at the start, where no column says it, of actions [T, A] and states [T, S]."""
    if robot.delta:
        still = np.zeros_like(action[0])
        # Nothing has moved yet; a gripper is told where it is, not by how much it changes.
        still[list(robot.grippers)] = action[0, list(robot.grippers)]
        return still
    return as_commands(robot, states[0]).astype(action.dtype) if same_numbers(robot) else action[0]


def seed_of(table: pa.Table, otherwise: int) -> int:
    """The episode's seed.

    Raises:
        EpisodeError: if its column holds no whole number.
    """
    if names.SEED not in table.column_names:
        return otherwise
    value = table[names.SEED][0].as_py()
    try:
        seed = int(value)
    except (TypeError, ValueError):
        seed = None
    if seed is None or (isinstance(value, float) and value != seed):
        raise EpisodeError(f"column {names.SEED} holds {value!r}, which is no whole number; {_RENAME}")
    return seed


def source_of(table: pa.Table, otherwise: str) -> str:
    """Who acted, as far as somebody said it."""
    value = table[names.SOURCE][0].as_py() if names.SOURCE in table.column_names else None
    return otherwise if value is None else str(value)


def _flags(table: pa.Table, name: str) -> NDArray[np.bool_] | None:
    """A column of bool, or of 0 and 1, as bool [T]; None if there is none, or all of it is null or NaN.

    Raises:
        EpisodeError: if only some of it is, or it holds anything else.
    """
    if name not in table.column_names:
        return None
    cells = [one[0] if isinstance(one, list) and len(one) == 1 else one for one in table[name].to_pylist()]
    unknown = [cell is None or cell != cell for cell in cells]
    if all(unknown):
        return None
    if any(unknown):
        raise EpisodeError(
            f"column {name} is null or NaN in {sum(unknown)} of {len(cells)} rows; label all rows of the"
            " episode, or leave all of them null"
        )
    if wrong := [cell for cell in cells if cell not in (0, 1)]:
        raise EpisodeError(f"column {name} holds {wrong[0]!r}; write true and false, or 1 and 0")
    return np.array(cells, float).astype(bool)
