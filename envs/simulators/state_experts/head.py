"""The U-Net's state head: robot states in one deterministic pass from pooled features and commands."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.conditioning import ActionVector
from envs.conditioning.units import LEAST_SPREAD, Units
from envs.ranges import Count
from envs.simulators.base import Simulator
from envs.simulators.row_linear import RowLinear
from envs.simulators.state_experts.base import StateDecoder


class StateHead(StateDecoder):
    """Residual multilayer perceptron: the last state plus a change per frame.

    Args:
        simulator: whose features it reads; a vector per chunk.
        memory_frames: frames of history, M.
        width: of its hidden layers.
    """

    def __init__(self, simulator: Simulator, memory_frames: Count, width: Count):
        super().__init__(memory_frames)
        spec = simulator.spec
        self.chunk, self.states = spec.chunk, spec.state_dim
        self.vector = ActionVector(spec.embodiment)
        (features,) = simulator.feature_shape
        self.units = Units(self.states, spec.embodiment.state_rotations, LEAST_SPREAD)
        self.norm = nn.LayerNorm(features)
        size = features + (self.chunk + memory_frames) * self.vector.size + memory_frames * self.states
        last = RowLinear(width, self.chunk * self.states)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(
            RowLinear(size, width), nn.SiLU(), RowLinear(width, width), nn.SiLU(), last
        )

    def decode(
        self, features: Tensor, commands: Tensor, history: TensorDict, seed: Tensor, chunk_index: Tensor
    ) -> Tensor:
        """See StateDecoder.decode; seed and chunk_index do not matter, there is no noise."""
        return self._decode(features, commands, history["commands"], history["states"])

    def _decode(
        self, features: Tensor, commands: Tensor, past_commands: Tensor, past_states: Tensor
    ) -> Tensor:
        moves = self.vector(torch.cat((past_commands, commands), 1), past_commands[:, -1])
        past = self.units(past_states)
        inputs = torch.cat([self.norm(features), moves.flatten(1), past.flatten(1)], 1)
        change = self.layers(inputs).float().unflatten(1, (self.chunk, self.states))
        return past_states[:, -1:] + change * self.units.std

    def loss(
        self, features: Tensor, history: TensorDict, future: TensorDict, generator: torch.Generator
    ) -> Tensor:
        """Huber loss in units of the states' spread; the past is disturbed a little, for in rollouts it is
        decoded.
        """
        past = history["states"]
        noise = torch.randn(past.shape, generator=generator).to(past.device)
        disturbed = past + 0.02 * self.units.std * noise
        states = self._decode(features, future["commands"], history["commands"], disturbed)
        gap = self.units.change(states, future["states"])
        error = F.smooth_l1_loss(gap, torch.zeros_like(gap), beta=0.05, reduction="none")
        valid = future["valid"].float()
        return (error * valid[..., None]).sum() / (valid.sum() * self.states).clamp(min=1)

    def normalise(self, commands: Tensor, moves: Tensor, states: Tensor) -> None:
        """See StateDecoder; states hardly varying are left in their own unit, a fiftieth."""
        self.vector.normalise(commands, moves)
        self.units.normalise(states)
