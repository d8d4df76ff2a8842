"""The main engine: GE-Sim 2.0's architecture at a small size, trained from nothing.

Latents of sparse memory frames and of the chunk to come stand in one sequence, with pose map, ray map and a memory
mask as further channels; memory is clean, the future is denoised by flow matching in a few Euler steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.conditioning import render_ray_map
from envs.simulators.autoencoder import STRIDE, Autoencoder
from envs.simulators.base import Simulator, WorldShape, foreground_weight, noise_generator
from envs.simulators.dit import DiTShape, MultiViewDiT
from envs.simulators.places import in_view, place_map

MEMORY_NOISE = 1e-4 / (1 + 1e-4)  # the noise level at which memory stands, as released


@dataclass(frozen=True)
class DiTConfig:
    """Size and sampling of the DiT engine.

    Args:
        layers, heads, head_dim, adaln_rank: of the trunk.
        state_heads, state_head_dim: of the state expert.
        patch: latent rows and columns per token.
        channels, codec_width: of the autoencoder.
        steps: Euler steps per chunk.
        shift: of the time-step distribution in training; above 1 favours noise.
        foreground: extra weight of latents over things that differ from the median colour.
        augment: chance that memory is disturbed in training, by noise of `augment_noise`.
    """

    layers: int = 6
    heads: int = 6
    head_dim: int = 32
    adaln_rank: int = 64
    state_heads: int = 4
    state_head_dim: int = 32
    patch: int = 2
    channels: int = 16
    codec_width: int = 96
    steps: int = 4
    shift: float = 2.0
    foreground: float = 8.0
    augment: float = 0.5
    augment_noise: float = 0.2


class DiTSimulator(Simulator):
    """Diffusion-transformer video world; see the module's docstring.

    Args:
        shape: what it shows; sizes must be multiples of 8 * patch.
        config: its size.
    """

    def __init__(self, shape: WorldShape, config: DiTConfig | None = None):
        super().__init__(shape)
        self.config = config = config or DiTConfig()
        if any(side % (STRIDE * config.patch) for side in shape.size):
            raise ValueError(f"task.size={list(shape.size)} must be multiples of {STRIDE * config.patch} for simulator.model.patch={config.patch}")
        self.codec = Autoencoder(config.channels, config.codec_width)
        self.net = MultiViewDiT(
            DiTShape(
                in_channels=config.channels + 3 + 6 + 1 + shape.objects,
                out_channels=config.channels,
                num_attention_heads=config.heads,
                attention_head_dim=config.head_dim,
                num_layers=config.layers,
                text_embed_dim=32,
                adaln_lora_dim=config.adaln_rank,
                patch_size=(1, config.patch, config.patch),
                rope_scale=(1.0, 1.0, 1.0),
                views=shape.views,
                pose_num_attention_heads=config.state_heads,
                pose_attention_head_dim=config.state_head_dim,
            )
        )
        self.prompt = nn.Parameter(torch.zeros(1, 1, 32), requires_grad=False)  # one fixed prompt, as released
        tokens = (shape.memory + shape.chunk) * (shape.size[0] // STRIDE // config.patch) * (shape.size[1] // STRIDE // config.patch)
        self.feature_shape = (shape.views, tokens, config.heads * config.head_dim)

    # -- inputs ----------------------------------------------------------------------------------------------------
    def encode(self, frames: Tensor) -> Tensor:
        """uint8 or float [B, T, V, 3, H, W] -> latents [B, V, C, T, h, w]; no gradient reaches the autoencoder."""
        pictures = frames.float() / 255 if frames.dtype == torch.uint8 else frames
        with torch.no_grad():
            flat = torch.cat([self.codec.encode(piece) for piece in pictures.flatten(0, 2).split(512)])
        return flat.float().unflatten(0, frames.shape[:3]).permute(0, 2, 3, 1, 4, 5)

    def decode(self, latents: Tensor) -> Tensor:
        """Latents [B, V, C, T, h, w] -> frames float [B, T, V, 3, H, W]."""
        flat = latents.permute(0, 3, 1, 2, 4, 5)
        return self.codec.decode(flat.flatten(0, 2)).float().unflatten(0, flat.shape[:3])

    def _conditioning(self, inputs: TensorDict, memory: Tensor) -> Tensor:
        """Channels [B, V, 3 + 6 + 1 + S, M + K, h, w]: pose map, ray map, memory mask, and spots of the objects, known from the last remembered frame on."""
        maps = torch.cat([inputs["memory", "pose_map"], inputs["future", "pose_map"]], 1).float() / 127.5 - 1
        small = F.interpolate(maps.flatten(0, 2), size=memory.shape[-2:], mode="bilinear", antialias=True).unflatten(0, maps.shape[:3])
        c2w = torch.cat([inputs["memory", "c2w"], inputs["future", "c2w"]], 1).transpose(1, 2)
        rays = render_ray_map(inputs["intrinsic"], c2w, self.shape.size, stride=STRIDE)  # [B, V, T, 6, h, w]
        mask = torch.zeros_like(rays[:, :, :, :1])
        mask[:, :, : self.shape.memory] = 1.0
        places = torch.cat([inputs["now", "places"][:, None], inputs["future", "places"]], 1)
        spots = place_map(in_view(places, inputs["intrinsic"], c2w[:, :, self.shape.memory - 1 :].transpose(1, 2), self.shape.size), *memory.shape[-2:])
        spots = F.pad(spots, (0, 0, 0, 0, 0, 0, self.shape.memory - 1, 0))
        return torch.cat([small.permute(0, 2, 1, 3, 4, 5), rays, mask, spots], 3).transpose(2, 3)

    def _velocity(self, future: Tensor, memory: Tensor, sigma: Tensor, conditioning: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity of the future latents [B, V, C, K, h, w] at noise level sigma [B], and the fused features."""
        latents = torch.cat([torch.cat([memory, future], 3), conditioning], 2)
        steps = torch.full((len(future), latents.shape[3]), MEMORY_NOISE, device=future.device)
        steps[:, self.shape.memory :] = sigma[:, None]
        views = self.shape.views
        # The public network embeds time steps as they are; at thousandfold they span the sinusoids' range.
        velocity, fused = self.net(latents.flatten(0, 1), 1000.0 * steps.repeat_interleave(views, 0), self.prompt.expand(len(future), -1, -1), views, self.shape.fps)
        return velocity.unflatten(0, (-1, views))[:, :, :, self.shape.memory :].float(), fused.unflatten(0, (-1, views))

    # -- contract --------------------------------------------------------------------------------------------------
    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator.predict; noise comes from (seed, chunk_index), features from the last step."""
        latents, fused = self._denoise(inputs)
        return self.decode(latents), fused

    def features(self, inputs: TensorDict) -> Tensor:
        """See Simulator.features; nothing is decoded to pixels."""
        return self._denoise(inputs)[1]

    def _denoise(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """Future latents [B, V, C, K, h, w] by Euler steps from noise, and the features of the last step."""
        memory = self.encode(inputs["memory", "frames"])
        conditioning = self._conditioning(inputs, memory)
        z = self._noise(inputs["seed"], inputs["chunk_index"], memory)
        fused = memory.new_zeros(())
        for level, following in pairwise(self._levels(memory.device)):
            velocity, fused = self._velocity(z, memory, level.expand(len(z)), conditioning)
            z = z + (following - level) * velocity
        return z, fused

    def _levels(self, device: torch.device) -> Tensor:
        even = torch.linspace(1.0, 0.0, self.config.steps + 1, device=device)
        return self.config.shift * even / (1 + (self.config.shift - 1) * even)

    def _noise(self, seed: Tensor, chunk_index: Tensor, like: Tensor) -> Tensor:
        """Noise [B, V, C, K, h, w], row by row from its own generator, so that it is the same in any batch."""
        _, views, channels, _, height, width = like.shape
        rows = []
        for s, c in zip(seed.tolist(), chunk_index.tolist(), strict=True):
            rows.append(torch.randn(views, channels, self.shape.chunk, height, width, generator=noise_generator(s, c)))
        return torch.stack(rows).to(like.device)

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Flow matching on the future latents of the last chunk; the chunks before it are the model's own."""
        chunk, chunks = self.shape.chunk, clip["memory", "index"].shape[1]
        drawn: Tensor | None = None
        value = torch.zeros((), device=clip.device)
        for number in range(chunks):
            part = slice(number * chunk, (number + 1) * chunk)
            inputs = self.asked(clip, number, drawn, generator)
            if number + 1 < chunks:
                with torch.no_grad():
                    pictures = (self.predict(inputs)[0].clamp(0, 1) * 255).round().to(torch.uint8)
                drawn = pictures if drawn is None else torch.cat([drawn, pictures], 1)
                continue
            truth = clip["future", "frames"][:, part]
            memory, target = self.encode(inputs["memory", "frames"]), self.encode(truth)
            conditioning = self._conditioning(inputs, memory)
            memory = self._disturb(memory, generator)
            draw = torch.rand(clip.shape, generator=generator).to(clip.device)
            sigma = self.config.shift * draw / (1 + (self.config.shift - 1) * draw)
            noise = torch.randn(target.shape, generator=generator).to(clip.device)
            level = sigma[:, None, None, None, None, None]
            velocity, _ = self._velocity((1 - level) * target + level * noise, memory, sigma, conditioning)
            weight = foreground_weight(truth.float() / 255, self.config.foreground)
            weight = F.avg_pool2d(weight.flatten(0, 2), STRIDE).unflatten(0, truth.shape[:3]).permute(0, 2, 3, 1, 4, 5)
            weight = weight * clip["future", "valid"][:, part][:, None, None, :, None, None]
            value = ((velocity - (noise - target)).square() * weight).sum() / (weight.sum() * target.shape[2]).clamp(min=1)
        return value, {}

    def _disturb(self, memory: Tensor, generator: torch.Generator) -> Tensor:
        """Memory augmentation: noise on all memory frames of some clips, so that own predictions are no surprise."""
        chosen = (torch.rand(len(memory), generator=generator) < self.config.augment).float().to(memory.device)
        strength = torch.rand(len(memory), generator=generator).to(memory.device) * self.config.augment_noise
        noise = torch.randn(memory.shape, generator=generator).to(memory.device)
        return memory + (chosen * strength)[:, None, None, None, None, None] * noise
