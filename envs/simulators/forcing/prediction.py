"""What a diffusion-forcing network says of frames that each have a noise level of their own.

Noisy latents are z = (1 - s) x + s e of data x, noise e and levels s in 0..1. Latents are [B, T, V, C, h, w],
levels [B, T, 1, 1, 1, 1].
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from envs.ranges import Positive
from envs.simulators.forcing.schedule import unit_parts


class Prediction(Protocol):
    """How the network's output is meant."""

    def base(self, z: Tensor, level: Tensor) -> Tensor | None:
        """What is known of the clean frames without the network, which sees it beside z; None for nothing."""

    def clean(self, output: Tensor, z: Tensor, level: Tensor, base: Tensor | None) -> Tensor:
        """The clean frames that it says."""

    def error(
        self, output: Tensor, truth: tuple[Tensor, Tensor], level: Tensor, base: Tensor | None
    ) -> Tensor:
        """What training squares; `truth` is (data, noise)."""


class V:
    """v = a e - b x with signal a and noise b at unit variance (Salimans & Ho 2022), as in WPE."""

    def base(self, z: Tensor, level: Tensor) -> Tensor | None:
        """See Prediction."""
        return None

    def clean(self, output: Tensor, z: Tensor, level: Tensor, base: Tensor | None) -> Tensor:
        """See Prediction."""
        signal, noise = unit_parts(level)
        return signal * z / ((1 - level).square() + level.square()).sqrt() - noise * output

    def error(
        self, output: Tensor, truth: tuple[Tensor, Tensor], level: Tensor, base: Tensor | None
    ) -> Tensor:
        """See Prediction."""
        signal, noise = unit_parts(level)
        return output - (signal * truth[1] - noise * truth[0])


class Clean:
    """The clean frames, as their distance from what a linear filter makes of the noisy ones so far.

    The filter is Kalman's for numbers that drift from frame to frame: a frame of pure noise after clean ones
    is taken for the last of those, one that is nearly clean for itself. An untrained network so repeats the
    newest frame, and learns what moves. The error is counted in the latents themselves, so that the first
    steps from noise weigh as much as any (see dit/prediction.py).

    Args:
        drift: variance that a frame adds, where the latents' own is 1.
    """

    def __init__(self, drift: Positive = 0.1):
        self.drift = drift

    def base(self, z: Tensor, level: Tensor) -> Tensor | None:
        """See Prediction; frame t depends on frames up to t."""
        mean, variance, means = torch.zeros_like(z[:, 0]), torch.ones_like(level[:, 0]), []
        for seen, noise in zip(z.unbind(1), level.unbind(1), strict=True):
            signal = 1 - noise
            total = signal.square() * variance + noise.square()
            mean = mean + variance * signal / total * (seen - signal * mean)
            means.append(mean)
            variance = variance * noise.square() / total + self.drift
        return torch.stack(means, 1)

    def clean(self, output: Tensor, z: Tensor, level: Tensor, base: Tensor | None) -> Tensor:
        """See Prediction."""
        assert base is not None
        return base + output

    def error(
        self, output: Tensor, truth: tuple[Tensor, Tensor], level: Tensor, base: Tensor | None
    ) -> Tensor:
        """See Prediction."""
        assert base is not None
        return base + output - truth[0]
