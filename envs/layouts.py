"""What the numbers of commands and joint states mean, as types: 16 numbers of one layout are never taken for
another's.

Two layouts of two 7-joint arms are in use, and both have 16 numbers: simulators take and give [L7, Lg, R7,
Rg], openpi
policies read [L7, R7, Lg, Rg]. So joint numbers cross borders as `Joints`, which knows its layout.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import torch
import torch.nn.functional as F
from torch import Tensor


class CommandLayout(str, Enum):
    """What a simulator's commands are.

    EEF: 14 numbers, [x, y, z, roll, pitch, yaw, gripper] of the left, then the right flange; metres, radians.
    JOINTS: 16 numbers, absolute joints [L7, Lg, R7, Rg]; radians, grippers in the data's own unit.
    """

    EEF = "eef"
    JOINTS = "joints"

    @property
    def size(self) -> int:
        """How many numbers."""
        return 14 if self is CommandLayout.EEF else 16

    @property
    def grippers(self) -> tuple[int, int]:
        """Which of them are grippers."""
        return (6, 13) if self is CommandLayout.EEF else (7, 15)


class JointLayout(Enum):
    """Order of 16 joint numbers."""

    PER_ARM = "L7,Lg,R7,Rg"
    GRIPPERS_LAST = "L7,R7,Lg,Rg"


_TO_GRIPPERS_LAST = [*range(7), *range(8, 15), 7, 15]  # numbers of PER_ARM in the order of GRIPPERS_LAST
_TO_PER_ARM = [*range(7), 14, *range(7, 14), 15]


@dataclass(frozen=True)
class Joints:
    """Joint numbers [..., 16] together with their layout.

    Raises:
        ValueError: if there are not 16 of them.

    Examples:
        >>> state = Joints(torch.arange(16.0), JointLayout.PER_ARM)
        >>> state.to(JointLayout.GRIPPERS_LAST)[[7, 14, 15]].tolist()
        [8.0, 7.0, 15.0]
    """

    values: Tensor
    layout: JointLayout

    def __post_init__(self) -> None:
        if self.values.shape[-1] != 16:
            raise ValueError(
                f"joints of two arms are 16 numbers, {self.layout.value}; got {tuple(self.values.shape)}"
            )

    def to(self, layout: JointLayout) -> Tensor:
        """The bare numbers [..., 16] in a layout."""
        if layout is self.layout:
            return self.values
        order = _TO_PER_ARM if layout is JointLayout.PER_ARM else _TO_GRIPPERS_LAST
        return self.values[..., order]


def compress(chunk: Tensor, count: int, layout: CommandLayout) -> Tensor:
    """A long chunk [..., L, A] as one of `count` rows: grippers by the nearest row, all else by means between
    the kept first and last row.

    A policy may say 50 rows where a world takes 25; this is GE-Sim 2.0's way to spend one step on them.

    Raises:
        ValueError: if the chunk is shorter than `count`; rows are never made up.
    """
    length, width = chunk.shape[-2:]
    if width != layout.size:
        raise ValueError(f"a chunk of layout {layout.value} has {layout.size} numbers a row, got {width}")
    if length < count:
        raise ValueError(f"a chunk of {length} rows cannot be compressed to {count}")
    if length == count:
        return chunk
    if count == 1:
        return chunk[..., :1, :]
    nearest = torch.linspace(0, length - 1, count, dtype=torch.float64).round().long()
    inner = (
        F.adaptive_avg_pool1d(
            chunk[..., 1:-1, :].reshape(-1, length - 2, width).transpose(1, 2), count - 2
        ).transpose(1, 2)
        if count > 2
        else chunk[..., :0, :]
    )
    out = torch.cat(
        [chunk[..., :1, :], inner.reshape(*chunk.shape[:-2], count - 2, width), chunk[..., -1:, :]], -2
    )
    for gripper in layout.grippers:
        out[..., gripper] = chunk[..., nearest, gripper]
    return out
