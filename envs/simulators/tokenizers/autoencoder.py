"""Video autoencoders: the contract that latent worlds ask for, and our own, every frame on its own, 8 x 8
pixels to 16 channels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.ranges import Count
from envs.simulators.tokenizers.convolutions import FOLD, decoder, encoder
from envs.simulators.tokenizers.errors import picture_error, psnr

STRIDE = 8


class Codec(nn.Module):
    """Pictures to latents and back, 8 x 8 pixels to one place; pictures are float in 0..1.

    Attributes:
        channels: of a latent.
        period: frames that share a latent, after a first frame that has one of its own.
    """

    channels: int
    period: int = 1

    def latents_of(self, frames: int) -> int:
        """Latent frames of a clip.

        Raises:
            ValueError: if a clip of that length cannot be encoded.
        """
        if (frames - 1) % self.period:
            raise ValueError(
                f"task.chunk={frames} must be 1 + a multiple of {self.period} for this autoencoder"
            )
        return 1 + (frames - 1) // self.period

    def repeated(self) -> Iterator[nn.Module]:
        """Parts that are worth compiling (compiling.py); here none is."""
        return iter(())

    def encode(self, frames: Tensor) -> Tensor:
        """Stills [N, 3, H, W] -> normalised latents [N, C, H / 8, W / 8]."""
        raise NotImplementedError

    def encode_clips(self, clips: Tensor) -> Tensor:
        """Clips [N, T, 3, H, W] -> normalised latents [N, C, T', H / 8, W / 8]."""
        raise NotImplementedError

    def decode_clips(self, latents: Tensor) -> Tensor:
        """Normalised latents [N, C, T', h, w] -> clips [N, T, 3, 8 h, 8 w], about 0..1."""
        raise NotImplementedError

    def pool_time(self, values: Tensor) -> Tensor:
        """Means [N, T', ...] over the frames that share a latent, of numbers per frame [N, T, ...]."""
        if self.period == 1:
            return values
        return torch.cat([values[:, :1], values[:, 1:].unflatten(1, (-1, self.period)).mean(2)], 1)


class Autoencoder(Codec):
    """Deterministic convolutional autoencoder with normalised latents.

    Args:
        channels: of the latent.
        width: channels at the latent's resolution.
    """

    latent_mean: Tensor
    latent_std: Tensor

    def __init__(self, channels: Count, width: Count):
        super().__init__()
        self.channels = channels
        self.encoder, self.decoder = encoder(channels, width), decoder(channels, width)
        self.register_buffer("latent_mean", torch.zeros(channels))
        self.register_buffer("latent_std", torch.ones(channels))

    def encode(self, frames: Tensor) -> Tensor:
        """See Codec."""
        raw = self.encoder(F.pixel_unshuffle(frames * 2 - 1, FOLD))
        return (raw - self.latent_mean[:, None, None]) / self.latent_std[:, None, None]

    def decode(self, latents: Tensor) -> Tensor:
        """Normalised latents [N, C, h, w] -> stills [N, 3, 8 h, 8 w], about 0..1."""
        raw = latents * self.latent_std[:, None, None] + self.latent_mean[:, None, None]
        return F.pixel_shuffle(self.decoder(raw), FOLD) * 0.5 + 0.5

    def encode_clips(self, clips: Tensor) -> Tensor:
        """See Codec."""
        return self.encode(clips.flatten(0, 1)).unflatten(0, clips.shape[:2]).transpose(1, 2)

    def decode_clips(self, latents: Tensor) -> Tensor:
        """See Codec."""
        flat = latents.transpose(1, 2)
        return self.decode(flat.flatten(0, 1)).unflatten(0, flat.shape[:2])

    def loss(self, frames: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Training loss of stills [N, 3, H, W], and how well they are kept."""
        made = self.decode(self.encode(frames)).float()
        return picture_error(made, frames), {"psnr": psnr(made, frames)}

    @torch.no_grad()
    def figures(self, frames: Tensor) -> dict[str, float]:
        """PSNR in dB on stills."""
        return {"psnr": float(psnr(self.decode(self.encode(frames)).float(), frames))}

    def warning(self, figures: Mapping[str, float]) -> str:
        """Nothing can collapse here."""
        return ""

    @torch.no_grad()
    def normalise(self, frames: Tensor) -> None:
        """Set the latents' mean and spread from frames [N, 3, H, W]."""
        self.latent_mean.zero_()
        self.latent_std.fill_(1.0)
        raw = self.encode(frames).transpose(0, 1).flatten(1)
        self.latent_mean.copy_(raw.mean(1))
        self.latent_std.copy_(raw.std(1).clamp(min=1e-3))
