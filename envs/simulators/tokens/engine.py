"""The action world of RoboScape-R: an autoregressive world over tokens that commands drive, frame by frame.

A chunk is made from the newest frames, which are encoded and read once; their keys and values are kept while
the chunk's frames follow one another. Sessions of any length go on so, the window sliding with them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.conditioning import ActionVector, Pace, pose_map_cells, pose_map_channels, render_ray_map
from envs.ranges import Count
from envs.rng import noise_generator
from envs.simulators.base import Simulator, to_bytes
from envs.simulators.inputs import own_frames, taught_memory
from envs.simulators.row_linear import RowLinear
from envs.simulators.tokenizers.detail import restore_detail
from envs.simulators.tokenizers.lfq import LookupFreeTokenizer
from envs.simulators.tokens.decoding import Draws
from envs.simulators.tokens.done import ChunkDone
from envs.simulators.tokens.transformer import Trunk
from envs.simulators.tokens.video import Lesson, TokenTraining, TokenVideo
from envs.specs import WorldSpec
from envs.targets import OptionsOf

_KEY = "simulator"
_REMEMBERED = 8  # frames before a chunk, unless a config says otherwise


@dataclass(frozen=True)
class Made:
    """A chunk: tokens int64 [B, 1 + K, P, F] of the last known frame and of its own, and features
    [B, *feature_shape].
    """

    tokens: Tensor
    features: Tensor


class TokensSimulator(Simulator):
    """Spatio-temporal transformer over lookup-free tokens of all views.

    Commands become a few tokens per frame; pose map and ray map are added to the places where the spec asks
    for them. Features are the means over the places of each frame of the chunk, and of each view of its last
    one.

    Args:
        spec: what it shows; sizes must be multiples of codec.stride.
        window: frames that a frame sees, itself included; more than a chunk, None: 8 more. Memory is all but
            a chunk of them.
        codec, net, conditioning, decoding, training: see TokenVideo.

    Features also tell whether the task is done, by recorded success: a head that learns beside the tokens
    reads the mean over each frame's places. Under judge=golden_goal_action it decides what a success is.

    Raises:
        ValueError: if sizes do not fit.
        ConfigError: naming an option that is unknown, missing or out of range.
    """

    hidden = ("blocks",)
    per_frame_moves = True
    says_done = True

    def __init__(
        self,
        spec: WorldSpec,
        window: Count | None,
        codec: Annotated[Mapping[str, Any], OptionsOf(LookupFreeTokenizer)],
        net: Annotated[Mapping[str, Any], OptionsOf(Trunk)],
        conditioning: Mapping[str, Any],
        decoding: Mapping[str, Any],
        training: Annotated[Mapping[str, Any], OptionsOf(TokenTraining)],
    ):
        window = spec.chunk + _REMEMBERED if window is None else window
        if window <= spec.chunk:
            raise ValueError(
                f"{_KEY}.window={window} must be more than task.chunk={spec.chunk}: a chunk's frames and at"
                " least one before them; raise it, or leave it null"
            )
        super().__init__(spec, window - spec.chunk, window - spec.chunk)
        self.video = TokenVideo(spec, window, codec, net, conditioning, decoding, training, _KEY)
        width, stride = self.video.trunk.width, self.codec.stride
        self.action_vector = ActionVector(spec.embodiment)
        self.action_embed = nn.Sequential(
            RowLinear(self.action_vector.size, width),
            nn.SiLU(),
            RowLinear(width, self.video.cond_tokens * width),
        )
        self.pace = Pace(self.video.cond_tokens * width)
        self.pose_embed = RowLinear(pose_map_channels(stride), width) if spec.pose_map else None
        self.ray_embed = RowLinear(6, width) if spec.ray_map else None
        self.feature_shape = ((spec.chunk + spec.views) * width,)

    @property
    def codec(self) -> LookupFreeTokenizer:
        """The tokenizer, which is trained apart."""
        return self.video.codec

    def normalise(self, commands: Tensor, moves: Tensor, states: Tensor) -> None:
        """See Simulator.normalise."""
        self.action_vector.normalise(commands, moves)

    # -- contract
    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator.predict; all draws come from (seed, chunk_index)."""
        made = self.generate(inputs)
        return self._frames(made, inputs), made.features

    def features(self, inputs: TensorDict) -> Tensor:
        """See Simulator.features; nothing is decoded to pixels."""
        return self.generate(inputs).features

    def done_head(self) -> ChunkDone:
        """See Simulator.done_head."""
        head = ChunkDone(self.spec, self.feature_shape)
        head.head.load_state_dict(self.video.done_head.state_dict())
        return head

    def coded(self, frames: Tensor) -> Tensor:
        """See Simulator.coded."""
        return to_bytes(self.video.decode(self.video.encode(frames)))

    @torch.no_grad()
    def generate(self, inputs: TensorDict) -> Made:
        """The chunk after some inputs of `predict`, as tokens."""
        cond, beside = self._cond(inputs), self._beside(inputs)
        tokens, past = self.video.encode(inputs["memory", "frames"]), self.memory_frames
        known = self.video.net.memory()
        self.video.net.observe(tokens, cond[:, :past], _of(beside, slice(past)), known)
        pairs = zip(inputs["seed"].tolist(), inputs["chunk_index"].tolist(), strict=True)
        draws = Draws([noise_generator(seed, chunk) for seed, chunk in pairs], tokens.device)
        made, seen = [tokens[:, -1]], []
        for frame in range(past, cond.shape[1]):
            at = slice(frame, frame + 1)
            made.append(self.video.next_frame(known, cond[:, at], _of(beside, at), draws))
            seen.append(self.video.net.observe(made[-1][:, None], cond[:, at], _of(beside, at), known))
        features = torch.cat(seen, 1).float()
        return Made(torch.stack(made, 1), self._pooled(features))

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of all frames of memory and of one chunk, any of the clip's, each from those before it; the
        frames of the chunks before that are the model's own, and are not asked for.
        """
        number, inputs = own_frames(self, clip, generator)
        part = slice(number * self.spec.chunk, (number + 1) * self.spec.chunk)
        true = taught_memory(clip, number)
        truth, valid, success = (clip["future", name][:, part] for name in ("frames", "valid", "success"))
        frames = torch.cat((inputs["memory", "frames"], truth), 1)
        unknown = torch.full(true.shape, torch.nan, device=true.device)
        lesson = Lesson(
            tokens=self.video.encode(frames),
            counted=torch.cat((true[:, 1:], valid), 1),
            success=torch.cat((unknown, torch.where(valid, success, torch.nan)), 1),
        )
        return self.video.loss(lesson, self._cond(inputs), self._beside(inputs), generator)

    # -- parts
    def _frames(self, made: Made, inputs: TensorDict) -> Tensor:
        """Frames uint8 [B, K, V, 3, H, W] of a chunk, with the detail of the last known one."""
        decoded = self.video.decode(made.tokens)
        last = inputs["memory", "frames"][:, -1:].float() / 255
        return to_bytes(restore_detail(decoded[:, 1:], decoded[:, :1], last))

    def _cond(self, inputs: TensorDict) -> Tensor:
        """Commands of memory and chunk as tokens [B, T, N, width]: each beside the one before it, so that a
        frame has the same wherever it stands in a chunk.
        """
        commands = torch.cat([inputs["memory", "commands"], inputs["future", "commands"]], 1)
        before = torch.cat((commands[:, :1], commands[:, :-1]), 1)
        vectors = self.action_vector(commands.unsqueeze(-2), before).squeeze(-2)
        embedded = self.action_embed(vectors)
        embedded = embedded + self.pace(inputs["stride"])[:, None].to(embedded.dtype)
        return embedded.unflatten(-1, (self.video.cond_tokens, -1))

    def _beside(self, inputs: TensorDict) -> Tensor | None:
        """Pose maps and rays of all frames as [B, T, P, width]; None where there are none."""
        parts = []
        if self.pose_embed is not None:
            maps = torch.cat([inputs["memory", "pose_map"], inputs["future", "pose_map"]], 1)
            cells = pose_map_cells(maps, self.codec.stride).flatten(4).mT
            parts.append(self.pose_embed(cells.flatten(2, 3)))
        if self.ray_embed is not None:
            c2w = torch.cat([inputs["memory", "c2w"], inputs["future", "c2w"]], 1).transpose(1, 2)
            rays = render_ray_map(inputs["intrinsic"], c2w, self.spec.size, stride=self.codec.stride)
            parts.append(self.ray_embed(rays.permute(0, 2, 1, 4, 5, 3).flatten(2, 4)))
        return torch.stack(parts).sum(0) if parts else None

    def _pooled(self, features: Tensor) -> Tensor:
        """Features [B, *feature_shape] of the chunk's [B, K, P, width]."""
        frames = features.mean(2).flatten(1)
        views = features[:, -1].unflatten(1, (self.spec.views, -1)).mean(2).flatten(1)
        return torch.cat((frames, views), 1)


def _of(beside: Tensor | None, frames: slice) -> Tensor | None:
    return None if beside is None else beside[:, frames]
