"""The main engine at a small size, trained from nothing: GE-Sim 2.0's architecture with our own autoencoder."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor

from envs.conditioning import render_ray_map
from envs.simulators.base import WorldShape
from envs.simulators.dit.latent_world import LatentWorld
from envs.simulators.dit.network import DiTShape, MultiViewDiT
from envs.simulators.draft import Draft
from envs.simulators.in_view import place_map
from envs.simulators.samplers import Euler
from envs.simulators.tokenizers.autoencoder import STRIDE, Autoencoder


@dataclass(frozen=True)
class DiTConfig:
    """Size and sampling of the DiT engine.

    Args:
        layers, heads, head_dim, adaln_rank: of the trunk.
        state_heads, state_head_dim: of the state expert.
        patch: latent rows and columns per token.
        channels, codec_width: of the autoencoder.
        steps: Euler steps per chunk.
        shift: of the noise levels in training and sampling; above 1 favours noise.
        foreground: extra weight of latents over things that differ from the median colour.
        augment: chance that memory is spoilt in training.
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
    augment: float = 0.8


class DiTSimulator(LatentWorld):
    """LatentWorld at a small size that corrects drafts (draft.py); beside hands and cameras it is told where
    objects will be.

    Args:
        shape: what it shows; sizes must be multiples of 8 * patch.
        config: its size.
    """

    def __init__(self, shape: WorldShape, config: DiTConfig | None = None):
        config = config or DiTConfig()
        net = MultiViewDiT(
            DiTShape(
                in_channels=2 * config.channels + 3 + 6 + 1 + shape.objects,
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
            ),
            expert=False,  # it is a stage of its own, with its own depth
        )
        codec = Autoencoder(config.channels, config.codec_width)
        # The public network embeds levels as they are; at thousandfold they span the sinusoids' range.
        super().__init__(
            shape,
            net,
            codec,
            torch.zeros(1, 1, 32),
            Euler(config.steps, config.shift),
            1000.0,
            config.shift,
            config.foreground,
            config.augment,
        )
        self.draft = Draft(shape.views, shape.size)
        with torch.no_grad():
            # it starts from the draft, for random corrections take long to unlearn
            net.proj_out.weight.mul_(0.05)

    def glance(self, frames: Tensor, c2w: Tensor) -> None:
        """See Simulator.glance."""
        self.draft.learn(frames, c2w)

    def prepare(self, frames: Tensor, places: Tensor, intrinsic: Tensor, c2w: Tensor) -> TensorDict:
        """See Simulator.prepare."""
        return self.draft.prepare(frames, places, intrinsic, c2w)

    def drafted(self, inputs: TensorDict) -> Tensor:
        """See LatentWorld."""
        ahead = self.draft.look(inputs).at(slice(None), slice(1, None))
        return torch.stack(
            self.draft(inputs["begin"], ahead, inputs["future", "c2w"], inputs["intrinsic"]), 2
        )

    def conditioning(self, inputs: TensorDict, places: tuple[int, int]) -> Tensor:
        """See LatentWorld; spots of the objects stand beside, known from the last remembered frame on."""
        maps = torch.cat([inputs["memory", "pose_map"], inputs["future", "pose_map"]], 1).float() / 127.5 - 1
        small = F.interpolate(maps.flatten(0, 2), size=places, mode="bilinear", antialias=True).unflatten(
            0, maps.shape[:3]
        )
        c2w = torch.cat([inputs["memory", "c2w"], inputs["future", "c2w"]], 1).transpose(1, 2)
        rays = render_ray_map(inputs["intrinsic"], c2w, self.shape.size, stride=STRIDE)  # [B, V, T, 6, h, w]
        mask = torch.zeros_like(rays[:, :, :, :1])
        mask[:, :, : self.shape.memory] = 1.0
        spots = place_map(self.draft.look(inputs), *places)
        spots = F.pad(spots, (0, 0, 0, 0, 0, 0, self.shape.memory - 1, 0))
        return torch.cat([small.permute(0, 2, 1, 3, 4, 5), rays, mask, spots], 3).transpose(2, 3)
