"""GE-Sim as released: its network, its autoencoder, its way of resizing conditioning, and on request its
quirks.

Version 2.0 (three views of 384 x 512 at 30 Hz, chunks of 25, joint commands, four distilled steps, a state
expert) and
version 1 (15 undistilled steps, no state expert) are this class with other weights; gesim_folder.py loads
them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKLWan
from tensordict import TensorDict
from torch import Tensor

from envs.conditioning import render_ray_map
from envs.simulators.base import WorldShape
from envs.simulators.dit.latent_world import LatentWorld
from envs.simulators.dit.network import DiTShape, MultiViewDiT
from envs.simulators.gesim.checkpoint import CheckpointError, load_released
from envs.simulators.samplers import DISTILLED, EDM, Distilled, Sampler
from envs.simulators.state_experts.flow import StateExpert
from envs.simulators.tokenizers.autoencoder import Codec
from envs.simulators.tokenizers.wan import WanCodec

PARITY = ("right", "released", "released_replay")


@dataclass(frozen=True)
class GESimConfig:
    """How GE-Sim is run and trained.

    Args:
        sampling: "distilled" or "edm"; "" takes what the checkpoint was made for.
        steps: of the sampler; 0 takes the released number, 4 or 15.
        parity: "right" remembers the first frame, and every remembered frame with the pose it had. "released"
            does as the
            released code does in closed loop: the first frame is forgotten after the first chunk, memory is
                shown with
            the pose of the chunk's first command, and the state expert's past is each chunk's last frame.
            "released_replay" forgets the first frame only, as the released code does when it replays a
            recording.
        shift: of the noise levels drawn in training.
        foreground: extra weight in training of what differs from the median colour.
        augment: chance that a clip's memory is spoilt in training.
        checkpointing: compute blocks anew in the backward pass, for memory.
        net: sizes of a network that begins from nothing (DiTShape); a checkpoint brings its own.
        vae: sizes of its autoencoder (diffusers' AutoencoderKLWan).
    """

    sampling: str = ""
    steps: int = 0
    parity: str = "right"
    shift: float = 1.0
    foreground: float = 0.0
    augment: float = 0.8
    checkpointing: bool = False
    net: dict[str, Any] = field(default_factory=dict)
    vae: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.parity not in PARITY:
            raise ValueError(f"parity={self.parity!r} must be one of {list(PARITY)}")
        if self.sampling not in ("", "distilled", "edm"):
            raise ValueError(f"sampling={self.sampling!r} must be distilled or edm")
        if self.sampling != "edm" and self.steps > len(DISTILLED):
            raise ValueError(
                f"steps={self.steps}, but the distilled sampler has {len(DISTILLED)} levels; use sampling=edm for more"
            )

    def sampler(self, edm: EDM | None = None, distilled: bool = True) -> Sampler:
        """The sampler; `edm` and `distilled` are what the checkpoint says."""
        if self.sampling == "edm" or (not self.sampling and not distilled):
            edm = edm or EDM()
            return EDM(self.steps or edm.steps, edm.sigma_max, edm.sigma_min, edm.rho)
        return Distilled(DISTILLED[: self.steps or len(DISTILLED)])


class GESimulator(LatentWorld):
    """GE-Sim behind the Simulator contract.

    Args:
        shape: views, size, chunk = 1 + 4 k, memory, fps, and the layout of commands.
        net, codec, prompt: as loaded or made.
        config: how it is run.
        sampler: of chunks.
        units: mean and spread of joint commands and of joint states, [2, 2, 16], if the checkpoint has them.
    """

    units: Tensor

    def __init__(
        self,
        shape: WorldShape,
        net: MultiViewDiT,
        codec: Codec,
        prompt: Tensor,
        config: GESimConfig,
        sampler: Sampler | None = None,
        units: Tensor | None = None,
    ):
        super().__init__(
            shape,
            net,
            codec,
            prompt,
            sampler or config.sampler(),
            1.0,
            config.shift,
            config.foreground,
            config.augment,
        )
        self.config = config
        net.checkpointing = config.checkpointing
        self.register_buffer("units", torch.full((2, 2, 16), torch.nan) if units is None else units)

    @classmethod
    def build(cls, shape: WorldShape, config: GESimConfig, checkpoint: str | None) -> GESimulator:
        """From a released checkpoint, or from nothing at the sizes of `config.net` and `config.vae`.

        Raises:
            CheckpointError: if the checkpoint does not fit.
            ValueError: if sizes are not options of the network.
        """
        if checkpoint:
            released = load_released(Path(checkpoint))
            if released.net.shape.views != shape.views:
                raise CheckpointError(
                    f"simulator.checkpoint={checkpoint} was made for {released.net.shape.views} views, task.views names {shape.views}"
                )
            released.net.add_expert()
            units = (
                None
                if released.stats is None
                else torch.stack([released.stats["action"], released.stats["state"]])
            )
            return cls(
                shape,
                released.net,
                released.codec,
                released.prompt,
                config,
                config.sampler(released.edm, released.distilled),
                units,
            )
        sizes: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in config.net.items()
        }
        try:
            net = MultiViewDiT(DiTShape(**{"views": shape.views, **sizes}))
            codec = WanCodec(AutoencoderKLWan(**config.vae))
        except TypeError as error:
            raise ValueError(f"net or vae: {error}") from error
        return cls(shape, net, codec, torch.zeros(1, 1, net.shape.text_embed_dim), config)

    def state_expert(self) -> StateExpert:
        """A copy of the network's state expert, to decode with or to train."""
        half = MultiViewDiT(self.net.shape, trunk=False)
        mine = self.net.state_dict()
        half.load_state_dict({name: mine[name] for name in half.state_dict()})
        every = self.shape.chunk if self.config.parity == "released" else 1
        expert = StateExpert(
            half,
            self.shape.views,
            self.shape.chunk,
            self.shape.memory,
            self.shape.layout,
            self.sampler,
            1.0,
            every,
        )
        if torch.isfinite(self.units).all():
            expert.action_mean.copy_(self.units[0, 0]), expert.action_std.copy_(self.units[0, 1])
            expert.state_mean.copy_(self.units[1, 0]), expert.state_std.copy_(self.units[1, 1])
            expert.normalised = True
        return expert

    def conditioning(self, inputs: TensorDict, places: tuple[int, int]) -> Tensor:
        """See LatentWorld: full-size pose and ray maps, memory resized frame by frame, the future in time
        too, without antialiasing.
        """
        # [B, T, V, 3, H, W]
        maps = torch.cat([inputs["memory", "pose_map"], inputs["future", "pose_map"]], 1).float() / 127.5 - 1
        c2w = torch.cat([inputs["memory", "c2w"], inputs["future", "c2w"]], 1).transpose(1, 2)
        rays = render_ray_map(inputs["intrinsic"], c2w, self.shape.size)  # [B, V, T, 6, H, W]
        raw = torch.cat([maps.permute(0, 2, 3, 1, 4, 5), rays.transpose(2, 3)], 2)  # [B, V, 9, T, H, W]
        flat, count = raw.flatten(0, 1), self.shape.memory
        past = (
            F.interpolate(flat[:, :, :count].transpose(1, 2).flatten(0, 1), places, mode="bilinear")
            .unflatten(0, (len(flat), count))
            .transpose(1, 2)
        )
        ahead = F.interpolate(flat[:, :, count:], (self.ahead, *places), mode="trilinear")
        mask = torch.zeros_like(torch.cat([past, ahead], 2)[:, :1])
        mask[:, :, :count] = 1.0
        return torch.cat([torch.cat([past, ahead], 2), mask], 1).unflatten(0, raw.shape[:2])

    def recall(self, state: TensorDict, pose_map: Tensor, c2w: Tensor) -> TensorDict:
        """See Simulator; with the released quirks if parity asks for them."""
        if self.config.parity == "right":
            return super().recall(state, pose_map, c2w)
        length, count = state["length"], self.shape.memory
        # Frame 0 is the first one, which the released history does not hold; its indices are cut, not
        # rounded.
        at = torch.stack(
            [
                1 + torch.linspace(0, int(n) - 2, count).long()
                if n > 1
                else torch.zeros(count, dtype=torch.int64)
                for n in length.tolist()
            ]
        )
        rows = torch.arange(len(state), device=length.device)[:, None]
        memory = state["history"].select("frames", "pose_map", "c2w")[rows, at.to(length.device)]
        if self.config.parity == "released":
            memory["pose_map"] = pose_map[:, :1].expand(-1, count, *pose_map.shape[2:])
            memory["c2w"] = c2w[:, :1].expand(-1, count, *c2w.shape[2:])
        return memory
