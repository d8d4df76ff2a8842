"""How chunks of a diffusion-forcing world are made in blocks, and blocks in steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.ranges import Count, NonNegative, Share
from envs.simulators.base import noise_generator
from envs.simulators.dit.latent_world import unit
from envs.simulators.forcing.network import Known
from envs.simulators.forcing.prediction import Prediction
from envs.simulators.forcing.schedule import DDIM, Sigmoid
from envs.simulators.inputs import own_frames
from envs.simulators.samplers import Distilled, Sampler
from envs.simulators.stepwise import Stepwise, lost_jumps
from envs.targets import OptionsOf


@dataclass(frozen=True)
class Denoising:
    """How it is trained and sampled.

    Args:
        sampler: "ddim", or "distilled" for the jumps of a few-step student (see samplers.py).
        steps: of the sampler, per block.
        stabilisation: time on the schedule, 0..1, that context frames are said to stand at: a network that
            took its own frames for clean would trust their errors. They are shown without that noise, and
            scaled as frames of that level are.
        as_sampled: chance that a clip of training has the levels of sampling (context as above, all newer
            frames at one level) instead of independent ones.
        foreground: extra loss weight of where the last known frame differs from its median colour. By what
            is still to be said itself, things would be drawn wherever they may be.
        schedule: options of Sigmoid.
    """

    sampler: Literal["ddim", "distilled"]
    steps: Count
    stabilisation: Share
    as_sampled: Share
    foreground: NonNegative
    schedule: Annotated[Mapping[str, Any], OptionsOf(Sigmoid)]


@dataclass(frozen=True)
class Block:
    """What stays the same at every step of a block.

    Args:
        context: latents [B, c, V, C, h, w] of the frames before it, as those of their level are scaled.
        old: the levels [B, c] at which they are said to stand.
        ahead: what stands beside the block's own frames: channels [B, n, V, C', h, w], and action vectors [B,
            n, size].
        known: what the network has read of the context.
    """

    context: Tensor
    old: Tensor
    ahead: tuple[Tensor, Tensor]
    known: list[Known]


class Blockwise(Stepwise):
    """The part of the forcing world that makes blocks; the network and what it is shown are the engine's.

    Attributes:
        context, horizon, denoising, schedule, prediction: see ForcingSimulator.
    """

    context: int
    horizon: int
    denoising: Denoising
    schedule: Sigmoid
    prediction: Prediction

    # -- what the engine gives
    def _whole(self, remembered: Mapping[str, Tensor], inputs: TensorDict) -> dict[str, Tensor]:
        """Remembered and future frames, as far as these are known, and what belongs to them, [B, T, ...]."""
        raise NotImplementedError

    def _encode(self, frames: Tensor) -> Tensor:
        """Latents [B, T, V, C, h, w] of frames float [B, T, V, 3, H, W] in 0..1."""
        raise NotImplementedError

    def _beside(
        self, frames: Mapping[str, Tensor], window: slice, inputs: TensorDict
    ) -> tuple[Tensor, Tensor]:
        """What stands beside the latents of a window: channels [B, T, V, C', h, w] and action vectors [B, T,
        size].
        """
        raise NotImplementedError

    def _weight(self, last: Tensor, valid: Tensor) -> Tensor:
        """Loss weights [B, T, V, 1, h, w] by the last known frame [B, V, 3, H, W], and valid [B, T]."""
        raise NotImplementedError

    def _run(
        self,
        z: Tensor,
        level: Tensor,
        beside: tuple[Tensor, Tensor],
        base: Tensor | None = None,
        known: list[Known] | None = None,
    ) -> tuple[Tensor, Tensor, list[Known]]:
        """One pass of the network over frames z [B, T, V, C, h, w] at levels [B, T]."""
        raise NotImplementedError

    # -- blocks
    def _block(self, context: Tensor, noise: Tensor, beside: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Frames [B, n, V, C, h, w] after those of the context [B, c, V, C, h, w], and their features.

        Nothing in frames of the past depends on newer ones: they are read once, and not at every step.

        Args:
            noise: like the frames.
            beside: channels [B, c + n, V, C', h, w] and action vectors [B, c + n, size].
        """
        given, kept = self._read(context, beside), list[Tensor]()

        def velocity(z: Tensor, level: float) -> Tensor:
            found, features = self._velocity(z, torch.full(z.shape[:1], level, device=z.device), given)
            kept[:] = [features]
            return found

        made = self.sampler(velocity, noise)
        return made, kept[0]

    def _read(self, context: Tensor, beside: tuple[Tensor, Tensor]) -> Block:
        past = context.shape[1]
        stable = float(self.schedule.level(torch.tensor(self.denoising.stabilisation)))
        old = torch.full(context.shape[:2], stable, device=context.device)
        context = (1 - stable) * context  # z = (1 - s) x + s e, whose noise is left out
        _, _, known = self._run(context, old, (beside[0][:, :past], beside[1][:, :past]))
        return Block(context, old, (beside[0][:, past:], beside[1][:, past:]), known)

    def _velocity(self, z: Tensor, level: Tensor, given: Block) -> tuple[Tensor, Tensor]:
        """The velocity at frames z [B, n, V, C, h, w] and level [B], and features [B, n, V * width]."""
        levels, past = level[:, None].expand(z.shape[:2]), given.context.shape[1]
        base = self._base(torch.cat([given.context, z], 1), torch.cat([given.old, levels], 1))
        base = None if base is None else base[:, past:]
        output, features, _ = self._run(z, levels, given.ahead, base, given.known)
        return (z - self.prediction.clean(output, z, wide(levels), base)) / wide(levels), features

    def _noise(self, seed: Tensor, chunk_index: Tensor, like: Tensor) -> Tensor:
        """Noise [B, K, V, C, h, w], row by row from its own generator, the same in any batch."""
        shape = (self.spec.chunk, *like.shape[2:])
        pairs = zip(seed.tolist(), chunk_index.tolist(), strict=True)
        return torch.stack([torch.randn(shape, generator=noise_generator(*pair)) for pair in pairs]).to(
            like.device
        )

    def _base(self, z: Tensor, level: Tensor) -> Tensor | None:
        return self.prediction.base(z, wide(level))

    # -- in steps: a student learns at the first block of a chunk, which all blocks are like
    @classmethod
    def stepped_section(cls, section: Mapping[str, Any], steps: int) -> dict[str, Any]:
        """See Simulator.stepped_section."""
        return {**section, "denoising": {**section["denoising"], "sampler": "ddim", "steps": steps}}

    @classmethod
    def student_section(cls, section: Mapping[str, Any], steps: int) -> dict[str, Any]:
        """See Simulator.student_section."""
        most = section["denoising"]["steps"]
        if steps > most:
            raise ValueError(
                f"distill.steps={steps} are more than the teacher's simulator.denoising.steps={most}; a"
                " student takes fewer"
            )
        return {
            **section,
            "denoising": {**section["denoising"], "sampler": "distilled", "steps": steps},
        }

    @property
    def sampler(self) -> Sampler:
        """See Stepwise."""
        levels = self.schedule.levels(self.denoising.steps)
        if self.denoising.sampler == "distilled":
            return Distilled(tuple(levels[:-1]))
        return DDIM(levels)

    @property
    def lost_in_training(self) -> str:
        """See Simulator."""
        return lost_jumps(self.sampler)

    def chunk_of(self, clip: TensorDict, generator: torch.Generator) -> tuple[TensorDict, Tensor]:
        """See Stepwise; weights [B, n, V, 1, h, w] are those of `loss`."""
        number, inputs = own_frames(self, clip, generator)
        begin = number * self.spec.chunk
        part = slice(begin, begin + self.horizon)
        last = unit(inputs["memory", "frames"][:, -1])
        return inputs, self._weight(last, clip["future", "valid"][:, part])

    def prepare(self, inputs: TensorDict) -> Block:
        """See Stepwise; of the chunk's first block."""
        remembered = {name: rows[:, -self.context :] for name, rows in inputs["memory"].items()}
        frames = self._whole(remembered, inputs)
        latents = self._encode(unit(frames["frames"]))
        window = slice(0, latents.shape[1] + self.horizon)
        return self._read(latents, self._beside(frames, window, inputs))

    def noise(self, inputs: TensorDict, given: Block) -> Tensor:
        """See Stepwise; [B, n, V, C, h, w]."""
        noise = self._noise(inputs["seed"], inputs["chunk_index"], given.context)
        return noise[:, : given.ahead[1].shape[1]]

    def velocity(self, z: Tensor, level: Tensor, given: Block) -> Tensor:
        """See Stepwise."""
        return self._velocity(z, level, given)[0]


def wide(level: Tensor) -> Tensor:
    """Levels [B, T] as [B, T, 1, 1, 1, 1]."""
    return level[..., None, None, None, None]
