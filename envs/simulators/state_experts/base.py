"""The contract of what decodes the robot's states from a simulator's features."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.embodiment import Embodiment
from envs.simulators import memory
from envs.simulators.base import Simulator
from envs.simulators.compiling import Repeated


class StateDecoder(Repeated):
    """Turns features and commands into robot states.

    Args:
        memory_frames: frames of command and state history it reads, M.

    Attributes:
        normalised: whether its units came with its weights, so that data need not set them.
    """

    normalised = False

    def __init__(self, memory_frames: int):
        super().__init__()
        self.memory_frames = memory_frames

    @classmethod
    def check(cls, options: Mapping[str, Any], robot: Embodiment) -> None:
        """See that one of these options (section simulator.state_expert) can decode that robot's states,
        before hours are spent on the simulator whose features it shall read.

        Raises:
            ValueError: naming the key and the fix, of a class of Worldloop's or the expert's own.
        """

    def normalise(self, commands: Tensor, moves: Tensor, states: Tensor) -> None:
        """Take units from data; arguments as of Simulator.normalise."""
        raise NotImplementedError

    @torch.no_grad()
    def look(self, simulator: Simulator, inputs: TensorDict) -> Tensor:
        """What the frozen simulator makes of training inputs, [B, ...]: the same whatever the decoder has
        learned.
        """
        return simulator.features(inputs).float()

    def read(self, shown: Tensor) -> Tensor:
        """Features [B, *feature_shape] from what `look` showed; here what the decoder owns does learn."""
        return shown

    def attach(self, simulator: Simulator) -> None:
        """Tell the simulator what its features should be, if that is the decoder's to say."""

    def decode(
        self, features: Tensor, commands: Tensor, history: TensorDict, seed: Tensor, chunk_index: Tensor
    ) -> Tensor:
        """Robot states of one chunk.

        Args:
            features: [B, *feature_shape] of the simulator.
            commands: [B, K, A].
            history: TensorDict [B] with commands [M, A] and states [M, S] up to the chunk's start.
            seed, chunk_index: int64 [B], all the randomness there is.

        Returns:
            float32 [B, K, S].
        """
        raise NotImplementedError

    def follow(self, state: TensorDict, chunk: int, features: Tensor) -> Tensor:
        """Decode the chunk that a session has just made, and write it into its memory.

        Args:
            state: of the sessions after the step, changed in place.
            chunk: frames of that step, K.
            features: of that step.

        Returns:
            float32 [B, K, S].
        """
        recent = memory.recent(state, self.memory_frames + chunk)
        history = recent[:, : self.memory_frames]
        history.batch_size = state.shape
        commands = recent["commands"][:, -chunk:]
        decoded = self.decode(features, commands, history, state["seed"], state["chunk_index"])
        memory.write_states(state, decoded)
        return decoded

    def loss(
        self, features: Tensor, history: TensorDict, future: TensorDict, generator: torch.Generator
    ) -> Tensor:
        """Training loss against true states.

        Args:
            history: as of `decode`.
            future: TensorDict [B] with commands [K, A], states [K, S] and valid bool [K].
        """
        raise NotImplementedError
