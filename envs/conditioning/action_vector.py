"""Actions as numbers for networks: normalised by the data, whatever robot they belong to."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from envs.conditioning.units import RESOLUTION, UNTOLD, Units
from envs.embodiment import Embodiment


class ActionVector(nn.Module):
    """Commands as float32 numbers of about unit spread.

    Absolute commands are told twice: as moves from the command in force when the chunk begins, which say what
    changes, and as they are, which say where. Deltas are told as they are and summed up, for only their sum
    says where things end.

    Args:
        embodiment: whose actions.

    Attributes:
        size: numbers per frame that `forward` gives.
    """

    move_scale: Tensor

    def __init__(self, embodiment: Embodiment):
        super().__init__()
        count = embodiment.action_dim
        self.delta, self.size = embodiment.delta, 2 * count
        self.units = Units(count, embodiment.action_rotations, still=UNTOLD)
        self.register_buffer("move_scale", torch.ones(count))

    def normalise(self, commands: Tensor, moves: Tensor) -> None:
        """Take units from commands [N, A] and, of absolute ones, their moves within a chunk [N, A]."""
        self.units.normalise(commands)
        spread = moves.square().mean(0).sqrt()
        self.move_scale.copy_(torch.where(spread > RESOLUTION, 1 / spread.clamp(min=RESOLUTION), 0.0))

    def forward(self, commands: Tensor, now: Tensor) -> Tensor:
        """float32 [..., K, size] of commands [..., K, A] after the command in force [..., A]."""
        where = self.units(commands).float()
        if self.delta:
            return torch.cat((where, where.cumsum(-2) / 2), -1)
        moves = self.units.moves(commands, now.unsqueeze(-2))
        return torch.cat((moves * self.move_scale, where), -1).float()
