"""What an engine that denoises in steps offers beside the Simulator contract, so that a few-step student can
be made of it (learners/stages/distill).

Noisy latents are z = (1 - s) x + s e of data x, noise e and level s in 0..1; z, x and e are float32 [B, ...],
whatever the engine's latents look like. What is given to every step alike is of a class of the engine's own.
"""

from __future__ import annotations

import abc
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.simulators.base import Simulator
from envs.simulators.samplers import Sampler


def lost_jumps(sampler: Sampler) -> str:
    """What a loss that knows nothing of jumps takes from weights that are sampled so; "" for nothing."""
    if not sampler.jumps:
        return ""
    steps = sampler.evaluations
    return (
        f"these weights sample in {steps} distilled steps, and flow matching takes that out of them: what"
        " they learn here is right in many steps, and blurred in few. Distil again"
        f" (distill.steps={steps}), or sample undistilled"
    )


class Stepwise(Simulator, abc.ABC):
    """A simulator that can be a teacher, a student, and the critic between them.

    Attributes:
        codec: what is trained apart and stays as it is; teacher, student and critic share it.
    """

    codec: torch.nn.Module

    @property
    @abc.abstractmethod
    def sampler(self) -> Sampler:
        """The way from noise to data that `predict` takes; a student's is Distilled."""

    @abc.abstractmethod
    def chunk_of(self, clip: TensorDict, generator: torch.Generator) -> tuple[TensorDict, Tensor]:
        """A chunk of a training clip [B], whose memory shows the engine's own frames of the chunks before.

        Returns:
            the inputs of `predict`, and loss weights that broadcast over latents, 0 past an episode's end.
        """

    @abc.abstractmethod
    def prepare(self, inputs: TensorDict) -> Any:
        """What all steps share: clean remembered latents, and the conditioning."""

    @abc.abstractmethod
    def noise(self, inputs: TensorDict, given: Any) -> Tensor:
        """Standard normal noise like the chunk's latents, by each row's seed and chunk index."""

    @abc.abstractmethod
    def velocity(self, z: Tensor, level: Tensor, given: Any) -> Tensor:
        """The velocity e - x at z, at noise level [B]."""
