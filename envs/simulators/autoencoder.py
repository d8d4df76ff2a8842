"""The video autoencoder of the DiT engine: every frame on its own, 8 x 8 pixels to 16 channels."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

STRIDE = 8


class _Residual(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.layers = nn.Sequential(nn.GroupNorm(8, width), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1), nn.GroupNorm(8, width), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


class Autoencoder(nn.Module):
    """Deterministic convolutional autoencoder with normalised latents.

    Args:
        channels: of the latent.
        width: channels at the latent's resolution.
    """

    latent_mean: Tensor
    latent_std: Tensor

    def __init__(self, channels: int = 16, width: int = 128):
        super().__init__()
        self.encoder = nn.Sequential(
            nn.Conv2d(3 * 16, width, 1), _Residual(width), nn.Conv2d(width, width, 2, stride=2), _Residual(width), _Residual(width), nn.GroupNorm(8, width), nn.SiLU(), nn.Conv2d(width, channels, 1)
        )
        self.decoder = nn.Sequential(
            nn.Conv2d(channels, width, 3, padding=1), _Residual(width), _Residual(width), nn.Conv2d(width, 4 * width, 1), nn.PixelShuffle(2), _Residual(width), nn.GroupNorm(8, width), nn.SiLU(), nn.Conv2d(width, 3 * 16, 1)
        )
        self.register_buffer("latent_mean", torch.zeros(channels))
        self.register_buffer("latent_std", torch.ones(channels))

    def encode(self, frames: Tensor) -> Tensor:
        """float [N, 3, H, W] in 0..1 -> normalised latents [N, C, H / 8, W / 8]."""
        raw = self.encoder(F.pixel_unshuffle(frames * 2 - 1, 4))
        return (raw - self.latent_mean[:, None, None]) / self.latent_std[:, None, None]

    def decode(self, latents: Tensor) -> Tensor:
        """Normalised latents [N, C, h, w] -> float [N, 3, 8 h, 8 w], about 0..1."""
        raw = latents * self.latent_std[:, None, None] + self.latent_mean[:, None, None]
        return F.pixel_shuffle(self.decoder(raw), 4) * 0.5 + 0.5

    @torch.no_grad()
    def normalise(self, frames: Tensor) -> None:
        """Set the latents' mean and spread from frames [N, 3, H, W]."""
        self.latent_mean.zero_()
        self.latent_std.fill_(1.0)
        raw = self.encode(frames).transpose(0, 1).flatten(1)
        self.latent_mean.copy_(raw.mean(1))
        self.latent_std.copy_(raw.std(1).clamp(min=1e-3))
