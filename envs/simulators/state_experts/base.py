"""The contract of what decodes joint states from a simulator's features."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.simulators.base import Simulator


class StateDecoder(nn.Module):
    """Turns features and commands into joint states.

    Args:
        memory: frames of command and state history it reads.

    Attributes:
        normalised: whether its units came with its weights, so that data need not set them.
    """

    normalised = False

    def __init__(self, memory: int):
        super().__init__()
        self.memory = memory

    def normalise(self, states: Tensor) -> None:
        """Set units from joint states [N, 16]."""
        raise NotImplementedError

    @torch.no_grad()
    def look(self, simulator: Simulator, inputs: TensorDict) -> Tensor:
        """What the frozen simulator makes of training inputs (Simulator.asked), [B, ...]: the same whatever
        the decoder has learned.
        """
        return simulator.features(inputs).float()

    def read(self, shown: Tensor) -> Tensor:
        """Features [B, *feature_shape] from what `look` showed; here what the decoder owns does learn."""
        return shown

    def attach(self, simulator: Simulator) -> None:
        """Tell the simulator what its features should be, if that is the decoder's to say."""

    def decode(
        self,
        features: Tensor,
        commands: Tensor,
        past_commands: Tensor,
        past_states: Tensor,
        seed: Tensor,
        chunk_index: Tensor,
    ) -> Tensor:
        """Joint states of one chunk.

        Args:
            features: [B, *feature_shape] of the simulator.
            commands: [B, K, A] absolute; past_commands: [B, M, A] and past_states: [B, M, 16] up to the
                chunk's start.
            seed, chunk_index: int64 [B], all the randomness there is.

        Returns:
            float32 [B, K, 16].
        """
        raise NotImplementedError

    def follow(self, simulator: Simulator, state: TensorDict, features: Tensor) -> Tensor:
        """Decode the chunk that a session has just made, and write it into its memory.

        Args:
            state: of the simulator after the step, changed in place.
            features: of that step.

        Returns:
            float32 [B, K, 16].
        """
        chunk = simulator.shape.chunk
        recent = simulator.recent(state, self.memory + chunk)
        decoded = self.decode(
            features,
            recent["commands"][:, -chunk:],
            recent["commands"][:, : self.memory],
            recent["states"][:, : self.memory],
            state["seed"],
            state["chunk_index"],
        )
        simulator.remember_states(state, decoded)
        return decoded

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
        """Training loss against true states [B, K, 16], where valid [B, K]."""
        raise NotImplementedError
