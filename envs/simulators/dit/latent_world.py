"""What every latent diffusion world shares, small or 2B: GE-Sim 2.0's way from remembered frames to a chunk.

Latents of sparse memory frames and of the chunk to come stand in one sequence, beside them whatever
conditioning the robot allows: pose map and ray map as channels, the action vector through adaLN. Memory is
clean, the future is denoised along the flow.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.simulators.base import noise_generator, to_bytes
from envs.simulators.compiling import begin_step
from envs.simulators.dit.augment import augment_memory_frames, augment_memory_latents, chosen_clips
from envs.simulators.dit.diffusion import Diffusion, Given
from envs.simulators.dit.network import MultiViewDiT
from envs.simulators.foreground import foreground_weight
from envs.simulators.inputs import own_frames
from envs.simulators.samplers import Sampler
from envs.simulators.stepwise import Stepwise, lost_jumps
from envs.simulators.tokenizers.autoencoder import STRIDE, Codec
from envs.specs import WorldSpec

_BUSY = 1024  # width; on an H200 blocks of 192 wait for their launches, and of 2048 do not
MEMORY_NOISE = 1e-4 / (1 + 1e-4)  # the noise level at which memory stands, as released


class LatentWorld(Stepwise):
    """Diffusion-transformer video world; see the module's docstring. A subclass says how it is conditioned.

    Args:
        spec: what it shows; sizes must be multiples of the autoencoder's stride times the patch.
        memory_frames: sparse memory frames, M.
        net: video trunk.
        codec: video autoencoder, trained apart.
        diffusion: noise levels and sampling.
        prompt: [1, L, D], the one text embedding of a network that reads text; the task's words never reach
            the simulator.

    Raises:
        ValueError: if the size does not fit.
    """

    codec: Codec
    prompt: Tensor | None

    def __init__(
        self,
        spec: WorldSpec,
        memory_frames: int,
        net: MultiViewDiT,
        codec: Codec,
        diffusion: Diffusion,
        prompt: Tensor | None = None,
    ):
        super().__init__(spec, memory_frames)
        patch = net.shape.patch_size
        unit = (STRIDE * patch[1], STRIDE * patch[2])
        if spec.size[0] % unit[0] or spec.size[1] % unit[1]:
            raise ValueError(
                f"task.size={list(spec.size)} must be multiples of {list(unit)} for this network's patches"
            )
        self.net, self.codec, self.diffusion = net, codec.requires_grad_(False), diffusion
        self.register_buffer("prompt", prompt)
        self.ahead = codec.latents_of(spec.chunk)  # latent frames of a chunk
        tokens = (memory_frames + self.ahead) * (spec.size[0] // unit[0]) * (spec.size[1] // unit[1])
        self.feature_shape = (spec.views, tokens, net.shape.width)

    # -- what a subclass gives
    def conditioning(self, inputs: TensorDict, latent_hw: tuple[int, int]) -> Tensor:
        """Channels [B, V, C, M + T', h, w] beside the latents at latent_hw = (h, w): a memory mask, and the
        pose map and ray map that the spec asks for.
        """
        raise NotImplementedError

    def actions(self, inputs: TensorDict) -> Tensor | None:
        """Action vectors [B, M + T', action_size] of all latent frames, of a network that reads them."""
        return None

    # -- latents
    def encode_stills(self, frames: Tensor) -> Tensor:
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

    def show(self, latents: Tensor, newest: Tensor, inputs: TensorDict) -> Tensor:
        """Frames float [B, K, V, 3, H, W] of a chunk's latents [B, V, C, T', h, w], where the newest
        remembered one is [B, V, C, 1, h, w], and of inputs of `predict`.
        """
        return self.decode(latents)

    # -- contract
    def repeated(self) -> Iterator[tuple[nn.Module, bool]]:
        """See Repeated; the blocks of a large trunk keep a GPU busy, those of a small one do not."""
        small = self.net.shape.width < _BUSY
        yield from ((block, small) for block in self.net.transformer_blocks)
        yield from ((part, False) for part in self.codec.repeated())

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator.predict; noise comes from (seed, chunk_index), features from the last step."""
        latents, features, newest = self._denoise(inputs)
        return to_bytes(self.show(latents, newest, inputs)), features

    def features(self, inputs: TensorDict) -> Tensor:
        """See Simulator.features; nothing is decoded to pixels."""
        return self._denoise(inputs)[1]

    @torch.no_grad()
    def coded(self, frames: Tensor) -> Tensor:
        """See Simulator.coded; each frame is a still of its own, as memory is."""
        latents = self.encode_stills(unit(frames)).permute(0, 3, 1, 2, 4, 5).flatten(0, 1)
        stills = self.decode(latents[:, :, :, None])  # [B * T, 1, V, 3, H, W]
        return to_bytes(stills).squeeze(1).unflatten(0, frames.shape[:2])

    def layers(self, inputs: TensorDict) -> list[Tensor]:
        """Outputs of every block of the trunk at the last step, each [B * V, tokens, width], from which a
        state expert learns its mix.
        """
        outputs: list[Tensor] = []
        self._denoise(inputs, outputs)
        return outputs

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the future latents of one chunk (memory has none), any of the clip's; the frames of those
        before it are the model's own.
        """
        inputs, truth, valid = self._drawn(clip, generator)
        augmented = chosen_clips(len(truth), self.diffusion.augment, generator)
        remembered = augment_memory_frames(unit(inputs["memory", "frames"]), augmented, generator)
        memory = augment_memory_latents(self.encode_stills(remembered), augmented, generator)
        clean = self.encode(truth)
        draw = torch.rand(clip.shape, generator=generator).to(clean.device)
        level = self.diffusion.shift * draw / (1 + (self.diffusion.shift - 1) * draw)
        noise = torch.randn(clean.shape, generator=generator).to(clean.device)
        mixed = level[:, None, None, None, None, None]
        output, _ = self._run((1 - mixed) * clean + mixed * noise, level, self._given(inputs, memory))
        error = self.diffusion.prediction.error(output, clean, noise, memory[:, :, :, -1:])
        weight = self._weight(inputs, valid)
        value = (error.square() * weight).sum() / (weight.sum() * clean.shape[2]).clamp(min=1)
        return value, {}

    @property
    def lost_in_training(self) -> str:
        """See Simulator."""
        return lost_jumps(self.sampler)

    # -- in steps
    @property
    def sampler(self) -> Sampler:
        """See Stepwise."""
        return self.diffusion.sampler

    def chunk_of(self, clip: TensorDict, generator: torch.Generator) -> tuple[TensorDict, Tensor]:
        """See Stepwise; weights [B, V, 1, T', h, w] are those of `loss`."""
        inputs, _, valid = self._drawn(clip, generator)
        return inputs, self._weight(inputs, valid)

    def prepare(self, inputs: TensorDict) -> Given:
        """See Stepwise."""
        return self._given(inputs, self.encode_stills(unit(inputs["memory", "frames"])))

    def noise(self, inputs: TensorDict, given: Given) -> Tensor:
        """Noise [B, V, C, T', h, w], row by row from its own generator, the same in any batch."""
        _, views, channels, _, height, width = given.memory.shape
        rows = []
        for s, c in zip(inputs["seed"].tolist(), inputs["chunk_index"].tolist(), strict=True):
            rows.append(
                torch.randn(views, channels, self.ahead, height, width, generator=noise_generator(s, c))
            )
        return torch.stack(rows).to(given.memory.device)

    def velocity(self, z: Tensor, level: Tensor, given: Given) -> Tensor:
        """See Stepwise."""
        return self._velocity(z, level, given)[0]

    # -- parts
    def _drawn(self, clip: TensorDict, generator: torch.Generator) -> tuple[TensorDict, Tensor, Tensor]:
        """Any chunk of a clip: its inputs, after own predictions of the chunks before, its true frames float
        [B, K, V, 3, H, W] in 0..1, and which are valid [B, K].
        """
        chosen, inputs = own_frames(self, clip, generator)
        part = slice(chosen * self.spec.chunk, (chosen + 1) * self.spec.chunk)
        return inputs, unit(clip["future", "frames"][:, part]), clip["future", "valid"][:, part]

    def _given(self, inputs: TensorDict, memory: Tensor) -> Given:
        latent_hw = (memory.shape[-2], memory.shape[-1])
        stride = inputs["stride"]
        alike = bool((stride == stride[0]).all())  # as in sessions: one set of positions serves all
        fps = self.spec.fps / (int(stride[0]) if alike else stride)
        # In training each step reads the prompt itself: its keys keep gradients of that step alone.
        text: Tensor | list[tuple[Tensor, Tensor]] | None = self.prompt
        if self.prompt is not None and not (self.training or torch.is_grad_enabled()):
            text = self.net.text_keys(self.prompt)
        return Given(memory, self.conditioning(inputs, latent_hw), self.actions(inputs), fps, text)

    def _weight(self, inputs: TensorDict, valid: Tensor) -> Tensor:
        """Loss weights [B, V, 1, T', h, w] by the last remembered frame, and valid [B, K]."""
        last = unit(inputs["memory", "frames"][:, -1])
        weight = F.avg_pool2d(foreground_weight(last, self.diffusion.foreground).flatten(0, 1), STRIDE)
        known = self.codec.pool_time(valid.to(weight))[:, None, None, :, None, None]
        return weight.unflatten(0, last.shape[:2])[:, :, :, None] * known

    def _run(
        self, future: Tensor, level: Tensor, given: Given, layers: list[Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """The network's output for future latents [B, V, C, T', h, w] at noise level [B], and features [B, V,
        tokens, width].
        """
        actions = given.actions
        latents = torch.cat([torch.cat([given.memory, future], 3), given.channels], 2)
        steps = torch.full((len(future), latents.shape[3]), MEMORY_NOISE, device=future.device)
        steps[:, self.memory_frames :] = level[:, None]
        views = self.spec.views
        output, fused = self.net(
            latents.flatten(0, 1),
            self.diffusion.time_scale * steps.repeat_interleave(views, 0),
            given.text,
            given.fps.repeat_interleave(views, 0) if isinstance(given.fps, Tensor) else given.fps,
            None if actions is None else actions.repeat_interleave(views, 0),
            layers,
        )
        ahead = output.unflatten(0, (-1, views))[:, :, :, self.memory_frames :].float()
        return ahead, fused.unflatten(0, (-1, views))

    def _velocity(
        self, z: Tensor, level: Tensor, given: Given, layers: list[Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """The velocity at z [B, V, C, T', h, w] and noise level [B], and features [B, V, tokens, width]."""
        output, features = self._run(z, level, given, layers)
        at, base = level[:, None, None, None, None, None], given.memory[:, :, :, -1:]
        return self.diffusion.prediction.velocity(output, z, at, base), features

    def _denoise(
        self, inputs: TensorDict, layers: list[Tensor] | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Future latents [B, V, C, T', h, w], the features of the last step, and the newest remembered latent
        [B, V, C, 1, h, w].
        """
        if self.compiled == "graphs" and not self.training:  # in training `fit` says when a step begins
            begin_step()
        given = self.prepare(inputs)
        kept: list[Tensor] = []

        def velocity(z: Tensor, level: float) -> Tensor:
            if layers is not None:
                layers.clear()
            found, features = self._velocity(z, torch.full((len(z),), level, device=z.device), given, layers)
            kept[:] = [features]
            return found

        return self.sampler(velocity, self.noise(inputs, given)), kept[0], given.memory[:, :, :, -1:]


def unit(frames: Tensor) -> Tensor:
    """Frames as float in 0..1, from uint8 or float."""
    return frames.float() / 255 if frames.dtype == torch.uint8 else frames
