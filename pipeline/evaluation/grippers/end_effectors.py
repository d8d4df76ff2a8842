"""Where end effectors are in recorded episodes, as far as a robot knows: by its state, its kinematics or its
commands; and where they truly are, as physics recorded it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from envs.conditioning import end_effector_poses
from envs.embodiment import ActionKind, Embodiment, EmbodimentError
from envs.episodes.clips import ClipStore
from envs.episodes.formats.lerobot.columns import POSES
from envs.episodes.formats.lerobot.dataset import LeRobotDataset
from envs.episodes.privileged import read_privileged
from envs.geometry.kinematics import Kinematics
from envs.geometry.rotations import fingertips

FLANGES = (
    "flange_poses"  # privileged: [arms, n], x, y, z in metres, then roll, pitch, yaw where a suite has them
)
_PLACE, _TURN = ("x", "y", "z"), ("roll", "pitch", "yaw")


@dataclass(frozen=True)
class EndEffectors:
    """End effectors of all rows of a store.

    Args:
        positions: float32 [N, arms, 3], metres, in the cameras' world frame: fingertips where orientations
            are known, else the point that the robot speaks of.
        arms: their names.
        source: who says so, in words.
        measured: whether they were there, instead of being told to go there.
    """

    positions: Tensor
    arms: tuple[str, ...]
    source: str
    measured: bool


def known_end_effectors(store: ClipStore, tool_offset: float) -> EndEffectors:
    """End effectors by the first of: positions in the state, joints in the state and kinematics, recorded
    poses, commands.

    Args:
        tool_offset: metres from a flange to the fingertips along its z (PoseMapStyle).

    Raises:
        EmbodimentError: if none of them says it; names the fix.
    """
    robot, states = store.spec.embodiment, store.arrays["states"]
    arms = arm_names(robot)
    if (placed := _columns(robot.state_names, arms, _PLACE)) is not None:
        turned = _columns(robot.state_names, arms, _TURN)
        poses = states[:, placed] if turned is None else torch.cat((states[:, placed], states[:, turned]), -1)
        return EndEffectors(_tips(poses, tool_offset), arms, "positions in the state", True)
    kinematics = None if robot.kinematics is None else Kinematics(robot.kinematics)
    if kinematics is not None and (joints := _joints(robot, kinematics)) is not None:
        poses = kinematics.flanges([states[:, numbers] for numbers in joints])
        return EndEffectors(_tips(poses, tool_offset), arms, "joints in the state, by kinematics", True)
    if (recorded := _recorded(store)) is not None:
        return EndEffectors(_tips(recorded, tool_offset), arms, f"the data's column {POSES}", False)
    if robot.commands_poses:
        poses = end_effector_poses(robot, store.arrays["commands"], kinematics)[..., :6]
        return EndEffectors(_tips(poses, tool_offset), arms, "commanded poses", False)
    raise EmbodimentError(
        f"nothing says where the end effectors of {robot.robot} are: record x, y, z of each arm in"
        f" observation.state (as {arms[0]}_x), or a column {POSES}, or describe the robot by"
        " simulator.kinematics"
    )


def true_end_effectors(store: ClipStore, known: EndEffectors, tool_offset: float) -> EndEffectors | None:
    """Those that physics recorded as privileged.flange_poses, else `known` if they were measured; None where
    nobody knows the truth.
    """
    poses = read_privileged(store, FLANGES)
    if poses is not None and poses.ndim == 3 and poses.shape[1] == len(known.arms) and poses.shape[2] >= 3:
        width = 6 if poses.shape[2] >= 6 else 3
        return EndEffectors(_tips(poses[..., :width], tool_offset), known.arms, "physics", True)
    return known if known.measured else None


def arm_names(robot: Embodiment) -> tuple[str, ...]:
    """Names of the arms; ("arm",) of a robot that does not say which it has."""
    return tuple(arm.name for arm in robot.arms) or ("arm",)


def _columns(names: Sequence[str], arms: Sequence[str], wanted: Sequence[str]) -> list[list[int]] | None:
    """Positions [arms, n] of the wanted numbers of each arm among the state's names, None if one lacks."""
    prefixes = [[f"{arm}_", f"{arm}."] + ([""] if len(arms) == 1 else []) for arm in arms]
    out = []
    for some in prefixes:
        found = next((p for p in some if all(p + name in names for name in wanted)), None)
        if found is None:
            return None
        out.append([names.index(found + name) for name in wanted])
    return out


def _joints(robot: Embodiment, kinematics: Kinematics) -> list[list[int]] | None:
    """Positions of each arm's joints in the state, None if it has none that are known for joints."""
    names = robot.state_names
    arms = kinematics.robot.joints
    if len(arms) == len(arm_names(robot)) and all(joint in names for arm in arms for joint in arm):
        return [[names.index(joint) for joint in arm] for arm in arms]
    if robot.action_kind is ActionKind.JOINTS and robot.arms and {*names} == {*robot.action_names}:
        return [[names.index(robot.action_names[number]) for number in arm.numbers] for arm in robot.arms]
    return None


def _recorded(store: ClipStore) -> Tensor | None:
    """The recorded pose commands [N, arms, 6] of all rows; None where a data set has none."""
    sets = [LeRobotDataset(part.folder, store.spec.size) for part in store.parts]
    if any(POSES not in data.features for data in sets):
        return None
    rows = torch.from_numpy(np.concatenate([data.column(POSES) for data in sets])).float()
    return rows.reshape(len(rows), -1, 7)[..., :6]


def _tips(poses: Tensor, tool_offset: float) -> Tensor:
    """Fingertips [N, arms, 3] of poses [N, arms, 6], or the places themselves of places [N, arms, 3]."""
    if poses.shape[-1] < 6:
        return poses.float()
    return fingertips(poses.float(), tool_offset)
