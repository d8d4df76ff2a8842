"""What a latent diffusion world is told of its noise levels, and what its steps share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from envs.simulators.dit.prediction import Prediction
from envs.simulators.samplers import Sampler


@dataclass(frozen=True)
class Diffusion:
    """How latents are noised and denoised.

    Args:
        sampler: how the flow is followed.
        prediction: what the network says.
        time_scale: what levels are multiplied with for the network.
        shift: of the levels drawn in training; above 1 favours noise.
        foreground: extra loss weight of where the last remembered frame differs from its median colour.
            By what is still to be said itself, things would be drawn wherever they may be.
        augment: chance that a clip's memory is augmented in training.
    """

    sampler: Sampler
    prediction: Prediction
    time_scale: float
    shift: float
    foreground: float
    augment: float


@dataclass(frozen=True)
class Given:
    """What stays the same at every step of a chunk.

    Args:
        memory: clean latents [B, V, C, M, h, w] of remembered frames.
        channels: beside the latents, [B, V, C', M + T', h, w].
        actions: action vectors [B, M + T', action_size], of a network that reads them.
        fps: shown frames per second, one for all or [B].
        text: prompt [1, L, D], or its keys and values for every block; None of a network that reads none.
    """

    memory: Tensor
    channels: Tensor
    actions: Tensor | None
    fps: float | Tensor
    text: Tensor | Sequence[tuple[Tensor, Tensor]] | None
