"""What a policy reads of the robot itself."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from envs.conditioning.units import Units
from envs.embodiment import Embodiment
from envs.specs import COMMAND, STATE

FEATURES = 64  # that networks make of it


def proprioception_keys(robot: Embodiment, command: bool) -> tuple[NestedKey, ...]:
    """What a policy reads of the robot itself: its state and, if asked to, the command in force.

    Chunks may be meant relative to that, and it is exact where states are measured or imagined. Of commands
    that are changes, the one in force says only what was done last, which imitation would copy: it is not
    read.
    """
    return (STATE, COMMAND) if command and not robot.delta else (STATE,)


class Proprioception(nn.Module):
    """What the robot knows of itself, in units of its own spread.

    Args:
        robot: whose.
        command: see proprioception_keys.

    Forward takes the values of `proprioception_keys`, float [..., S] and [..., A], and returns float32
    [..., size] within -5..5.
    """

    def __init__(self, robot: Embodiment, command: bool):
        super().__init__()
        self.keys = proprioception_keys(robot, command)
        states, commanded = robot.state_dim, COMMAND in self.keys
        self.size = states + robot.action_dim * commanded
        turned = [tuple(states + number for number in group) for group in robot.action_rotations]
        self.units = Units(self.size, [*robot.state_rotations, *turned * commanded], still=1.0)

    def normalise(self, *values: Tensor) -> None:
        """Take units from values [N, S] and [N, A]; what hardly varies keeps its own."""
        self.units.normalise(torch.cat(values, -1))

    def forward(self, *values: Tensor) -> Tensor:
        told: Tensor = self.units(torch.cat(values, -1))
        return told.clamp(-5, 5)


def encoded(size: int) -> nn.Sequential:
    """A small network from so many numbers to FEATURES."""
    return nn.Sequential(nn.Linear(size, FEATURES), nn.SiLU(), nn.Linear(FEATURES, FEATURES))
