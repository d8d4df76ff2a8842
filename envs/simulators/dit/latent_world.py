"""What every latent diffusion world shares, small or 2B: GE-Sim 2.0's way from remembered frames to a chunk
of new ones.

Latents of sparse memory frames and of the chunk to come stand in one sequence, with pose map, ray map and a
memory
mask as further channels; memory is clean, the future is denoised along the flow. A world that has drafts of
the frames to come (draft.py) denoises
corrections of their latents instead.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor

from envs.simulators.base import Simulator, WorldShape, foreground_weight, noise_generator, to_bytes
from envs.simulators.dit.augment import augment_memory_frames, augment_memory_latents, chosen_clips
from envs.simulators.dit.network import MultiViewDiT
from envs.simulators.samplers import Sampler
from envs.simulators.tokenizers.autoencoder import STRIDE, Codec

_CORRECTION = 0.5  # standard deviation of corrections, in latents of deviation one
_CHANGED = 0.15  # of 0..1, by which a pixel was corrected beyond which nothing of the draft is put back
MEMORY_NOISE = 1e-4 / (1 + 1e-4)  # the noise level at which memory stands, as released


class _Setting(NamedTuple):
    """conditioning [B, V, C, M + T', h, w]; draft frames [B, K, V, 3, H, W] and their latents base [B, V, C,
    T', h, w], if there are any.
    """

    conditioning: Tensor
    draft: Tensor | None
    base: Tensor | None


class LatentWorld(Simulator):
    """Diffusion-transformer video world; see the module's docstring. A subclass says how conditioning is
    resized.

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

    def __init__(
        self,
        shape: WorldShape,
        net: MultiViewDiT,
        codec: Codec,
        prompt: Tensor,
        sampler: Sampler,
        time_scale: float,
        shift: float,
        foreground: float,
        augment: float,
    ):
        super().__init__(shape)
        patch = net.shape.patch_size
        unit = (STRIDE * patch[1], STRIDE * patch[2])
        if shape.size[0] % unit[0] or shape.size[1] % unit[1]:
            raise ValueError(
                f"task.size={list(shape.size)} must be multiples of {list(unit)} for this network's patches"
            )
        self.net, self.codec, self.sampler = net, codec, sampler
        self.register_buffer("prompt", prompt)
        self.time_scale, self.shift, self.foreground, self.augment = time_scale, shift, foreground, augment
        self.ahead = codec.latents_of(shape.chunk)  # latent frames of a chunk
        tokens = (shape.memory + self.ahead) * (shape.size[0] // unit[0]) * (shape.size[1] // unit[1])
        self.feature_shape = (shape.views, tokens, net.shape.width)

    # -- what a subclass gives
    # -----------------------------------------------------------------------------------
    def conditioning(self, inputs: TensorDict, places: tuple[int, int]) -> Tensor:
        """Channels [B, V, C, M + T', h, w] beside the latents, at places = (h, w): pose map, ray map, memory
        mask, and what else the network reads.
        """
        raise NotImplementedError

    def drafted(self, inputs: TensorDict) -> Tensor | None:
        """Drafts of the chunk, float [B, K, V, 3, H, W] in 0..1, if this world corrects drafts; their latents
        then stand beside the conditioning.
        """
        return None

    # -- latents
    # ---------------------------------------------------------------------------------------------------
    def remember(self, frames: Tensor) -> Tensor:
        """Latents [B, V, C, M, h, w] of memory frames, float [B, M, V, 3, H, W] in 0..1, each encoded on its
        own.
        """
        with torch.no_grad():
            flat = torch.cat([self.codec.encode(piece) for piece in frames.flatten(0, 2).split(512)])
        return flat.float().unflatten(0, frames.shape[:3]).permute(0, 2, 3, 1, 4, 5)

    def encode(self, frames: Tensor) -> Tensor:
        """Latents [B, V, C, T', h, w] of a chunk, float [B, T, V, 3, H, W] in 0..1; no gradient reaches the
        autoencoder.
        """
        views = frames.transpose(1, 2)
        with torch.no_grad():
            return self.codec.encode_clips(views.flatten(0, 1)).float().unflatten(0, views.shape[:2])

    def decode(self, latents: Tensor) -> Tensor:
        """Frames float [B, T, V, 3, H, W] of latents [B, V, C, T', h, w]."""
        clips = self.codec.decode_clips(latents.flatten(0, 1)).float()
        return clips.unflatten(0, latents.shape[:2]).transpose(1, 2)

    def _setting(self, inputs: TensorDict, memory: Tensor) -> _Setting:
        """What stays the same at every step of a chunk."""
        conditioning, draft = (
            self.conditioning(inputs, (memory.shape[-2], memory.shape[-1])),
            self.drafted(inputs),
        )
        if draft is None:
            return _Setting(conditioning, None, None)
        base = self.encode(draft)
        return _Setting(
            torch.cat([conditioning, F.pad(base, (0, 0, 0, 0, self.shape.memory, 0))], 2), draft, base
        )

    def _says(
        self,
        future: Tensor,
        memory: Tensor,
        level: Tensor,
        conditioning: Tensor,
        layers: list[Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """What the network says of the future latents [B, V, C, T', h, w] at noise level [B], and the fused
        features.

        Of whole latents it says their velocity, as released. Of corrections it says the correction: for the
            most part
        that is nothing, which a network says well from the start, where nothing by velocity is a cancellation
        of noise.
        """
        latents = torch.cat([torch.cat([memory, future], 3), conditioning], 2)
        steps = torch.full((len(future), latents.shape[3]), MEMORY_NOISE, device=future.device)
        steps[:, self.shape.memory :] = level[:, None]
        views = self.shape.views
        velocity, fused = self.net(
            latents.flatten(0, 1),
            self.time_scale * steps.repeat_interleave(views, 0),
            self.prompt.expand(len(future), -1, -1),
            views,
            self.shape.fps,
            layers,
        )
        return velocity.unflatten(0, (-1, views))[:, :, :, self.shape.memory :].float(), fused.unflatten(
            0, (-1, views)
        )

    # -- contract
    # --------------------------------------------------------------------------------------------------
    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator.predict; noise comes from (seed, chunk_index), features from the last step."""
        latents, fused, setting = self._denoise(inputs)
        frames = self.decode(latents)
        if setting.draft is None or setting.base is None:
            return to_bytes(frames), fused
        # Where the draft needs no correction, what the autoencoder blurs is put back.
        blurred = self.decode(setting.base)
        keep = (1 - (frames - blurred).abs().amax(3, keepdim=True) / _CHANGED).clamp(min=0)
        return to_bytes(frames + keep * (setting.draft - blurred)), fused

    def features(self, inputs: TensorDict) -> Tensor:
        """See Simulator.features; nothing is decoded to pixels."""
        return self._denoise(inputs)[1]

    def layers(self, inputs: TensorDict) -> list[Tensor]:
        """What every block of the trunk says at the last step, each [B * V, tokens, width], from which the
        state expert learns its mix.
        """
        said: list[Tensor] = []
        self._denoise(inputs, said)
        return said

    def _denoise(
        self, inputs: TensorDict, layers: list[Tensor] | None = None
    ) -> tuple[Tensor, Tensor, _Setting]:
        """Future latents [B, V, C, T', h, w], the features of the last step, and what was given."""
        memory = self.remember(unit(inputs["memory", "frames"]))
        setting = self._setting(inputs, memory)
        kept: list[Tensor] = []

        def velocity(z: Tensor, level: float) -> Tensor:
            if layers is not None:
                layers.clear()
            value, fused = self._says(
                z, memory, torch.full((len(z),), level, device=z.device), setting.conditioning, layers
            )
            kept[:] = [fused]
            return value if setting.base is None else (z - value) / level

        latents = self.sampler(velocity, self._noise(inputs["seed"], inputs["chunk_index"], memory))
        return latents if setting.base is None else setting.base + _CORRECTION * latents, kept[0], setting

    def _noise(self, seed: Tensor, chunk_index: Tensor, like: Tensor) -> Tensor:
        """Noise [B, V, C, T', h, w], row by row from its own generator, so that it is the same in any batch."""
        _, views, channels, _, height, width = like.shape
        rows = []
        for s, c in zip(seed.tolist(), chunk_index.tolist(), strict=True):
            rows.append(
                torch.randn(views, channels, self.ahead, height, width, generator=noise_generator(s, c))
            )
        return torch.stack(rows).to(like.device)

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Flow matching on the future latents of one chunk (memory has no loss), any of the clip's; those
        before it are the model's own.
        """
        chunk = self.shape.chunk
        # Chunks wholly past the end of every episode teach nothing.
        whole = clip["future", "valid"].any(0).unflatten(0, (-1, chunk)).any(1)
        chosen = int(torch.randint(max(1, int(whole.long().sum())), (1,), generator=generator))
        drawn: Tensor | None = None
        begin: TensorDict | None = None
        for number in range(chosen):
            with torch.no_grad():
                inputs = self.build_inputs(clip, number, drawn, generator, begin)
                begin, pictures = inputs["begin"], self.predict(inputs)[0]
            drawn = pictures if drawn is None else torch.cat([drawn, pictures], 1)
        inputs, part = (
            self.build_inputs(clip, chosen, drawn, generator, begin),
            slice(chosen * chunk, (chosen + 1) * chunk),
        )
        truth = unit(clip["future", "frames"][:, part])
        spoilt = chosen_clips(len(truth), self.augment, generator)
        memory = augment_memory_latents(
            self.remember(augment_memory_frames(unit(inputs["memory", "frames"]), spoilt, generator)),
            spoilt,
            generator,
        )
        target, setting = self.encode(truth), self._setting(inputs, memory)
        if setting.base is not None:
            target = (target - setting.base) / _CORRECTION
        draw = torch.rand(clip.shape, generator=generator).to(clip.device)
        level = self.shift * draw / (1 + (self.shift - 1) * draw)
        noise = torch.randn(target.shape, generator=generator).to(clip.device)
        mixed = level[:, None, None, None, None, None]
        said, _ = self._says((1 - mixed) * target + mixed * noise, memory, level, setting.conditioning)
        wanted = noise - target if setting.base is None else target
        weight = (
            foreground_weight(truth, self.foreground)
            * clip["future", "valid"][:, part][:, :, None, None, None, None]
        )
        weight = (
            F.avg_pool2d(self.codec.pool_time(weight).flatten(0, 2), STRIDE)
            .unflatten(0, (len(truth), self.ahead, -1))
            .permute(0, 2, 3, 1, 4, 5)
        )
        value = ((said - wanted).square() * weight).sum() / (weight.sum() * target.shape[2]).clamp(min=1)
        return value, {}


def unit(frames: Tensor) -> Tensor:
    """Frames as float in 0..1, from uint8 or float."""
    return frames.float() / 255 if frames.dtype == torch.uint8 else frames
