"""The Wan video autoencoder behind our contract: diffusers' AutoencoderKLWan, 4 frames to a latent after the
first.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from diffusers import AutoencoderKLWan
from diffusers.models.autoencoders.autoencoder_kl_wan import WanCausalConv3d, WanRMS_norm
from torch import Tensor, nn

from envs.simulators.tokenizers.autoencoder import STRIDE, Codec


class WanCodec(Codec):
    """Encodes to the mode of the posterior and normalises by the means and spreads of the VAE's own
    configuration.

    Args:
        vae: with a temporal stride of 4 and a spatial one of 8.
        pixels: of the pictures side by side in one call; more is faster and needs more memory.
    """

    latent_mean: Tensor
    latent_std: Tensor

    def __init__(self, vae: AutoencoderKLWan, pixels: int = 3 * 384 * 512):
        super().__init__()
        self.vae, self.pixels = vae.requires_grad_(False), pixels
        # cuDNN's convolutions then need not turn what they read
        nn.utils.convert_conv3d_weight_memory_format(vae, torch.channels_last_3d)
        self.channels, self.period = int(vae.config.z_dim), int(vae.config.scale_factor_temporal)
        if int(vae.config.scale_factor_spatial) != STRIDE:
            raise ValueError(
                f"the VAE has a spatial stride of {vae.config.scale_factor_spatial}, latent worlds need"
                f" {STRIDE}"
            )
        for name, values in (
            ("latent_mean", vae.config.latents_mean),
            ("latent_std", vae.config.latents_std),
        ):
            self.register_buffer(
                name, torch.tensor(values, dtype=torch.float32).view(1, -1, 1, 1, 1), persistent=False
            )

    def repeated(self) -> Iterator[nn.Module]:
        """See Codec; norms, and convolutions with their padding and the frames kept from before. A residual
        block would be compiled anew for each place it has in the list of kept frames.
        """
        kinds = (WanCausalConv3d, WanRMS_norm)
        return (part for part in self.vae.modules() if isinstance(part, kinds))

    @classmethod
    def load(cls, folder: Path) -> WanCodec:
        """The VAE of a folder in diffusers' layout, as safetensors: other files of weights may hold code."""
        vae = AutoencoderKLWan.from_pretrained(
            str(folder), torch_dtype=torch.float32, local_files_only=True, use_safetensors=True
        )
        return cls(vae)

    def _together(self, pixels: int) -> int:
        """Clips of so many pixels a frame that are taken in one call."""
        return max(1, self.pixels // pixels)

    def encode_clips(self, clips: Tensor) -> Tensor:
        """See Codec."""
        video = (clips * 2 - 1).transpose(1, 2).to(self.vae.dtype)
        raw = torch.cat(
            [
                self.vae.encode(part).latent_dist.mode()
                for part in video.split(self._together(video.shape[-2] * video.shape[-1]))
            ]
        )
        return (raw.float() - self.latent_mean) / self.latent_std

    def encode(self, frames: Tensor) -> Tensor:
        """See Codec; every still is a clip of its own, as GE-Sim encodes its memory."""
        return self.encode_clips(frames[:, None])[:, :, 0]

    def decode_clips(self, latents: Tensor) -> Tensor:
        """See Codec."""
        raw = (latents * self.latent_std + self.latent_mean).to(self.vae.dtype)
        video = torch.cat(
            [
                self.vae.decode(part, return_dict=False)[0]
                for part in raw.split(self._together(raw.shape[-2] * raw.shape[-1] * STRIDE**2))
            ]
        )
        return video.float().transpose(1, 2) * 0.5 + 0.5
