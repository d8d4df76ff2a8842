"""GE-Sim as released: its network, its autoencoder, its way of resizing conditioning, and on request its
quirks.

Version 2.0 (three views of 384 x 512 at 30 Hz, chunks of 25, joint commands, four distilled steps, a state
expert) and version 1 (15 undistilled steps, no state expert) are this class with other weights; checkpoint.py
loads them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKLWan
from tensordict import TensorDict
from torch import Tensor

from envs.conditioning import render_ray_map
from envs.ranges import Count, Natural, NonNegative, Positive, Share
from envs.simulators.dit.diffusion import Diffusion
from envs.simulators.dit.latent_world import LatentWorld
from envs.simulators.dit.network import MultiViewDiT
from envs.simulators.dit.prediction import Velocity
from envs.simulators.dit.shape import DiTShape
from envs.simulators.gesim.checkpoint import CheckpointError, load_released
from envs.simulators.samplers import DISTILLED, EDM, Distilled, Sampler, few_steps
from envs.simulators.tokenizers.wan import WanCodec
from envs.specs import WorldSpec
from envs.targets import OptionsOf

_CONDITIONING = 3 + 6 + 1  # channels of pose map, ray map, memory mask
_SHIFT = 5.0  # of the released student's levels, and of those of others


@dataclass(frozen=True)
class Parity:
    """Which of the released code's quirks are repeated.

    Args:
        forgets_first: the first frame leaves the history after the first chunk.
        shows_current: remembered frames stand with the pose of the chunk's first command, instead of their
            own.
        thins_history: of commands and states the state expert's past holds each chunk's last frame only.
    """

    forgets_first: bool
    shows_current: bool
    thins_history: bool


# As the paper says; as the released code does in closed loop; as it does when it replays a recording.
PARITY = {
    "right": Parity(False, False, False),
    "released": Parity(True, True, True),
    "released_replay": Parity(True, False, False),
}


@dataclass(frozen=True)
class Sampling:
    """How chunks are sampled.

    Args:
        kind: "distilled" jumps from the first levels of the released four, as the released code does;
            "student" from those of a student that was made for so many steps; "edm" does not jump; "" takes
            what the checkpoint was made for.
        steps: of the sampler; 0 takes the released number, 4 or 15.

    Raises:
        ValueError: if the sampler cannot take so many steps.
    """

    kind: Literal["", "distilled", "student", "edm"]
    steps: Natural

    def __post_init__(self) -> None:
        if self.kind != "edm" and self.steps > len(DISTILLED):
            raise ValueError(
                f"simulator.sampling.steps={self.steps}, but the distilled sampler has {len(DISTILLED)}"
                " levels; use simulator.sampling.kind=edm for more"
            )
        if self.kind == "edm":
            _check_edm(self.steps)

    def sampler(self, edm: EDM, distilled: bool) -> Sampler:
        """The sampler; `edm` and `distilled` are what the checkpoint says.

        Raises:
            ValueError: if it cannot take so many steps.
        """
        if self.kind == "edm" or (not self.kind and not distilled):
            _check_edm(self.steps)
            return EDM(self.steps or edm.steps, edm.sigma_max, edm.sigma_min, edm.rho)
        steps = self.steps or len(DISTILLED)
        return few_steps(steps, _SHIFT) if self.kind == "student" else Distilled(DISTILLED[:steps])


def _check_edm(steps: int) -> None:
    """Refuse a number of EDM steps of which none has a length."""
    if steps == 1:
        raise ValueError(
            "simulator.sampling.steps=1 of the undistilled sampler (edm) would show noise, for its last step"
            " has no length; set simulator.sampling.steps=2 or more, or 0 for the released number"
        )


@dataclass(frozen=True)
class Training:
    """How it is trained on.

    Args:
        shift: of the noise levels drawn; above 1 favours noise.
        foreground: extra loss weight of where the last remembered frame differs from its median colour.
        augment: chance that a clip's memory is augmented.
        checkpointing: compute blocks anew in the backward pass, for memory.
    """

    shift: Positive
    foreground: NonNegative
    augment: Share
    checkpointing: bool


class GESimulator(LatentWorld):
    """GE-Sim behind the Simulator contract.

    It is conditioned on pose maps and ray maps, as released; commands reach it through the pose map alone.

    Args:
        spec: views, size, chunk = 1 + 4 k, of any robot with calibrated cameras and known flange poses.
        memory_frames: sparse memory frames, M; the released weights know 4.
        checkpoint: folder of GE-Sim 2.0 or file of GE-Sim 1; None begins from nothing.
        parity: a name in PARITY.
        sampling: options of Sampling.
        training: options of Training.
        scratch: sizes of what begins from nothing, {"net": DiTShape's, "vae": diffusers' AutoencoderKLWan's}.

    Raises:
        CheckpointError: if the checkpoint does not fit.
        ValueError: if an option cannot be.
    """

    def __init__(
        self,
        spec: WorldSpec,
        memory_frames: Count,
        checkpoint: str | None,
        parity: str,
        sampling: Annotated[dict[str, Any], OptionsOf(Sampling)],
        training: Annotated[dict[str, Any], OptionsOf(Training)],
        scratch: dict[str, dict[str, Any]],
    ):
        if not (spec.pose_map and spec.ray_map):
            raise ValueError(
                f"simulator=gesim is conditioned on pose and ray maps, and {spec.embodiment.robot} comes"
                " without; it needs calibrated cameras, simulator.kinematics for joint commands, and"
                " simulator.pose_map=true simulator.ray_map=true"
            )
        if parity not in PARITY:
            raise ValueError(f"simulator.parity={parity!r} must be one of {list(PARITY)}")
        options, chosen = Training(**training), Sampling(**sampling)
        prompt: Tensor | None
        if checkpoint:
            released = load_released(Path(checkpoint))
            net, codec, prompt = released.net, released.codec, released.prompt
            sampler = chosen.sampler(released.edm, released.distilled)
            _check(checkpoint, net.shape, spec)
        else:
            net, codec = _from_nothing(spec, **scratch)
            text = net.shape.text_embed_dim  # a prompt of zeros costs what a real one does, and says nothing
            prompt, sampler = torch.zeros(1, 1, text) if text else None, chosen.sampler(EDM(), True)
        diffusion = Diffusion(sampler, Velocity(), 1.0, options.shift, options.foreground, options.augment)
        super().__init__(spec, memory_frames, net, codec, diffusion, prompt)
        self.parity, net.checkpointing = PARITY[parity], options.checkpointing

    @classmethod
    def stepped_section(cls, section: Mapping[str, Any], steps: int) -> dict[str, Any]:
        """See Simulator.stepped_section."""
        _check_edm(steps)
        return {**section, "sampling": {"kind": "edm", "steps": steps}}

    @classmethod
    def student_section(cls, section: Mapping[str, Any], steps: int) -> dict[str, Any]:
        """See Simulator.student_section; the levels are spread as the released student's are."""
        if steps > len(DISTILLED):  # the teacher may be the released student
            raise ValueError(
                f"distill.steps={steps}, but a student of GE-Sim takes at most {len(DISTILLED)}; set"
                f" distill.steps={len(DISTILLED)} or fewer"
            )
        own = section["sampling"]
        if own["steps"] and steps > own["steps"]:
            raise ValueError(
                f"distill.steps={steps} are more than the teacher's simulator.sampling.steps={own['steps']};"
                " a student takes fewer"
            )
        return {**section, "sampling": {"kind": "student", "steps": steps}}

    def conditioning(self, inputs: TensorDict, latent_hw: tuple[int, int]) -> Tensor:
        """See LatentWorld: full-size pose and ray maps, memory resized frame by frame, the future in time
        too, without antialiasing.
        """
        # [B, T, V, 3, H, W]
        maps = torch.cat([inputs["memory", "pose_map"], inputs["future", "pose_map"]], 1).float() / 127.5 - 1
        c2w = torch.cat([inputs["memory", "c2w"], inputs["future", "c2w"]], 1).transpose(1, 2)
        rays = render_ray_map(inputs["intrinsic"], c2w, self.spec.size)  # [B, V, T, 6, H, W]
        raw = torch.cat([maps.permute(0, 2, 3, 1, 4, 5), rays.transpose(2, 3)], 2)  # [B, V, 9, T, H, W]
        flat, count = raw.flatten(0, 1), self.memory_frames
        past = (
            F.interpolate(flat[:, :, :count].transpose(1, 2).flatten(0, 1), latent_hw, mode="bilinear")
            .unflatten(0, (len(flat), count))
            .transpose(1, 2)
        )
        ahead = F.interpolate(flat[:, :, count:], (self.ahead, *latent_hw), mode="trilinear")
        mask = torch.zeros_like(torch.cat([past, ahead], 2)[:, :1])
        mask[:, :, :count] = 1.0
        return torch.cat([torch.cat([past, ahead], 2), mask], 1).unflatten(0, raw.shape[:2])

    def recall(self, state: TensorDict, future: TensorDict) -> TensorDict:
        """See Simulator.recall; with the released quirks if parity asks for them."""
        if not self.parity.forgets_first:
            return super().recall(state, future)
        length, count = state["length"], self.memory_frames
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
        names = ("frames", "commands", "pose_map", "c2w")
        memory = state["history"].select(*names)[rows, at.to(length.device)]
        if self.parity.shows_current:
            for name in ("pose_map", "c2w"):
                memory[name] = future[name][:, :1].expand_as(memory[name])
        return memory


def _check(checkpoint: str, shape: DiTShape, spec: WorldSpec) -> None:
    """Refuse weights that were made for something else."""
    if shape.views != spec.views:
        raise CheckpointError(
            f"simulator.checkpoint={checkpoint} was made for {shape.views} views, {spec.embodiment.robot} has"
            f" {spec.views}: {list(spec.embodiment.views)}"
        )
    if shape.in_channels != shape.out_channels + _CONDITIONING:
        raise CheckpointError(
            f"simulator.checkpoint={checkpoint} takes {shape.in_channels} channels, GE-Sim's conditioning"
            f" makes {shape.out_channels + _CONDITIONING}"
        )


def _from_nothing(spec: WorldSpec, net: dict[str, Any], vae: dict[str, Any]) -> tuple[MultiViewDiT, WanCodec]:
    """Untrained networks of the given sizes."""
    sizes: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in net.items()
    }
    try:
        trunk = MultiViewDiT(DiTShape(**{"views": spec.views, **sizes}))
        # Configs hand lists over as tuples, and diffusers adds lists to its own.
        lists = {key: list(value) if isinstance(value, tuple) else value for key, value in vae.items()}
        return trunk, WanCodec(AutoencoderKLWan(**lists))
    except TypeError as error:
        raise ValueError(f"simulator.scratch.net or simulator.scratch.vae: {error}") from error
