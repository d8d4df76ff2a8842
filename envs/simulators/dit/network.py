"""The GE-Sim 2.0 network at any size: a multi-view Cosmos-style diffusion transformer over video latents.

Parameter names are those of the public checkpoint, so that its weights load strictly. Attention stays within
a view, except in every third block, where it spans all views. The blocks' outputs, mixed by learned scalars,
are the features that a state expert attends to (state_network.py).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from envs.simulators.dit.blocks import VisionBlock
from envs.simulators.dit.layers import AdaLN, RMSNorm, TimestepMLP, sinusoid
from envs.simulators.dit.shape import DiTShape, video_rope


class _VideoTime(nn.Module):
    def __init__(self, width: int):
        super().__init__()
        self.width = width
        self.t_embedder = TimestepMLP(width, width, 3 * width, bias=False)
        self.norm = RMSNorm(width)

    def forward(self, timestep: Tensor) -> tuple[Tensor, Tensor]:
        waves = sinusoid(timestep, self.width).to(self.norm.weight.dtype)
        return self.t_embedder(waves), self.norm(waves)


class _FixedLayerNorm(nn.Module):
    """Layer norm whose weight and bias somebody else learns."""

    weight: Tensor
    bias: Tensor

    def __init__(self, width: int):
        super().__init__()
        self.register_buffer("weight", torch.ones(width))
        self.register_buffer("bias", torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        return F.layer_norm(x, self.weight.shape, self.weight, self.bias, eps=1e-6)


class Stem(nn.Module):
    """Two convolutions over each latent frame, whose channels stand beside it: transformers with large
    patches learn from few pictures more quickly with one (Xiao et al. 2021)."""

    def __init__(self, channels: int, width: int):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(channels, width, 3, padding=1), nn.SiLU(), nn.Conv2d(width, width, 3, padding=1)
        )

    def forward(self, x: Tensor) -> Tensor:
        """[B, C, T, H, W] -> [B, C + width, T, H, W]."""
        flat = self.layers(x.transpose(1, 2).flatten(0, 1))
        return torch.cat((x, flat.unflatten(0, (len(x), -1)).transpose(1, 2)), 1)


class MultiViewDiT(nn.Module):
    """The video trunk; see the module's docstring.

    Args:
        shape: sizes.

    Attributes:
        checkpointing: compute blocks anew in the backward pass instead of keeping what they computed.
        video_buffer_weights, video_buffer_norm: the mix of the blocks that makes features. A state expert
            learns it and hands it over (StateDecoder.attach); the video does not depend on it, so here it is
            buffers.
    """

    video_buffer_weights: Tensor

    def __init__(self, shape: DiTShape):
        super().__init__()
        self.shape, self.checkpointing = shape, False
        width, patch = shape.width, math.prod(shape.patch_size)
        self.stem = Stem(shape.in_channels, shape.stem) if shape.stem else nn.Identity()
        channels = shape.in_channels + shape.stem + shape.concat_padding_mask
        self.patch_embed = nn.ModuleDict({"proj": nn.Linear(channels * patch, width, bias=False)})
        self.time_embed = _VideoTime(width)
        if shape.action_size:
            self.action_embed = nn.Linear(shape.action_size, width)
        self.view_embed = nn.Parameter(torch.randn(shape.views, width) * 0.02)
        self.view_ada = nn.Sequential(nn.SiLU(), nn.Linear(width, 3 * width))
        self.transformer_blocks = nn.ModuleList(VisionBlock(shape) for _ in range(shape.num_layers))
        self.norm_out = AdaLN(width, shape.adaln_lora_dim, 2)
        self.proj_out = nn.Linear(width, patch * shape.out_channels, bias=False)
        self.register_buffer("video_buffer_weights", torch.ones(shape.num_layers))
        self.video_buffer_norm = _FixedLayerNorm(width)

    def forward(
        self,
        latents: Tensor,
        timestep: Tensor,
        text: Tensor | Sequence[tuple[Tensor, Tensor]] | None,
        fps: float | Tensor,
        actions: Tensor | None = None,
        layers: list[Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """One denoising step of the video.

        Args:
            latents: [B * V, C, T, H, W] latents with their conditioning channels, views of a session side by
                side.
            timestep: [B * V, 1, T, 1, 1] or [B * V, T] noise level of every latent frame.
            text: [1, L, D], [B, L, D] or [B * V, L, D] prompt embedding, or what `text_keys` made of one;
                None where the network reads no text.
            fps: of the video, or [B * V] of each.
            actions: [B * V, T, action_size] action vector of every latent frame, embedded and added to the
                time step's embedding, which modulates every block (adaLN); None where there are none.
            layers: takes the output of every block, each [B * V, tokens, width], for training the mix.

        Returns:
            velocity [B * V, out_channels, T, H, W] and the fused features [B * V, tokens, width] for the
            state expert.
        """
        batch, _, frames, height, width = latents.shape
        views, (pt, ph, pw) = self.shape.views, self.shape.patch_size
        latents = self.stem(latents)
        padding = latents.new_zeros(batch, int(self.shape.concat_padding_mask), frames, height, width)
        x = torch.cat((latents, padding), 1).reshape(
            batch, -1, frames // pt, pt, height // ph, ph, width // pw, pw
        )
        grid = (frames // pt, height // ph, width // pw)
        x = self.patch_embed["proj"](x.permute(0, 2, 4, 6, 1, 3, 5, 7).flatten(4).flatten(1, 3))
        rope = video_rope(self.shape, *grid, fps, latents.device)
        embedded, temb = self._modulation(timestep.reshape(batch, -1), actions)
        known = self._known(text, batch)
        fused = torch.zeros_like(x)
        for index, block in enumerate(self.transformer_blocks):
            arguments = (x, known[index], embedded, temb, rope, views if index % 3 == 0 else 1)
            x = (
                checkpoint(block, *arguments, use_reentrant=False)
                if self.checkpointing and torch.is_grad_enabled()
                else block(*arguments)
            )
            fused = fused + self.video_buffer_weights[index] * x.detach()
            if layers is not None:
                layers.append(x)
        x = self.norm_out(x, *self.norm_out.parts(embedded, temb))
        x = self.proj_out(x).unflatten(2, (ph, pw, pt, -1)).unflatten(1, grid)
        video = x.permute(0, 7, 1, 6, 2, 4, 3, 5).flatten(6, 7).flatten(4, 5).flatten(2, 3)
        return video, self.video_buffer_norm(fused)

    def _modulation(self, steps: Tensor, actions: Tensor | None) -> tuple[Tensor, Tensor]:
        """What modulates the blocks: the embedded time step [B * V, T, width], and shift, scale and gate
        common to all of them [B * V, T, 3 * width].
        """
        batch = len(steps)
        temb, embedded = self.time_embed(steps.reshape(-1))
        temb, embedded = (part.unflatten(0, (batch, -1)) for part in (temb, embedded))
        if actions is not None:
            embedded = embedded + self.action_embed(actions)
        of_views = self.view_ada(self.view_embed).repeat(batch // self.shape.views, 1)
        return embedded, temb + of_views[:, None]

    def text_keys(self, text: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Keys and values of a prompt [1, L, D] for every block: the same for all views and steps."""
        return [cast(VisionBlock, block).text_keys(text) for block in self.transformer_blocks]

    def _known(
        self, text: Tensor | Sequence[tuple[Tensor, Tensor]] | None, batch: int
    ) -> Sequence[Tensor | tuple[Tensor, Tensor] | None]:
        """The text for every block."""
        if not (text is None or isinstance(text, Tensor)):
            return text
        if text is not None and len(text) > 1:
            text = text.repeat_interleave(batch // len(text), 0)
        return [text] * len(self.transformer_blocks)
