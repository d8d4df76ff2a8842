"""The U-Net's state head: joint states in one deterministic pass from pooled features and commands."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.simulators.state_experts.base import StateDecoder
from envs.specs import ACTION_DIM, STATE_DIM, to_relative


class StateHead(StateDecoder):
    """Residual multilayer perceptron: the last state plus a change per frame.

    Args:
        features: size of the simulator's feature vector.
        chunk: frames per chunk, K; memory: frames of history, M.
    """

    state_mean: Tensor
    state_std: Tensor

    def __init__(self, features: int, chunk: int, memory: int = 4, width: int = 384):
        super().__init__(memory)
        self.chunk = chunk
        size = features + (chunk + memory + 1) * ACTION_DIM + memory * STATE_DIM
        self.register_buffer("state_mean", torch.zeros(STATE_DIM))
        self.register_buffer("state_std", torch.ones(STATE_DIM))
        self.norm = nn.LayerNorm(features)
        last = nn.Linear(width, chunk * STATE_DIM)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(
            nn.Linear(size, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), last
        )

    def decode(
        self,
        features: Tensor,
        commands: Tensor,
        past_commands: Tensor,
        past_states: Tensor,
        seed: Tensor,
        chunk_index: Tensor,
    ) -> Tensor:
        """See StateDecoder.decode; seed and chunk_index do not matter, there is no noise."""
        now = past_commands[:, -1]
        relative = to_relative(torch.cat((past_commands, commands), 1), now) * 10.0
        past = (past_states - self.state_mean) / self.state_std
        inputs = torch.cat([self.norm(features), relative.flatten(1), now * 3.0, past.flatten(1)], 1)
        change = self.layers(inputs).float().unflatten(1, (self.chunk, STATE_DIM))
        return past_states[:, -1:] + change * self.state_std

    def loss(
        self,
        features: Tensor,
        commands: Tensor,
        past_commands: Tensor,
        past_states: Tensor,
        truth: Tensor,
        valid: Tensor,
        generator: torch.Generator,
    ) -> Tensor:
        """Huber loss in units of the states' spread; the past is disturbed a little, for in rollouts it is
        decoded too.
        """
        noise = torch.randn(past_states.shape, generator=generator).to(past_states.device)
        # type: ignore[arg-type]
        states = self.decode(
            features, commands, past_commands, past_states + 0.02 * self.state_std * noise, None, None
        )
        error = F.smooth_l1_loss(states / self.state_std, truth / self.state_std, beta=0.05, reduction="none")
        return (error * valid[..., None]).sum() / valid.sum().clamp(min=1)

    def normalise(self, states: Tensor) -> None:
        """Set mean and spread from states [N, 16]."""
        self.state_mean.copy_(states.mean(0))
        self.state_std.copy_(states.std(0).clamp(min=0.02))
