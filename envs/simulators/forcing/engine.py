"""The world of WPE (Quevedo et al. 2025): diffusion forcing (Chen et al. 2024) on latents of single frames.

In training every frame of a window has a noise level of its own, so one network serves any number of frames
before and ahead. A chunk is generated in blocks: the newest c frames stand before h frames of noise under
their h actions, which are denoised at once; then the window moves by h.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.conditioning import Pace, pose_map_cells, pose_map_channels, render_ray_map
from envs.ranges import Count
from envs.simulators import memory
from envs.simulators.base import to_bytes
from envs.simulators.dit.latent_world import unit
from envs.simulators.forcing.blocks import Blockwise, Denoising, wide
from envs.simulators.forcing.network import ForcingDiT, Known, Trunk
from envs.simulators.forcing.prediction import Prediction
from envs.simulators.forcing.schedule import Sigmoid
from envs.simulators.foreground import foreground_weight
from envs.simulators.inputs import own_frames, taught_memory
from envs.simulators.tokenizers.autoencoder import STRIDE, Autoencoder
from envs.simulators.tokenizers.detail import restore_detail
from envs.specs import WorldSpec
from envs.targets import OptionsOf, build, options

_ENCODED = 512  # pictures encoded at a time
_HORIZON = 4  # frames generated at once, of chunks that have as many, unless a config says otherwise


class ForcingSimulator(Blockwise):
    """Blockwise-autoregressive diffusion transformer; see the module's docstring.

    Args:
        spec: what it shows; sizes must be multiples of 8 * patch.
        window: frames of a training clip of one chunk, more than a chunk has; None: a chunk's and `context`.
        context: newest frames that a block is generated from, c; before there are so many, the first repeats,
            as for a robot that stood still.
        horizon: frames generated at once, h, at most a chunk's; None: 4 of them, or all of a shorter one.
        net: options of Trunk.
        codec: options of Autoencoder.
        denoising: options of Denoising.
        prediction: what the network says, a class of prediction.py.
        actions: how it is told of actions, a class such as ActionVector.

    Attributes:
        context, horizon: may be set to other numbers at any time, within what is said above; no weight
            depends on them.

    Raises:
        ValueError: if sizes do not fit.
        ConfigError: naming an option that is unknown, missing or out of range.
    """

    codec: Autoencoder
    per_frame_moves = True
    hidden = ("attn", "ff")

    def __init__(
        self,
        spec: WorldSpec,
        window: Count | None,
        context: Count,
        horizon: Count | None,
        net: Annotated[Mapping[str, Any], OptionsOf(Trunk)],
        codec: Annotated[Mapping[str, Any], OptionsOf(Autoencoder)],
        denoising: Annotated[Mapping[str, Any], OptionsOf(Denoising)],
        prediction: Mapping[str, Any],
        actions: Mapping[str, Any],
    ):
        window = spec.chunk + context if window is None else window
        horizon = min(_HORIZON, spec.chunk) if horizon is None else horizon
        if window <= spec.chunk:
            raise ValueError(
                f"simulator.window={window} must be more than task.chunk={spec.chunk}: a chunk goes on from"
                " at least one frame; raise it, or leave it null"
            )
        if horizon > spec.chunk:
            raise ValueError(
                f"simulator.horizon={horizon} must be at most task.chunk={spec.chunk}: a block is generated"
                " under its actions, and a chunk has no more; lower it or leave it null; fidelity.grid"
                f" tries it as {{simulator.horizon: [{horizon}], task.chunk: [{horizon}]}}"
            )
        super().__init__(spec, window - spec.chunk, window - spec.chunk)
        trunk = options(Trunk, net, "simulator.net")
        if any(side % (STRIDE * trunk.patch) for side in spec.size):
            raise ValueError(
                f"task.size={list(spec.size)} must be multiples of {STRIDE * trunk.patch} for this network's"
                " patches"
            )
        self.context, self.horizon = context, horizon
        self.denoising = options(Denoising, denoising, "simulator.denoising")
        self.schedule = options(Sigmoid, self.denoising.schedule, "simulator.denoising.schedule")
        self.prediction: Prediction = build(prediction, "simulator.prediction")
        self.actions = build(actions, "simulator.actions", embodiment=spec.embodiment)
        self.pace = Pace(self.actions.size)
        self.codec = Autoencoder(**codec).requires_grad_(False)
        latents, maps = self.codec.channels, pose_map_channels(STRIDE) * spec.pose_map + 6 * spec.ray_map
        none = torch.zeros(1, 1, 1, 1, 1, 1)
        seen = latents * (1 if self.prediction.base(none, none) is None else 2)
        self.net = ForcingDiT(trunk, seen + maps, latents, spec.views, self.actions.size)
        self.feature_shape = (spec.chunk * spec.views * trunk.width,)

    def normalise(self, commands: Tensor, moves: Tensor, states: Tensor) -> None:
        """See Simulator.normalise; actions take their units."""
        self.actions.normalise(commands, moves)

    def recall(self, state: TensorDict, future: TensorDict) -> TensorDict:
        """See Simulator.recall; the newest `context` frames."""
        return memory.recall(state, self.context, self.context)

    # -- generating
    def repeated(self) -> Iterator[tuple[nn.Module, bool]]:
        """See Repeated; the keys that blocks keep grow with the window, so no graph can replay them."""
        yield from ((block, False) for block in self.net.blocks)

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator.predict; features are those of the last step, means over each view of each frame."""
        latents, features = self._generate(inputs)
        decoded = self._decode(latents)
        last = unit(inputs["memory", "frames"][:, -1:])
        return to_bytes(restore_detail(decoded[:, 1:], decoded[:, :1], last)), features

    def features(self, inputs: TensorDict) -> Tensor:
        """See Simulator.features; nothing is decoded to pixels."""
        return self._generate(inputs)[1]

    @torch.no_grad()
    def coded(self, frames: Tensor) -> Tensor:
        """See Simulator.coded."""
        return to_bytes(self._decode(self._encode(unit(frames))))

    def _generate(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """Latents [B, 1 + K, V, C, h, w] of the last known frame and of a chunk, and the chunk's features
        [B, K * V * width], block by block.
        """
        remembered = {name: rows[:, -self.context :] for name, rows in inputs["memory"].items()}
        frames, chunk = self._whole(remembered, inputs), self.spec.chunk
        latents = self._encode(unit(frames["frames"]))
        before, features = latents.shape[1], []
        noise = self._noise(inputs["seed"], inputs["chunk_index"], latents)
        for begin in range(0, chunk, self.horizon):
            ahead = noise[:, begin : begin + self.horizon]
            window = slice(begin, begin + before + ahead.shape[1])
            made, seen = self._block(latents[:, begin:], ahead, self._beside(frames, window, inputs))
            latents = torch.cat([latents, made], 1)
            features.append(seen)
        return latents[:, before - 1 :], torch.cat(features, 1).flatten(1)

    # -- training
    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of every frame of memory and of one chunk, any of the clip's, that has one before it; the
        frames of the chunks before that are the model's own, and are only seen.
        """
        number, inputs = own_frames(self, clip, generator)
        part = slice(number * self.spec.chunk, (number + 1) * self.spec.chunk)
        frames = self._whole(inputs["memory"], inputs)
        seen = unit(torch.cat([frames["frames"], clip["future", "frames"][:, part]], 1))
        clean, past = self._encode(seen), frames["frames"].shape[1]
        level = self._levels(clean.shape[:2], past, generator).to(clean.device)
        noise = torch.randn(clean.shape, generator=generator).to(clean.device)
        z = (1 - wide(level)) * clean + wide(level) * noise
        base = self._base(z, level)
        output, _, _ = self._run(z, level, self._beside(frames, slice(None), inputs), base)
        error = self.prediction.error(output, (clean, noise), wide(level), base)
        valid = torch.cat([taught_memory(clip, number), clip["future", "valid"][:, part].bool()], 1)
        weight = self._weight(seen[:, past - 1], valid)
        return (error.square() * weight).sum() / (weight.sum() * clean.shape[3]).clamp(min=1), {}

    def _levels(self, shape: torch.Size, past: int, generator: torch.Generator) -> Tensor:
        """Noise levels of frames [B, T] of which `past` are context in sampling."""
        times = torch.rand(shape, generator=generator)
        sampled = torch.rand(len(times), 1, generator=generator) < self.denoising.as_sampled
        like = times[:, -1:].expand(shape).clone()
        like[:, :past] = self.denoising.stabilisation
        return self.schedule.level(torch.where(sampled, like, times))

    def _weight(self, last: Tensor, valid: Tensor) -> Tensor:
        """Loss weights [B, T, V, 1, h, w] by the last known frame [B, V, 3, H, W], and valid [B, T]."""
        weight = F.avg_pool2d(foreground_weight(last, self.denoising.foreground).flatten(0, 1), STRIDE)
        return weight.unflatten(0, last.shape[:2])[:, None] * valid[:, :, None, None, None, None]

    # -- parts
    def _whole(self, remembered: Mapping[str, Tensor], inputs: TensorDict) -> dict[str, Tensor]:
        """Remembered and future frames, as far as these are known, and what belongs to them, [B, T, ...]."""
        known = {}
        for name in ("frames", "commands", "pose_map", "c2w"):
            parts = [rows[name] for rows in (remembered, inputs["future"]) if name in rows.keys()]
            if parts:
                known[name] = torch.cat(parts, 1)
        return known

    def _encode(self, frames: Tensor) -> Tensor:
        """Latents [B, T, V, C, h, w] of frames float [B, T, V, 3, H, W] in 0..1; no gradient reaches the
        autoencoder.
        """
        with torch.no_grad():
            flat = torch.cat([self.codec.encode(piece) for piece in frames.flatten(0, 2).split(_ENCODED)])
        return flat.float().unflatten(0, frames.shape[:3])

    def _decode(self, latents: Tensor) -> Tensor:
        """Frames float [B, T, V, 3, H, W] of latents [B, T, V, C, h, w]."""
        return self.codec.decode(latents.flatten(0, 2)).float().unflatten(0, latents.shape[:3])

    def _beside(
        self, frames: Mapping[str, Tensor], window: slice, inputs: TensorDict
    ) -> tuple[Tensor, Tensor]:
        """What stands beside the latents of a window: channels [B, T, V, C', h, w] of pose and ray maps, as
        the spec asks for them, and action vectors [B, T, size]. An action is told as the step from the
        command before, whatever the window; its first frame has none before.
        """
        commands = frames["commands"][:, window]
        before = torch.cat([commands[:, :1], commands[:, :-1]], 1)
        vectors = self.actions(commands.flatten(0, 1)[:, None], before.flatten(0, 1))
        vectors = vectors.squeeze(1).unflatten(0, commands.shape[:2])
        vectors = vectors + self.pace(inputs["stride"])[:, None].to(vectors.dtype)
        latent_hw = tuple(side // STRIDE for side in self.spec.size)
        channels = [torch.zeros(*commands.shape[:2], self.spec.views, 0, *latent_hw, device=commands.device)]
        if self.spec.pose_map:
            channels.append(pose_map_cells(frames["pose_map"][:, window], STRIDE))
        if self.spec.ray_map:
            c2w = frames["c2w"][:, window].transpose(1, 2)
            rays = render_ray_map(inputs["intrinsic"], c2w, self.spec.size, stride=STRIDE)
            channels.append(rays.transpose(1, 2))
        return torch.cat(channels, 3), vectors

    def _run(
        self,
        z: Tensor,
        level: Tensor,
        beside: tuple[Tensor, Tensor],
        base: Tensor | None = None,
        known: list[Known] | None = None,
    ) -> tuple[Tensor, Tensor, list[Known]]:
        """One pass of the network over frames z [B, T, V, C, h, w] at levels [B, T]; see ForcingDiT."""
        shown = z / ((1 - wide(level)).square() + wide(level).square()).sqrt()  # of unit variance
        base = self._base(z, level) if base is None else base
        parts = [shown, beside[0]] if base is None else [shown, base, beside[0]]
        return self.net(torch.cat(parts, 3), level, beside[1], known)
