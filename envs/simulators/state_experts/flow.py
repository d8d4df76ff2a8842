"""The DiT's state expert: joint states by flow matching on the frozen trunk's features (GE-Sim 2.0).

Tokens are, in order, past and future commands, past states, and the noisy future states; the narrower of
actions and states is padded with zeros.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import cast

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.commanded_states import joints_are_states
from envs.conditioning.turns import Turns
from envs.conditioning.units import LEAST_SPREAD, Units
from envs.embodiment import Embodiment
from envs.ranges import Count
from envs.rng import Noise, noise_generator
from envs.simulators.base import Simulator
from envs.simulators.dit.engine import TIME_SCALE
from envs.simulators.dit.latent_world import LatentWorld
from envs.simulators.dit.prediction import Clean, Prediction
from envs.simulators.dit.state_network import StateDiT
from envs.simulators.samplers import Euler, Sampler
from envs.simulators.state_experts.base import StateDecoder

_SHIFTS = (-3, -2, -1, 1, 2, 3)
_DISTURBANCE = 0.02  # noise on past states in training, in spreads: in rollouts they are decoded, too


class StateTokens(nn.Module):
    """Commands and states as tokens in units of the data.

    Where commands are joint targets of just the numbers that states hold by their names, both stand as they
    are, and states are predicted as they are (GE-Sim 2.0). Elsewhere commands are moves from the command in
    force (deltas are moves already), and states are predicted as changes since the last one.

    Args:
        embodiment: whose commands and states.

    Attributes:
        width: numbers of a token.
    """

    def __init__(self, embodiment: Embodiment):
        super().__init__()
        self.action_dim, self.state_dim = embodiment.action_dim, embodiment.state_dim
        self.width = max(self.action_dim, self.state_dim)
        self.absolute = joints_are_states(embodiment)
        self.moves = not self.absolute and not embodiment.delta
        self.turns = Turns(self.action_dim, embodiment.action_rotations)
        self.actions = Units(self.action_dim, least=LEAST_SPREAD)
        self.states = Units(self.state_dim, embodiment.state_rotations, LEAST_SPREAD)

    def normalise(self, commands: Tensor, moves: Tensor, states: Tensor) -> None:
        """Set units from commands [N, A], their moves within a chunk [N, A] and states [N, S]."""
        self.turns.fit(commands)
        self.actions.normalise(moves if self.moves else commands)
        if self.moves:
            self.actions.mean.zero_()
        self.states.normalise(states)

    def clean(self, commands: Tensor, past_commands: Tensor, past_states: Tensor) -> tuple[Tensor, Tensor]:
        """Clean tokens [B, M + K + M, width], and what future states are counted from, in units [B, 1, S]."""
        past = self.states(past_states)
        actions = torch.cat([past_commands, commands], 1)
        if self.moves:
            now = past_commands[:, -1:]
            actions = self.turns.nearest(actions, now) - now
        tokens = torch.cat([self.pad(self.actions(actions)), self.pad(past)], 1)
        return tokens, torch.zeros_like(past[:, -1:]) if self.absolute else past[:, -1:]

    def pad(self, values: Tensor) -> Tensor:
        """[..., n] as [..., width]."""
        return F.pad(values, (0, self.width - values.shape[-1]))


class FlowStateDecoder(StateDecoder):
    """Denoises the future states of a chunk among clean tokens of past and future commands and of past
    states.

    Args:
        simulator: whose features it reads.
        net: the network.
        sampler, time_scale, prediction: how its flow is followed, and what the network says.
        read_last: tokens of the trunk's, per view, that are read, the last ones; None reads all, as released.
        every: of the history only every so many-th frame, counted from the end, is read; chunks that never
            were are filled with the first command to come (how the released code keeps its history).
    """

    def __init__(
        self,
        simulator: LatentWorld,
        net: StateDiT,
        sampler: Sampler,
        time_scale: float,
        prediction: Prediction,
        read_last: int | None = None,
        every: int = 1,
    ):
        super().__init__(simulator.memory_frames * every)
        self.chunk, self.views, self.every = simulator.spec.chunk, simulator.spec.views, every
        self.net, self.sampler, self.time_scale, self.prediction = net, sampler, time_scale, prediction
        self.read_tokens = slice(None if read_last is None else -read_last, None)
        self.tokens = StateTokens(simulator.spec.embodiment)

    def repeated(self) -> Iterator[tuple[nn.Module, bool]]:
        """See Repeated; a chunk's few tokens keep no GPU busy."""
        yield from ((block, True) for block in self.net.pose_blocks)

    def normalise(self, commands: Tensor, moves: Tensor, states: Tensor) -> None:
        """See StateDecoder.normalise."""
        self.tokens.normalise(commands, moves, states)

    @torch.no_grad()
    def look(self, simulator: Simulator, inputs: TensorDict) -> Tensor:
        """See StateDecoder.look; outputs of every block of the trunk, [B, layers, V, tokens, width], as far
        as they are read.
        """
        layers = cast(LatentWorld, simulator).layers(inputs)
        return torch.stack([layer[:, self.read_tokens].unflatten(0, (-1, self.views)) for layer in layers], 1)

    def read(self, shown: Tensor) -> Tensor:
        """See StateDecoder.read; the mix of the trunk's blocks is the expert's own and is learned."""
        return self.net.fuse([layer.float() for layer in shown.unbind(1)])

    @torch.no_grad()
    def attach(self, simulator: Simulator) -> None:
        """See StateDecoder.attach; the simulator mixes its blocks as was learned here."""
        trunk = cast(LatentWorld, simulator).net
        trunk.video_buffer_weights.copy_(self.net.video_buffer_weights)
        trunk.video_buffer_norm.load_state_dict(self.net.video_buffer_norm.state_dict())

    def decode(
        self, features: Tensor, commands: Tensor, history: TensorDict, seed: Tensor, chunk_index: Tensor
    ) -> Tensor:
        """See StateDecoder.decode."""
        past_commands, past_states = (
            self._thinned(history[name], commands, chunk_index) for name in ("commands", "states")
        )
        tokens, origin = self.tokens.clean(commands, past_commands, past_states)
        keys = self.net.feature_keys(features[:, :, self.read_tokens])

        def velocity(z: Tensor, level: float) -> Tensor:
            output = self._run(z, torch.full((len(z),), level, device=z.device), tokens, keys)
            return self.prediction.velocity(output, z, level, torch.zeros_like(z))

        z = self.sampler(velocity, self._noise(seed, chunk_index).to(features.device))
        return self.tokens.states.values(origin + z)

    def loss(
        self, features: Tensor, history: TensorDict, future: TensorDict, generator: torch.Generator
    ) -> Tensor:
        """See StateDecoder.loss; the past is disturbed, for in rollouts it is decoded, too."""
        told = self.tokens.states
        # orientations told the nearest way, or what lies between two of them would be none
        past = told.turns.nearest(history["states"], history["states"][:, -1:])
        noise = torch.randn(past.shape, generator=generator).to(past.device)
        disturbed = disturb_history(past, generator) + _DISTURBANCE * told.std * noise
        kept = slice(self.every - 1, None, self.every)  # as in `decode`; the disturbance shifts by frames
        tokens, origin = self.tokens.clean(
            future["commands"], history["commands"][:, kept], disturbed[:, kept]
        )
        target = told.change(future["states"], told.values(origin))
        noise = torch.randn(target.shape, generator=generator).to(target.device)
        level = torch.rand(len(target), generator=generator).to(target.device)
        mixed = level[:, None, None]
        keys = self.net.feature_keys(features)
        output = self._run((1 - mixed) * target + mixed * noise, level, tokens, keys)
        error = self.prediction.error(output, target, noise, torch.zeros_like(target))
        valid = future["valid"].to(error.dtype)[..., None]
        return (self._cost(error) * valid).sum() / (valid.sum() * error.shape[-1]).clamp(min=1)

    def _cost(self, error: Tensor) -> Tensor:
        return error.square()

    def _run(self, z: Tensor, level: Tensor, tokens: Tensor, keys: list[tuple[Tensor, Tensor]]) -> Tensor:
        """The network's output [B, K, S] for noisy future states at noise level [B]."""
        levels = torch.zeros(len(z), tokens.shape[1] + self.chunk, device=z.device)
        levels[:, tokens.shape[1] :] = self.time_scale * level[:, None]
        output = self.net(torch.cat([tokens, self.tokens.pad(z)], 1), levels, keys)
        return output[:, -self.chunk :].float()

    def _noise(self, seed: Tensor, chunk_index: Tensor) -> Tensor:
        rows = []
        for s, c in zip(seed.tolist(), chunk_index.tolist(), strict=True):
            generator = noise_generator(s, c, Noise.STATE)
            rows.append(torch.randn(self.chunk, self.tokens.state_dim, generator=generator))
        return torch.stack(rows)

    def _thinned(self, past: Tensor, commands: Tensor, chunk_index: Tensor) -> Tensor:
        """Every so many-th of the past [B, M * every, n], for chunks before the first the first command to
        come.
        """
        if self.every == 1:
            return past
        rows = past[:, self.every - 1 :: self.every]
        count = rows.shape[1]
        # finished chunks, the last of them last
        real = torch.arange(count, 0, -1, device=past.device) <= (chunk_index - 1)[:, None]
        return torch.where(real[..., None], rows, commands[:, :1])


class StateExpert(FlowStateDecoder):
    """A state expert trained from nothing, of which it reads the features of the chunk itself.

    It says the states themselves and not their velocity: with few steps that is nearer.

    Args:
        simulator: whose features it reads.
        layers, heads, head_dim: of its blocks.
        steps: Euler steps per chunk.
    """

    def __init__(self, simulator: LatentWorld, layers: Count, heads: Count, head_dim: Count, steps: Count):
        robot = simulator.spec.embodiment
        shape = replace(
            simulator.net.shape,
            pose_in_channels=max(robot.action_dim, robot.state_dim),
            pose_out_channels=robot.state_dim,
            pose_layers=layers,
            pose_num_attention_heads=heads,
            pose_attention_head_dim=head_dim,
        )
        ahead = simulator.feature_shape[1] * simulator.ahead // (simulator.memory_frames + simulator.ahead)
        super().__init__(simulator, StateDiT(shape), Euler(steps, 1.0), TIME_SCALE, Clean(), read_last=ahead)

    def _cost(self, error: Tensor) -> Tensor:
        # A few that are far off should not hide that most could be nearer.
        return F.smooth_l1_loss(error, torch.zeros_like(error), beta=0.05, reduction="none")


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
