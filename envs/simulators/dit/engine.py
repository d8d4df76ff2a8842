"""The diffusion transformer at a small size, trained from nothing with our own autoencoder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor

from envs.conditioning import ActionVector, render_ray_map
from envs.ranges import Count, Natural, NonNegative, Positive, Share
from envs.simulators.dit.diffusion import Diffusion
from envs.simulators.dit.latent_world import LatentWorld, unit
from envs.simulators.dit.network import MultiViewDiT
from envs.simulators.dit.prediction import PREDICTIONS
from envs.simulators.dit.shape import DiTShape
from envs.simulators.samplers import Euler, Sampler, few_steps
from envs.simulators.tokenizers.autoencoder import STRIDE, Autoencoder
from envs.simulators.tokenizers.detail import restore_detail
from envs.specs import WorldSpec
from envs.targets import OptionsOf, options

# The public network embeds levels as they are; at thousandfold they span the sinusoids' range.
TIME_SCALE = 1000.0


@dataclass(frozen=True)
class Trunk:
    """Sizes of the transformer.

    Args:
        layers, heads, head_dim: their number, and of their attention.
        adaln_rank: of the maps from time step and action to shifts, scales and gates.
        patch: latent rows and columns per token.
        stem: channels of the convolutional stem; 0 is without.
    """

    layers: Count
    heads: Count
    head_dim: Count
    adaln_rank: Count
    patch: Count
    stem: Natural

    def shape(self, spec: WorldSpec, channels: int, action_size: int) -> DiTShape:
        """The network for latents of so many channels, of what `spec` is conditioned on."""
        return DiTShape(
            in_channels=channels + 1 + 3 * spec.pose_map + 6 * spec.ray_map,
            out_channels=channels,
            num_attention_heads=self.heads,
            attention_head_dim=self.head_dim,
            num_layers=self.layers,
            text_embed_dim=0,
            adaln_lora_dim=self.adaln_rank,
            patch_size=(1, self.patch, self.patch),
            rope_scale=(1.0, 1.0, 1.0),
            views=spec.views,
            concat_padding_mask=False,
            action_size=action_size,
            stem=self.stem,
        )


@dataclass(frozen=True)
class Denoising:
    """How it is trained and sampled.

    Args:
        prediction: "velocity", or "clean" for the clean latents (see prediction.py).
        sampler: "euler", or "distilled" for the jumps of a few-step student (see samplers.py).
        steps: of the sampler, per chunk.
        shift: of the noise levels in training and sampling; above 1 favours noise.
        foreground: extra loss weight of where the last remembered frame differs from its median colour.
        augment: chance that a clip's memory is augmented in training.
    """

    prediction: Literal["velocity", "clean"]
    sampler: Literal["euler", "distilled"]
    steps: Count
    shift: Positive
    foreground: NonNegative
    augment: Share

    def diffusion(self) -> Diffusion:
        """The same for LatentWorld."""
        prediction = PREDICTIONS[self.prediction]
        sampler: Sampler = Euler(self.steps, self.shift)
        if self.sampler == "distilled":
            sampler = few_steps(self.steps, self.shift)
        return Diffusion(sampler, prediction, TIME_SCALE, self.shift, self.foreground, self.augment)


class DiTSimulator(LatentWorld):
    """LatentWorld at a small size.

    The action vector reaches every block through adaLN, as in WPE; pose map and ray map stand beside the
    latents where the spec asks for them.

    Args:
        spec: what it shows; sizes must be multiples of 8 * patch.
        memory_frames: sparse memory frames, M.
        net: options of Trunk.
        codec: options of Autoencoder.
        denoising: options of Denoising.

    Raises:
        ValueError: if sizes do not fit.
        ConfigError: naming an option that is unknown, missing or out of range.
    """

    codec: Autoencoder

    def __init__(
        self,
        spec: WorldSpec,
        memory_frames: Count,
        net: Annotated[dict[str, int], OptionsOf(Trunk)],
        codec: Annotated[dict[str, int], OptionsOf(Autoencoder)],
        denoising: Annotated[dict[str, Any], OptionsOf(Denoising)],
    ):
        vector, tokenizer = ActionVector(spec.embodiment), Autoencoder(**codec)
        trunk = MultiViewDiT(Trunk(**net).shape(spec, tokenizer.channels, vector.size))
        sampling = options(Denoising, denoising, "simulator.denoising")
        super().__init__(spec, memory_frames, trunk, tokenizer, sampling.diffusion())
        self.action_vector = vector
        with torch.no_grad():
            # It starts from no change, or no flow: random output takes long to unlearn.
            trunk.proj_out.weight.mul_(0.05)

    def show(self, latents: Tensor, newest: Tensor, inputs: TensorDict) -> Tensor:
        """See LatentWorld.show; what the autoencoder lost of the newest remembered frame is restored."""
        decoded = self.decode(torch.cat([newest, latents], 3))  # one frame each
        last = unit(inputs["memory", "frames"][:, -1:])
        return restore_detail(decoded[:, 1:], decoded[:, :1], last)

    @classmethod
    def stepped_section(cls, section: Mapping[str, Any], steps: int) -> dict[str, Any]:
        """See Simulator.stepped_section."""
        return {**section, "denoising": {**section["denoising"], "sampler": "euler", "steps": steps}}

    @classmethod
    def student_section(cls, section: Mapping[str, Any], steps: int) -> dict[str, Any]:
        """See Simulator.student_section."""
        own = section["denoising"]
        if steps > own["steps"]:
            raise ValueError(
                f"distill.steps={steps} are more than the teacher's simulator.denoising.steps={own['steps']};"
                " a student takes fewer"
            )
        return {**section, "denoising": {**own, "sampler": "distilled", "steps": steps}}

    def normalise(self, commands: Tensor, moves: Tensor, states: Tensor) -> None:
        """See Simulator.normalise; action vectors take their units."""
        self.action_vector.normalise(commands, moves)

    def actions(self, inputs: TensorDict) -> Tensor:
        """See LatentWorld.actions."""
        now = inputs["now", "command"]
        # Remembered frames lie apart: what changed on the way to each sums up to nothing.
        led = self.action_vector(inputs["memory", "commands"].unsqueeze(2), now.unsqueeze(1)).squeeze(2)
        return torch.cat([led, self.action_vector(inputs["future", "commands"], now)], 1)

    def conditioning(self, inputs: TensorDict, latent_hw: tuple[int, int]) -> Tensor:
        """See LatentWorld.conditioning; maps are averaged over the pixels of a latent."""
        shape = (*inputs.shape, self.spec.views, 1, self.memory_frames + self.ahead, *latent_hw)
        mask = torch.zeros(shape, device=inputs["memory", "frames"].device)
        mask[:, :, :, : self.memory_frames] = 1.0
        channels = [mask]
        if self.spec.pose_map:
            maps = torch.cat([inputs["memory", "pose_map"], inputs["future", "pose_map"]], 1)
            small = F.interpolate(
                maps.flatten(0, 2).float() / 127.5 - 1, size=latent_hw, mode="bilinear", antialias=True
            )
            channels.append(small.unflatten(0, maps.shape[:3]).permute(0, 2, 3, 1, 4, 5))
        if self.spec.ray_map:
            c2w = torch.cat([inputs["memory", "c2w"], inputs["future", "c2w"]], 1).transpose(1, 2)
            rays = render_ray_map(inputs["intrinsic"], c2w, self.spec.size, stride=STRIDE)
            channels.append(rays.transpose(2, 3))
        return torch.cat(channels, 2)
