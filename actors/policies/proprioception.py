"""What a policy reads of the robot itself."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from envs.conditioning.action_vector import RESOLUTION
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

    mean: Tensor
    std: Tensor

    def __init__(self, robot: Embodiment, command: bool):
        super().__init__()
        self.keys = proprioception_keys(robot, command)
        self.size = len(robot.state_names) + (robot.action_dim if COMMAND in self.keys else 0)
        self.register_buffer("mean", torch.zeros(self.size))
        self.register_buffer("std", torch.ones(self.size))

    @torch.no_grad()
    def normalise(self, *values: Tensor) -> None:
        """Take units from values [N, S] and [N, A]; what hardly varies keeps its own."""
        joined = torch.cat(values, -1)
        spread = joined.std(0, unbiased=False)
        self.mean.copy_(joined.mean(0))
        self.std.copy_(torch.where(spread > RESOLUTION, spread, 1.0))

    def forward(self, *values: Tensor) -> Tensor:
        return ((torch.cat(values, -1) - self.mean) / self.std).clamp(-5, 5)


def encoded(size: int) -> nn.Sequential:
    """A small network from so many numbers to FEATURES."""
    return nn.Sequential(nn.Linear(size, FEATURES), nn.SiLU(), nn.Linear(FEATURES, FEATURES))
