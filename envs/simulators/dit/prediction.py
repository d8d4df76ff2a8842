"""What a latent diffusion network predicts, and the loss that fits it.

Noisy latents are z = (1 - s) x + s e of data x, noise e and level s in 0..1. All tensors are [B, V, C, T', h,
w].
"""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

Level = float | Tensor


class Prediction(Protocol):
    """How the network's output is meant."""

    def velocity(self, output: Tensor, z: Tensor, level: Level, base: Tensor) -> Tensor:
        """The velocity e - x at z, which samplers follow; `level` is one, or [B, 1, 1, 1, 1, 1], `base` the
        newest remembered latent.
        """

    def error(self, output: Tensor, clean: Tensor, noise: Tensor, base: Tensor) -> Tensor:
        """What training squares."""


class Velocity:
    """The velocity e - x, as released."""

    def velocity(self, output: Tensor, z: Tensor, level: Level, base: Tensor) -> Tensor:
        """See Prediction."""
        return output

    def error(self, output: Tensor, clean: Tensor, noise: Tensor, base: Tensor) -> Tensor:
        """See Prediction."""
        return output - (noise - clean)


class Clean:
    """The clean latents, as their change since the newest remembered frame.

    Small transformers learn to predict clean frames where they fail to predict noise (JiT). The error is
    counted in the latents themselves, not in velocities: weighted by 1 / s^2, levels near the data would
    decide, where a sampler of few steps never is; counted so, its first step from pure noise weighs as much
    as any other.
    """

    def velocity(self, output: Tensor, z: Tensor, level: Level, base: Tensor) -> Tensor:
        """See Prediction."""
        return (z - base - output) / level

    def error(self, output: Tensor, clean: Tensor, noise: Tensor, base: Tensor) -> Tensor:
        """See Prediction."""
        return base + output - clean


PREDICTIONS: dict[str, Prediction] = {"velocity": Velocity(), "clean": Clean()}
