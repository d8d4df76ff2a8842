"""What every latent diffusion world shares, small or 2B: GE-Sim 2.0's way from remembered frames to a chunk of new ones.

Latents of sparse memory frames and of the chunk to come stand in one sequence, with pose map, ray map and a memory
mask as further channels; memory is clean, the future is denoised along the flow.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.simulators.augment import chosen_clips, spoil_latents, spoil_pictures
from envs.simulators.autoencoder import STRIDE, Codec
from envs.simulators.base import Simulator, WorldShape, foreground_weight, noise_generator
from envs.simulators.dit import MultiViewDiT
from envs.simulators.sampling import Sampler

MEMORY_NOISE = 1e-4 / (1 + 1e-4)  # the noise level at which memory stands, as released


class LatentWorld(Simulator):
    """Diffusion-transformer video world; see the module's docstring. A subclass says how conditioning is resized.

    Args:
        shape: what it shows; sizes must be multiples of the autoencoder's stride times the patch.
        net: trunk (and state expert).
        codec: video autoencoder.
        prompt: [1, L, D], the one text embedding; the task's words never reach the simulator.
        sampler: how the flow is followed.
        time_scale: what levels are multiplied with for the network.
        shift: of the levels drawn in training; above 1 favours noise.
        foreground: extra weight of latents over things that differ from the median colour.
        augment: chance that a clip's memory is spoilt in training.
    """

    prompt: Tensor

    def __init__(self, shape: WorldShape, net: MultiViewDiT, codec: Codec, prompt: Tensor, sampler: Sampler, time_scale: float, shift: float, foreground: float, augment: float):
        super().__init__(shape)
        patch = net.shape.patch_size
        unit = (STRIDE * patch[1], STRIDE * patch[2])
        if shape.size[0] % unit[0] or shape.size[1] % unit[1]:
            raise ValueError(f"task.size={list(shape.size)} must be multiples of {list(unit)} for this network's patches")
        self.net, self.codec, self.sampler = net, codec, sampler
        self.register_buffer("prompt", prompt)
        self.time_scale, self.shift, self.foreground, self.augment = time_scale, shift, foreground, augment
        self.ahead = codec.latents_of(shape.chunk)  # latent frames of a chunk
        tokens = (shape.memory + self.ahead) * (shape.size[0] // unit[0]) * (shape.size[1] // unit[1])
        self.feature_shape = (shape.views, tokens, net.shape.width)

    # -- what a subclass gives -----------------------------------------------------------------------------------
    def conditioning(self, inputs: TensorDict, places: tuple[int, int]) -> Tensor:
        """Channels [B, V, C, M + T', h, w] beside the latents, at places = (h, w): pose map, ray map, memory mask, and what else the network reads."""
        raise NotImplementedError

    # -- latents ---------------------------------------------------------------------------------------------------
    def remember(self, frames: Tensor) -> Tensor:
        """Latents [B, V, C, M, h, w] of memory frames, float [B, M, V, 3, H, W] in 0..1, each encoded on its own."""
        with torch.no_grad():
            flat = torch.cat([self.codec.encode(piece) for piece in frames.flatten(0, 2).split(512)])
        return flat.float().unflatten(0, frames.shape[:3]).permute(0, 2, 3, 1, 4, 5)

    def encode(self, frames: Tensor) -> Tensor:
        """Latents [B, V, C, T', h, w] of a chunk, float [B, T, V, 3, H, W] in 0..1; no gradient reaches the autoencoder."""
        views = frames.transpose(1, 2)
        with torch.no_grad():
            return self.codec.encode_clips(views.flatten(0, 1)).float().unflatten(0, views.shape[:2])

    def decode(self, latents: Tensor) -> Tensor:
        """Frames float [B, T, V, 3, H, W] of latents [B, V, C, T', h, w]."""
        clips = self.codec.decode_clips(latents.flatten(0, 1)).float()
        return clips.unflatten(0, latents.shape[:2]).transpose(1, 2)

    def _velocity(self, future: Tensor, memory: Tensor, level: Tensor, conditioning: Tensor, layers: list[Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """Velocity of the future latents [B, V, C, T', h, w] at noise level [B], and the fused features."""
        latents = torch.cat([torch.cat([memory, future], 3), conditioning], 2)
        steps = torch.full((len(future), latents.shape[3]), MEMORY_NOISE, device=future.device)
        steps[:, self.shape.memory :] = level[:, None]
        views = self.shape.views
        velocity, fused = self.net(latents.flatten(0, 1), self.time_scale * steps.repeat_interleave(views, 0), self.prompt.expand(len(future), -1, -1), views, self.shape.fps, layers)
        return velocity.unflatten(0, (-1, views))[:, :, :, self.shape.memory :].float(), fused.unflatten(0, (-1, views))

    # -- contract --------------------------------------------------------------------------------------------------
    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator.predict; noise comes from (seed, chunk_index), features from the last step."""
        latents, fused = self._denoise(inputs)
        return self.decode(latents), fused

    def features(self, inputs: TensorDict) -> Tensor:
        """See Simulator.features; nothing is decoded to pixels."""
        return self._denoise(inputs)[1]

    def layers(self, inputs: TensorDict) -> list[Tensor]:
        """What every block of the trunk says at the last step, each [B * V, tokens, width], from which the state expert learns its mix."""
        said: list[Tensor] = []
        self._denoise(inputs, said)
        return said

    def _denoise(self, inputs: TensorDict, layers: list[Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """Future latents [B, V, C, T', h, w], and the features of the last step."""
        memory = self.remember(unit(inputs["memory", "frames"]))
        conditioning = self.conditioning(inputs, (memory.shape[-2], memory.shape[-1]))
        kept: list[Tensor] = []

        def velocity(z: Tensor, level: float) -> Tensor:
            if layers is not None:
                layers.clear()
            value, fused = self._velocity(z, memory, torch.full((len(z),), level, device=z.device), conditioning, layers)
            kept[:] = [fused]
            return value

        return self.sampler(velocity, self._noise(inputs["seed"], inputs["chunk_index"], memory)), kept[0]

    def _noise(self, seed: Tensor, chunk_index: Tensor, like: Tensor) -> Tensor:
        """Noise [B, V, C, T', h, w], row by row from its own generator, so that it is the same in any batch."""
        _, views, channels, _, height, width = like.shape
        rows = []
        for s, c in zip(seed.tolist(), chunk_index.tolist(), strict=True):
            rows.append(torch.randn(views, channels, self.ahead, height, width, generator=noise_generator(s, c)))
        return torch.stack(rows).to(like.device)

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Flow matching on the future latents of the last chunk (memory has no loss); the chunks before it are the model's own."""
        chunk, chunks = self.shape.chunk, clip["memory", "index"].shape[1]
        drawn: Tensor | None = None
        for number in range(chunks - 1):
            with torch.no_grad():
                pictures = (self.predict(self.asked(clip, number, drawn, generator))[0].clamp(0, 1) * 255).round().to(torch.uint8)
            drawn = pictures if drawn is None else torch.cat([drawn, pictures], 1)
        inputs, part = self.asked(clip, chunks - 1, drawn, generator), slice((chunks - 1) * chunk, chunks * chunk)
        truth = unit(clip["future", "frames"][:, part])
        spoilt = chosen_clips(len(truth), self.augment, generator)
        memory = spoil_latents(self.remember(spoil_pictures(unit(inputs["memory", "frames"]), spoilt, generator)), spoilt, generator)
        target = self.encode(truth)
        conditioning = self.conditioning(inputs, (memory.shape[-2], memory.shape[-1]))
        draw = torch.rand(clip.shape, generator=generator).to(clip.device)
        level = self.shift * draw / (1 + (self.shift - 1) * draw)
        noise = torch.randn(target.shape, generator=generator).to(clip.device)
        mixed = level[:, None, None, None, None, None]
        velocity, _ = self._velocity((1 - mixed) * target + mixed * noise, memory, level, conditioning)
        weight = foreground_weight(truth, self.foreground) * clip["future", "valid"][:, part][:, :, None, None, None, None]
        weight = torch.nn.functional.avg_pool2d(self.codec.pool_time(weight).flatten(0, 2), STRIDE).unflatten(0, (len(truth), self.ahead, -1)).permute(0, 2, 3, 1, 4, 5)
        value = ((velocity - (noise - target)).square() * weight).sum() / (weight.sum() * target.shape[2]).clamp(min=1)
        return value, {}


def unit(frames: Tensor) -> Tensor:
    """Frames as float in 0..1, from uint8 or float."""
    return frames.float() / 255 if frames.dtype == torch.uint8 else frames
