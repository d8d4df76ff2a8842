"""Recorded commands as a policy: open loop, whatever the world shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from envs.specs import CHUNK, COMMAND, EPISODE, ActionMode, WorldSpec, at_rest, to_chunk


@dataclass(frozen=True)
class Commands:
    """What was commanded in N episodes.

    Args:
        values: float32 [N, T, A]; row t led to frame t, row 0 was in force at the start; padded.
        length: int64 [N], rows that exist.
    """

    values: Tensor
    length: Tensor


class RecordedActions(TensorDictModuleBase):
    """Acts as somebody did before from the same starts, and rests when the recording is over: absolute
    commands stay in force, changes and velocities are 0.

    Args:
        commands: of the episodes that begin at a world's initial states, in their order.
        spec: of the robot.
        mode: how the world takes chunks.
        elapsed: () -> int64 [B], actions that each running episode has seen (ChunkedEnv.elapsed).
    """

    def __init__(self, commands: Commands, spec: WorldSpec, mode: ActionMode, elapsed: Callable[[], Tensor]):
        super().__init__()
        self.commands, self.spec, self.mode, self.elapsed = commands, spec, mode, elapsed
        self.in_keys, self.out_keys = [EPISODE, COMMAND], [CHUNK]

    def forward(self, observed: TensorDictBase) -> TensorDictBase:
        """Writes the chunk float32 [B, K, A] that was commanded at this point of each episode."""
        in_force = observed[COMMAND].cpu()
        which = observed[EPISODE].squeeze(-1).cpu() % len(self.commands.length)
        ahead = self.elapsed()[:, None] + torch.arange(1, self.spec.chunk + 1)
        last = self.commands.length[which][:, None] - 1
        given = self.commands.values[which[:, None], torch.minimum(ahead, last)]
        given = torch.where((ahead > last).unsqueeze(-1), at_rest(given, self.spec.embodiment), given)
        observed[CHUNK] = to_chunk(given, in_force, self.mode).to(observed[COMMAND].device)
        return observed
