"""Stage: teach the DiT's video autoencoder to keep what matters in a few numbers per patch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.simulators.base import foreground_weight
from envs.simulators.dit.engine import DiTSimulator
from envs.simulators.tokenizers.autoencoder import Autoencoder
from learners.training.fit import FitConfig, fit


def train_tokenizer(
    simulator: DiTSimulator, store: ClipStore, episodes: Tensor, options: FitConfig, folder: Path
) -> dict[str, float]:
    """Train the simulator's autoencoder in place on single frames, then set its latents' units."""
    rows = store.rows(episodes)
    codec, gain = simulator.codec, simulator.foreground
    assert isinstance(codec, Autoencoder)

    def batch(step: int, generator: torch.Generator) -> Tensor:
        return store.frames(rows[torch.randint(len(rows), (options.part,), generator=generator)]).flatten(
            0, 1
        )

    def loss(frames: Tensor, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        truth = frames.float() / 255
        gap = codec.decode(codec.encode(truth)).float() - truth
        weight = foreground_weight(truth, gain)
        value = ((gap.abs() + 20 * gap.square()) * weight).sum() / (3 * weight.sum())
        psnr = -10 * gap.detach().square().mean().log10()
        return value, {"psnr": psnr}

    stats = fit("tokenizer", codec, batch, loss, options, folder, watch="psnr")
    device = next(codec.parameters()).device
    sample = store.frames(rows[:: max(1, len(rows) // 256)]).flatten(0, 1).to(device).float() / 255
    codec.normalise(sample)
    return stats
