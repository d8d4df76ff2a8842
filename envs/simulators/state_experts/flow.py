"""The DiT's state expert: joint states by flow matching on the frozen trunk's features, with command and
state history.

Tokens are, in order, past and future commands, past states, and the noisy future states. Under joint commands
(GE-Sim 2.0) commands and states are normalised apart; under end-effector commands they are offsets, and
states changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor

from envs.layouts import CommandLayout
from envs.simulators.base import Simulator
from envs.simulators.dit.latent_world import LatentWorld
from envs.simulators.dit.network import DiTShape, MultiViewDiT
from envs.simulators.samplers import Euler, Sampler
from envs.simulators.state_experts.base import StateDecoder
from envs.specs import STATE_DIM, to_relative

TOKEN = 16  # end-effector commands are padded to the width of states
_SHIFTS = (-3, -2, -1, 1, 2, 3)


@dataclass(frozen=True)
class StateExpertConfig:
    """Size of a state expert that is trained from nothing.

    Args:
        layers, heads, head_dim: of its blocks.
        steps: Euler steps per chunk.
    """

    layers: int = 4
    heads: int = 4
    head_dim: int = 32
    steps: int = 4

    def shape(self, trunk: DiTShape) -> DiTShape:
        """Sizes for the features of a trunk."""
        return DiTShape(
            num_layers=trunk.num_layers,
            num_attention_heads=trunk.num_attention_heads,
            attention_head_dim=trunk.attention_head_dim,
            pose_layers=self.layers,
            pose_num_attention_heads=self.heads,
            pose_attention_head_dim=self.head_dim,
        )


class StateExpert(StateDecoder):
    """Denoises the future states of a chunk among clean tokens of past and future commands and of past
    states.

    Args:
        net: the expert's half of a network.
        views: of the simulator whose features it reads; chunk: frames per chunk, K; memory: frames of
            history, M.
        layout: of the commands.
        sampler, time_scale: as of the simulator.
        every: of the history of `memory` frames only every so many-th, counted from the end, is read; chunks
            that
            never were are filled with the first command to come (how the released code keeps its history).
        tokens: of the trunk's, per view, that are read, the last ones; None reads all, as released.
        direct: whether the network says the states themselves instead of their velocity, as released; see
            `_says` of LatentWorld.
    """

    state_mean: Tensor
    state_std: Tensor
    action_mean: Tensor
    action_std: Tensor

    def __init__(
        self,
        net: MultiViewDiT,
        views: int,
        chunk: int,
        memory: int,
        layout: CommandLayout,
        sampler: Sampler | None = None,
        time_scale: float = 1000.0,
        every: int = 1,
        tokens: int | None = None,
        direct: bool = False,
    ):
        super().__init__(memory * every)
        self.tokens, self.direct = slice(None if tokens is None else -tokens, None), direct
        self.net, self.views, self.chunk, self.layout, self.every = net, views, chunk, layout, every
        self.sampler: Sampler = sampler or Euler()
        self.time_scale = time_scale
        for name in ("state", "action"):
            self.register_buffer(f"{name}_mean", torch.zeros(STATE_DIM))
            self.register_buffer(f"{name}_std", torch.ones(STATE_DIM))

    def normalise(self, states: Tensor, actions: Tensor | None = None) -> None:
        """Set units from joint states [N, 16], and from joint commands [N, 16] where those are the commands."""
        for name, values in (("state", states), ("action", states if actions is None else actions)):
            getattr(self, f"{name}_mean").copy_(values.mean(0))
            getattr(self, f"{name}_std").copy_(values.std(0).clamp(min=0.02))

    @torch.no_grad()
    def look(self, simulator: Simulator, inputs: TensorDict) -> Tensor:
        """See StateDecoder; what every block of the trunk says, [B, layers, V, tokens, width], as far as it
        is read.
        """
        assert isinstance(simulator, LatentWorld)
        return torch.stack(
            [layer[:, self.tokens].unflatten(0, (-1, self.views)) for layer in simulator.layers(inputs)], 1
        )

    def read(self, shown: Tensor) -> Tensor:
        """See StateDecoder; the mix of the trunk's blocks is the expert's own and is learned."""
        return self.net.fuse([layer.float() for layer in shown.unbind(1)])

    @torch.no_grad()
    def attach(self, simulator: Simulator) -> None:
        """See StateDecoder; the simulator mixes its blocks as was learned here."""
        assert isinstance(simulator, LatentWorld)
        simulator.net.video_buffer_weights.copy_(self.net.video_buffer_weights)
        simulator.net.video_buffer_norm.load_state_dict(self.net.video_buffer_norm.state_dict())

    def _tokens(self, commands: Tensor, past_commands: Tensor, past_states: Tensor) -> tuple[Tensor, Tensor]:
        """Clean tokens [B, M + K + M, 16], and what future states are counted from, in units [B, 1, 16]."""
        past = (past_states - self.state_mean) / self.state_std
        if self.layout is CommandLayout.JOINTS:
            moves = (torch.cat([past_commands, commands], 1) - self.action_mean) / self.action_std
            return torch.cat([moves, past], 1), torch.zeros_like(past[:, -1:])
        now = past_commands[:, -1]
        moves = torch.cat([to_relative(past_commands, now), to_relative(commands, now)], 1) * 10.0
        return torch.cat([F.pad(moves, (0, TOKEN - moves.shape[-1])), past], 1), past[:, -1:]

    def _says(
        self, z: Tensor, level: Tensor, tokens: Tensor, features: Tensor | list[tuple[Tensor, Tensor]]
    ) -> Tensor:
        """What the network says of noisy future states [B, K, 16] at noise level [B]: their velocity, or
        where they flow from.
        """
        levels = torch.zeros(len(z), tokens.shape[1] + self.chunk, device=z.device)
        levels[:, tokens.shape[1] :] = self.time_scale * level[:, None]
        return self.net.decode_states(torch.cat([tokens, z], 1), levels, features, self.views)[
            :, -self.chunk :
        ].float()

    def _thinned(self, past: Tensor, commands: Tensor, chunk_index: Tensor) -> Tensor:
        """Every so many-th of the past [B, M * every, 16], for chunks before the first the first command to
        come.
        """
        if self.every == 1:
            return past
        rows = past[:, self.every - 1 :: self.every]
        count = rows.shape[1]
        # finished chunks, the last of them last
        real = torch.arange(count, 0, -1, device=past.device) <= (chunk_index - 1)[:, None]
        return torch.where(real[..., None], rows, commands[:, :1])

    def decode(
        self,
        features: Tensor,
        commands: Tensor,
        past_commands: Tensor,
        past_states: Tensor,
        seed: Tensor,
        chunk_index: Tensor,
    ) -> Tensor:
        """See StateDecoder.decode."""
        past_commands, past_states = (
            self._thinned(past, commands, chunk_index) for past in (past_commands, past_states)
        )
        tokens, origin = self._tokens(commands, past_commands, past_states)
        rows = []
        for s, c in zip(seed.tolist(), chunk_index.tolist(), strict=True):
            generator = torch.Generator().manual_seed((int(s) * 999_983 + int(c)) & 0x7FFF_FFFF_FFFF)
            rows.append(torch.randn(self.chunk, STATE_DIM, generator=generator))
        noise = torch.stack(rows).to(features.device)
        known = self.net.feature_keys(features[:, :, self.tokens].flatten(0, 1), self.views)

        def velocity(z: Tensor, level: float) -> Tensor:
            said = self._says(z, torch.full((len(z),), level, device=z.device), tokens, known)
            return (z - said) / level if self.direct else said

        z = self.sampler(velocity, noise)
        return (origin + z) * self.state_std + self.state_mean

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
        """Flow matching on the future states; the past is disturbed, for in rollouts it is decoded too."""
        disturbed = disturb_history(past_states, generator) + 0.02 * self.state_std * torch.randn(
            past_states.shape, generator=generator
        ).to(past_states.device)
        tokens, origin = self._tokens(commands, past_commands, disturbed)
        target = (truth - self.state_mean) / self.state_std - origin
        noise = torch.randn(target.shape, generator=generator).to(target.device)
        level = torch.rand(len(target), generator=generator).to(target.device)
        mixed = level[:, None, None]
        said = self._says((1 - mixed) * target + mixed * noise, level, tokens, features.flatten(0, 1))
        # Said directly, a few that are far off should not hide that most could be nearer.
        error = (
            F.smooth_l1_loss(said, target, beta=0.05, reduction="none")
            if self.direct
            else (said - (noise - target)).square()
        )
        return (error * valid[..., None]).sum() / (valid.sum() * STATE_DIM).clamp(min=1)


def untrained_expert(simulator: LatentWorld, config: StateExpertConfig) -> StateExpert:
    """A state expert for the features of a simulator, of which it reads those of the chunk itself."""
    shape = simulator.shape
    tokens = simulator.feature_shape[1] * simulator.ahead // (shape.memory + simulator.ahead)
    return StateExpert(
        MultiViewDiT(config.shape(simulator.net.shape), trunk=False),
        shape.views,
        shape.chunk,
        shape.memory,
        shape.layout,
        Euler(config.steps),
        tokens=tokens,
        direct=True,
    )


def disturb_history(past: Tensor, generator: torch.Generator) -> Tensor:
    """History augmentation of GE-Sim 2.0: the past [B, M, D] shifted by 1 to 3 frames, and resampled to M - 1
    frames and back, each of a clip by chance 0.5.
    """
    batch, count, width = past.shape
    shift = torch.tensor(_SHIFTS)[torch.randint(len(_SHIFTS), (batch,), generator=generator)] * (
        torch.rand(batch, generator=generator) < 0.5
    )
    at = (torch.arange(count) + shift[:, None]).clamp(0, count - 1).to(past.device)
    moved = past.gather(1, at[..., None].expand(-1, -1, width))
    if count < 3:
        return moved
    coarse = F.interpolate(moved.transpose(1, 2), size=count - 1, mode="linear", align_corners=True)
    smooth = F.interpolate(coarse, size=count, mode="linear", align_corners=True).transpose(1, 2)
    chosen = (torch.rand(batch, generator=generator) < 0.5).to(past.device)
    return torch.where(chosen[:, None, None], smooth, moved)
