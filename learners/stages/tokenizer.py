"""Stage: teach a video autoencoder to keep what matters in a few numbers per patch."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from envs.episodes.clips import ClipStore
from envs.simulators.foreground import foreground_weight
from learners.training.fit import FitConfig, fit

_FOREGROUND = 12.0  # loss weight of a pixel that stands out, above the 1 of the background
_SQUARE = 20.0  # weight of squared errors beside absolute ones
_UNITS = 256  # frames from which the latents' units are taken


@runtime_checkable
class TrainableCodec(Protocol):
    """An autoencoder of single frames that data can teach."""

    def encode(self, frames: Tensor) -> Tensor:
        """Latents [N, C, h, w] of frames float [N, 3, H, W] in 0..1."""

    def decode(self, latents: Tensor) -> Tensor:
        """Frames float [N, 3, H, W], about 0..1, of latents."""

    def normalise(self, frames: Tensor) -> None:
        """Take the latents' units from frames [N, 3, H, W]."""


def train_tokenizer(
    simulator: nn.Module, store: ClipStore, episodes: Tensor, options: FitConfig, folder: Path
) -> dict[str, float]:
    """Train the simulator's autoencoder, `simulator.codec`, in place on single frames; then set its units.

    Raises:
        ValueError: if the simulator has none that can be trained.
    """
    codec = getattr(simulator, "codec", None)
    if not isinstance(codec, TrainableCodec) or not isinstance(codec, nn.Module):
        raise ValueError(
            f"{type(simulator).__name__} has no codec with encode, decode and normalise to train; leave the"
            " tokenizer stage out, or use simulator=dit"
        )
    rows = store.rows(episodes)
    rows = rows[store.arrays["present"][rows]]

    def batch(step: int, generator: torch.Generator) -> Tensor:
        chosen = rows[torch.randint(len(rows), (options.part,), generator=generator)]
        return store.frames(chosen).flatten(0, 1)

    def loss(frames: Tensor, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        truth = frames.float() / 255
        error = codec.decode(codec.encode(truth)).float() - truth
        weight = foreground_weight(truth, _FOREGROUND)
        value = ((error.abs() + _SQUARE * error.square()) * weight).sum() / (3 * weight.sum())
        return value, {"psnr": -10 * error.detach().square().mean().log10()}

    wanted = {name: parameter.requires_grad for name, parameter in codec.named_parameters()}
    codec.requires_grad_(True)  # engines keep it as it is while they learn
    stats = fit("tokenizer", codec, batch, loss, options, folder, watch="psnr")
    for name, parameter in codec.named_parameters():
        parameter.requires_grad_(wanted[name])
    device = next(codec.parameters()).device
    sample = store.frames(rows[:: max(1, len(rows) // _UNITS)]).flatten(0, 1).to(device).float() / 255
    codec.normalise(sample)
    return stats
