"""How much time passes from one shown frame to the next, as a part of what networks are told of actions."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Pace(nn.Module):
    """What is added to an embedding: nothing of the robot's own rate, and one direction for each doubling.

    It begins at zero, so that a world trained at one stride is what it would be without.

    Args:
        size: of the embedding.
    """

    def __init__(self, size: int):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(size))

    def forward(self, stride: Tensor) -> Tensor:
        """[B, size] of strides int64 [B], the robot's frames from one shown frame to the next."""
        return stride.float().log2()[:, None] * self.weight
