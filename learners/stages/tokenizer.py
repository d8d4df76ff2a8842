"""Stage: teach a video autoencoder to keep what matters in a few numbers, or tokens, per patch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from tqdm import tqdm

from envs.episodes.clips import ClipStore
from envs.targets import ConfigError
from learners.training.fit import FitConfig, fit

_UNITS = 256  # frames from which the latents' units are taken, and the last figures


@runtime_checkable
class TrainableCodec(Protocol):
    """An autoencoder of single frames that data can teach; frames are float [N, 3, H, W] in 0..1."""

    def loss(self, frames: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Its training loss, and figures to log, "psnr" among them."""

    def normalise(self, frames: Tensor) -> None:
        """Take the latents' units from frames, after training."""

    def figures(self, frames: Tensor) -> dict[str, float]:
        """How well it keeps frames, without learning."""

    def warning(self, figures: Mapping[str, float]) -> str:
        """What is wrong by these figures and what to do about it, "" if nothing is."""


@dataclass
class CodecAlarm:
    """Watches training for a codec that stays spoilt, and says so once.

    Args:
        codec: which is asked for warnings.
        patience: steps in a row before the alarm; a codec that has just begun may look spoilt.
    """

    codec: TrainableCodec
    patience: int = 100
    bad: int = 0
    message: str = ""

    def check(self, figures: Mapping[str, float]) -> None:
        """Look at one step's figures."""
        warning = self.codec.warning(figures)
        self.bad = self.bad + 1 if warning else 0
        if self.bad == self.patience:
            self.give(warning)

    def give(self, warning: str) -> None:
        """Give the alarm, unless it was given before."""
        if not self.message:
            tqdm.write(f"ALARM tokenizer: {warning}")
        self.message = warning


def train_tokenizer(
    model: nn.Module, store: ClipStore, episodes: Tensor, options: FitConfig, folder: Path
) -> dict[str, Any]:
    """Train the autoencoder of a model, `model.codec`, in place on single frames; then set its units.

    Returns:
        What `fit` does, the codec's last figures on frames of all episodes, and its alarm, "" if there was
        none.

    Raises:
        ConfigError: if the model has none that can be trained.
    """
    codec = getattr(model, "codec", None)
    if not isinstance(codec, TrainableCodec) or not isinstance(codec, nn.Module):
        raise ConfigError(
            f"{type(model).__name__} has no codec with a loss to train; leave the tokenizer stage out, or use"
            " simulator=dit or simulator=tokens"
        )
    rows = store.rows(episodes)
    rows = rows[store.arrays["present"][rows]]
    alarm = CodecAlarm(codec)

    def batch(step: int, generator: torch.Generator) -> Tensor:
        chosen = rows[torch.randint(len(rows), (options.part,), generator=generator)]
        return store.frames(chosen).flatten(0, 1)

    def loss(frames: Tensor, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        value, figures = codec.loss(frames.float() / 255)
        plain = {name: float(figure) for name, figure in figures.items()}
        alarm.check(plain)
        return value, plain

    wanted = {name: parameter.requires_grad for name, parameter in codec.named_parameters()}
    codec.requires_grad_(True)  # engines keep it as it is while they learn
    stats: dict[str, Any] = fit("tokenizer", codec, batch, loss, options, folder, watch="psnr")
    for name, parameter in codec.named_parameters():
        parameter.requires_grad_(wanted[name])
    device = next(codec.parameters()).device
    sample = store.frames(rows[:: max(1, len(rows) // _UNITS)]).flatten(0, 1).to(device).float() / 255
    codec.normalise(sample)
    last = codec.figures(sample)
    if warning := codec.warning(last):
        alarm.give(warning)
    return {**stats, **last, "alarm": alarm.message}
