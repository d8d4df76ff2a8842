"""Actions as numbers for networks: normalised by the data, whatever robot they belong to."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from envs.embodiment import Embodiment

# Spread below which a number is a constant, in any unit in use (metres, radians, degrees, shares): no motor
# moves by less.
RESOLUTION = 1e-4


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

    centre: Tensor
    scale: Tensor
    move_scale: Tensor

    def __init__(self, embodiment: Embodiment):
        super().__init__()
        count = embodiment.action_dim
        self.delta, self.size = embodiment.delta, 2 * count
        self.register_buffer("centre", torch.zeros(count))
        self.register_buffer("scale", torch.ones(count))
        self.register_buffer("move_scale", torch.ones(count))

    def normalise(self, commands: Tensor, moves: Tensor) -> None:
        """Take units from commands [N, A] and, of absolute ones, their moves within a chunk [N, A]."""
        self.centre.copy_(commands.mean(0))
        self.scale.copy_(_per_spread(commands.std(0)))
        self.move_scale.copy_(_per_spread(moves.square().mean(0).sqrt()))

    def forward(self, commands: Tensor, now: Tensor) -> Tensor:
        """float32 [..., K, size] of commands [..., K, A] after the command in force [..., A]."""
        where = ((commands - self.centre) * self.scale).float()
        if self.delta:
            return torch.cat((where, where.cumsum(-2) / 2), -1)
        return torch.cat(((commands - now.unsqueeze(-2)) * self.move_scale, where), -1).float()


def _per_spread(spread: Tensor) -> Tensor:
    """One over a spread [A]; 0 where a number is a constant."""
    return torch.where(spread > RESOLUTION, 1 / spread.clamp(min=RESOLUTION), 0.0)
