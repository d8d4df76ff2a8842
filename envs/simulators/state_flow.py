"""The DiT's state expert: joint states by flow matching on the frozen trunk's features, with command and state history."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from envs.schema import STATE_DIM, to_relative
from envs.simulators.state_base import StateDecoder

if TYPE_CHECKING:
    from envs.simulators.dit import MultiViewDiT

COMMAND_TOKEN = 16  # commands are padded to the width of states


@dataclass(frozen=True)
class StateExpertConfig:
    """Options of the state expert.

    Args:
        layers, heads, head_dim: of its blocks.
        steps: Euler steps per chunk.
    """

    layers: int = 4
    heads: int = 4
    head_dim: int = 32
    steps: int = 4


class StateExpert(StateDecoder):
    """Denoises the future states of a chunk among clean tokens of past and future commands and of past states.

    Args:
        features: feature_shape of the simulator, (views, tokens, width).
        chunk: frames per chunk, K; memory: frames of history, M.
        config: its size.
    """

    state_mean: Tensor
    state_std: Tensor

    def __init__(self, features: tuple[int, ...], chunk: int, memory: int, config: StateExpertConfig):
        super().__init__(memory)
        from envs.simulators.dit import DiTShape, MultiViewDiT

        self.views, self.chunk, self.config = features[0], chunk, config
        heads = max(h for h in range(1, features[2] + 1) if features[2] % h == 0 and features[2] // h >= 32)
        shape = DiTShape(
            num_layers=config.layers, num_attention_heads=heads, attention_head_dim=features[2] // heads, pose_num_attention_heads=config.heads, pose_attention_head_dim=config.head_dim
        )
        whole = MultiViewDiT(shape)
        for name in ("patch_embed", "time_embed", "view_ada", "transformer_blocks", "norm_out", "proj_out", "video_buffer_norm"):
            delattr(whole, name)  # the trunk stays with the simulator; only the expert's half is kept here
        del whole.view_embed, whole.video_buffer_weights
        self.net: MultiViewDiT = whole
        self.register_buffer("state_mean", torch.zeros(STATE_DIM))
        self.register_buffer("state_std", torch.ones(STATE_DIM))

    def normalise(self, states: Tensor) -> None:
        """Set units from joint states [N, 16]."""
        self.state_mean.copy_(states.mean(0))
        self.state_std.copy_(states.std(0).clamp(min=0.02))

    def _tokens(self, commands: Tensor, past_commands: Tensor, past_states: Tensor) -> tuple[Tensor, Tensor]:
        """Clean tokens [B, M + K + M, 16] and the last state in units [B, 1, 16]."""
        now = past_commands[:, -1]
        moves = torch.cat([to_relative(past_commands, now), to_relative(commands, now)], 1) * 10.0
        moves = torch.nn.functional.pad(moves, (0, COMMAND_TOKEN - moves.shape[-1]))
        past = (past_states - self.state_mean) / self.state_std
        return torch.cat([moves, past], 1), past[:, -1:]

    def _velocity(self, z: Tensor, sigma: Tensor, tokens: Tensor, features: Tensor) -> Tensor:
        levels = torch.zeros(len(z), tokens.shape[1] + self.chunk, device=z.device)
        levels[:, tokens.shape[1] :] = 1000.0 * sigma[:, None]
        return self.net.decode_states(torch.cat([tokens, z], 1), levels, features.flatten(0, 1), self.views)[:, -self.chunk :].float()

    def decode(self, features: Tensor, commands: Tensor, past_commands: Tensor, past_states: Tensor, seed: Tensor, chunk_index: Tensor) -> Tensor:
        """See StateDecoder.decode."""
        tokens, last = self._tokens(commands, past_commands, past_states)
        rows = []
        for s, c in zip(seed.tolist(), chunk_index.tolist(), strict=True):
            generator = torch.Generator().manual_seed((int(s) * 999_983 + int(c)) & 0x7FFF_FFFF_FFFF)
            rows.append(torch.randn(self.chunk, STATE_DIM, generator=generator))
        z = torch.stack(rows).to(features.device)
        levels = torch.linspace(1.0, 0.0, self.config.steps + 1, device=z.device)
        for level, following in pairwise(levels):
            z = z + (following - level) * self._velocity(z, level.expand(len(z)), tokens, features)
        return (last + z) * self.state_std + self.state_mean

    def loss(self, features: Tensor, commands: Tensor, past_commands: Tensor, past_states: Tensor, truth: Tensor, valid: Tensor, generator: torch.Generator) -> Tensor:
        """Flow matching on the change from the last state; the past is disturbed a little, for in rollouts it is decoded too."""
        disturbed = past_states + 0.02 * self.state_std * torch.randn(past_states.shape, generator=generator).to(past_states.device)
        tokens, last = self._tokens(commands, past_commands, disturbed)
        target = (truth - self.state_mean) / self.state_std - last
        noise = torch.randn(target.shape, generator=generator).to(target.device)
        sigma = torch.rand(len(target), generator=generator).to(target.device)
        level = sigma[:, None, None]
        velocity = self._velocity((1 - level) * target + level * noise, sigma, tokens, features)
        error = (velocity - (noise - target)).square() * valid[..., None]
        return error.sum() / (valid.sum() * STATE_DIM).clamp(min=1)
