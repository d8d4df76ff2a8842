"""Video as tokens and its continuation: what the action world and the text world have in common.

A tokenizer that was trained apart, the transformer over its tokens, and the head that says whether the task
is done in a frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.ranges import Count, NonNegative, Share
from envs.simulators.base import to_bytes
from envs.simulators.tokenizers.lfq import LookupFreeTokenizer
from envs.simulators.tokens.blocks import Memory
from envs.simulators.tokens.conditioning import Conditioning
from envs.simulators.tokens.decoding import Decoding, Draws
from envs.simulators.tokens.done import done_head
from envs.simulators.tokens.transformer import SpatioTemporalTransformer, Trunk, Vocabulary
from envs.specs import WorldSpec
from envs.targets import OptionsOf, build, options

_AT_ONCE = 512  # pictures that the tokenizer takes in one call
_FLAT = 1e-6  # under the root of the done head's error, whose slope has no bound at zero


@dataclass(frozen=True)
class TokenTraining:
    """How the transformer is trained.

    Args:
        motion: extra loss weight of places at or beside which tokens changed in the frame before the one
            asked for. What is asked itself decides nothing: weighted by its own changes, places would be
            taken for likelier to change than they are.
        corrupt: largest share of the known tokens that are replaced by random ones, drawn for every clip: a
            world's own frames hold mistakes, too.
        done: weight of the done head's error.
    """

    motion: NonNegative
    corrupt: Share
    done: NonNegative


@dataclass(frozen=True)
class Lesson:
    """What a clip of T frames teaches.

    Args:
        tokens: int64 [B, T, P, F].
        counted: bool [B, T - 1], which frames after the first are to be predicted.
        success: float32 [B, T], whether the task is done in a frame; NaN where nobody says so.
    """

    tokens: Tensor
    counted: Tensor
    success: Tensor


class TokenVideo(nn.Module):
    """See the module's docstring. `cond` and `beside` are those of SpatioTemporalTransformer.

    Args:
        spec: what the pictures show; sizes must be multiples of the tokenizer's stride.
        window: frames that a frame sees, itself included.
        codec: options of LookupFreeTokenizer.
        net: options of Trunk.
        conditioning, decoding: `_target_` and options of a Conditioning and of a Decoding.
        training: options of TokenTraining.
        key: config section of all these, for messages.

    Raises:
        ValueError: if sizes do not fit.
        ConfigError: naming an option that is unknown, missing or out of range.
    """

    def __init__(
        self,
        spec: WorldSpec,
        window: Count,
        codec: Annotated[Mapping[str, Any], OptionsOf(LookupFreeTokenizer)],
        net: Annotated[Mapping[str, Any], OptionsOf(Trunk)],
        conditioning: Mapping[str, Any],
        decoding: Mapping[str, Any],
        training: Annotated[Mapping[str, Any], OptionsOf(TokenTraining)],
        key: str,
    ):
        super().__init__()
        self.spec = spec
        # Whatever trains the tokenizer lets it learn for that time.
        self.codec = LookupFreeTokenizer(**codec).requires_grad_(False)
        stride = self.codec.stride
        if any(side % stride for side in spec.size):
            raise ValueError(
                f"task.size={list(spec.size)} must be multiples of {stride}, which is {key}.codec.stride"
            )
        rows, columns = (side // stride for side in spec.size)
        self.vocabulary = Vocabulary(spec.views, rows, columns, self.codec.factors, self.codec.bits)
        self.trunk = options(Trunk, net, f"{key}.net")
        self.training_options = options(TokenTraining, training, f"{key}.training")
        self.decoding: Decoding = build(decoding, f"{key}.decoding")
        conditioner: Conditioning = build(conditioning, f"{key}.conditioning")
        self.cond_tokens = conditioner.tokens
        self.net = SpatioTemporalTransformer(self.vocabulary, self.trunk, window, conditioner)
        width = self.trunk.width
        self.done_head = done_head(width)

    # -- tokens
    @torch.no_grad()
    def encode(self, frames: Tensor) -> Tensor:
        """Tokens int64 [B, T, P, F] of frames uint8 [B, T, V, 3, H, W]."""
        flat = frames.flatten(0, 2).split(_AT_ONCE)
        tokens = torch.cat([self.codec.encode(part.float() / 255) for part in flat])
        return tokens.unflatten(0, frames.shape[:3]).flatten(2, 4)

    @torch.no_grad()
    def decode(self, tokens: Tensor) -> Tensor:
        """Frames float32 [B, T, V, 3, H, W], about 0..1, of tokens [B, T, P, F]."""
        v = self.vocabulary
        grids = tokens.unflatten(2, (v.views, v.rows, v.columns))
        flat = grids.flatten(0, 2).split(_AT_ONCE)
        return torch.cat([self.codec.decode(part) for part in flat]).unflatten(0, grids.shape[:3])

    @torch.no_grad()
    def redraw(self, frames: Tensor) -> Tensor:
        """Frames uint8 [B, T, V, 3, H, W] of any cameras, as the tokenizer keeps them."""
        device = next(self.codec.parameters()).device
        flat = frames.flatten(0, 2).to(device).split(_AT_ONCE)
        kept = [to_bytes(self.codec.decode(self.codec.encode(part.float() / 255))) for part in flat]
        return torch.cat(kept).unflatten(0, frames.shape[:3]).to(frames.device)

    # -- frames to come
    def next_frame(self, memory: Memory, cond: Tensor, beside: Tensor | None, draws: Draws) -> Tensor:
        """Tokens int64 [B, P, F] of the frame after those of a memory; cond and beside are of that frame."""
        v = self.vocabulary
        return self.decoding.decide(_NextFrame(self.net, memory, cond, beside), v.places, v.factors, draws)

    def done(self, features: Tensor) -> Tensor:
        """Whether the task is done, float32 [B, T] in 0..1, by features [B, T, P, width]."""
        return self.done_head(features.mean(2)).float().sigmoid().squeeze(-1)

    # -- training
    def loss(
        self, lesson: Lesson, cond: Tensor, beside: Tensor | None, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Cross-entropy of the tokens of frames asked for, plus the root mean square error of done."""
        how, tokens = self.training_options, lesson.tokens
        shown, masked = self.decoding.shown(tokens[:, 1:], generator)
        known = self._corrupted(tokens, generator)
        logits, features = self.net(known, shown, cond, beside, self.decoding.causal)
        error = F.cross_entropy(logits.flatten(0, 3), tokens[:, 1:].flatten(), reduction="none")
        error = error.view(tokens[:, 1:].shape).sum(-1)
        weight = (1 + how.motion * self._stirred(tokens)) * (masked & lesson.counted[..., None])
        value = (error * weight).sum() / weight.sum().clamp(min=1)
        labelled = torch.isfinite(lesson.success)
        gap = torch.where(labelled, self.done(features) - torch.nan_to_num(lesson.success), 0.0)
        done = (gap.square().sum() / labelled.sum().clamp(min=1) + _FLAT).sqrt()
        figures = {"tokens": value.detach(), "done": done.detach()}
        return value + how.done * done, figures

    def _stirred(self, tokens: Tensor) -> Tensor:
        """Where tokens [B, T, P, F] changed in the last known frame, or beside it, for every frame but the
        first: float32 [B, T - 1, P] of 0 and 1. Of the frame after the first nothing is known.
        """
        v = self.vocabulary
        moved = F.pad((tokens[:, 1:-1] != tokens[:, :-2]).any(-1).float(), (0, 0, 1, 0))
        grids = moved.reshape(-1, 1, v.rows, v.columns)
        return F.max_pool2d(grids, 3, stride=1, padding=1).reshape(moved.shape)

    def _corrupted(self, tokens: Tensor, generator: torch.Generator) -> Tensor:
        """Tokens [B, T, P, F], some of them replaced by random ones."""
        shape = tokens.shape
        most = self.training_options.corrupt * torch.rand(len(tokens), 1, 1, 1, generator=generator)
        chosen = torch.rand(*shape[:3], 1, generator=generator) < most
        other = torch.randint(self.vocabulary.codes, shape, generator=generator)
        return torch.where(chosen.to(tokens.device), other.to(tokens.device), tokens)


@dataclass(frozen=True)
class _NextFrame:
    """The frame after those of a memory; see decoding.Asker."""

    net: SpatioTemporalTransformer
    memory: Memory
    cond: Tensor
    beside: Tensor | None

    def all(self, shown: Tensor) -> Tensor:
        return self.net.predict(shown, self.cond, self.beside, self.memory)

    def place(self, number: int, shown: Tensor) -> Tensor:
        return self.net.predict_place(number, shown, self.cond, self.beside, self.memory)
