"""The text world of RoboScape-R: how the task would go on if it were done as the instruction says.

The action world's transformer with weights of its own, told the instruction instead of commands. From a first
frame it imagines the golden trajectory, up to the frame in which the task is done: the goal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.ranges import Count, Share
from envs.rng import Noise, noise_generator
from envs.simulators.base import to_bytes
from envs.simulators.tokenizers.lfq import LookupFreeTokenizer
from envs.simulators.tokens.decoding import Draws
from envs.simulators.tokens.transformer import Trunk
from envs.simulators.tokens.video import Lesson, TokenTraining, TokenVideo
from envs.simulators.tokens.words import WordEncoder, WordReader
from envs.specs import WorldSpec, bytes_to_text
from envs.targets import OptionsOf, build, options

_KEY = "judge.text_world"


class GoldenTrajectory(NamedTuple):
    """How tasks go on when they are done.

    frames uint8 [B, T, V, 3, H, W] after the first; of an episode that ends before others its last one
    repeats. done float32 [B, T] in 0..1. goal int64 [B], the first frame with done above the threshold; the
    last one where there is none, and finished bool [B] is false there.
    """

    frames: Tensor
    done: Tensor
    goal: Tensor
    finished: Tensor


@dataclass(frozen=True)
class Ending:
    """When a golden trajectory ends.

    Args:
        threshold: of done, above which the task is; calibration sets it later (stages/text_world.py).
        max_frames: imagined, at most; None: by the time that recorded successes take (stages/text_world.py),
            and until it is trained as many as its window holds.
    """

    threshold: Share
    max_frames: Count | None


class TextWorld(nn.Module):
    """See the module's docstring.

    Args:
        spec: what it shows; sizes must be multiples of codec.stride.
        window: frames that a frame sees, itself included; training clips are as long.
        codec, net, conditioning, decoding, training: see TokenVideo. The tokenizer is its own, for its
            weights are a judge's.
        words: `_target_` and options of a WordEncoder.
        ending: options of Ending.

    Raises:
        ValueError: if sizes do not fit, or a window holds one frame alone.
        ConfigError: naming an option that is unknown, missing or out of range.
    """

    hidden = ("blocks",)
    threshold: Tensor
    longest: Tensor  # int64, of golden trajectories where ending.max_frames is None; saved with the weights

    def __init__(
        self,
        spec: WorldSpec,
        window: Count,
        codec: Annotated[Mapping[str, Any], OptionsOf(LookupFreeTokenizer)],
        net: Annotated[Mapping[str, Any], OptionsOf(Trunk)],
        conditioning: Mapping[str, Any],
        decoding: Mapping[str, Any],
        training: Annotated[Mapping[str, Any], OptionsOf(TokenTraining)],
        words: Mapping[str, Any],
        ending: Annotated[Mapping[str, Any], OptionsOf(Ending)],
    ):
        super().__init__()
        if window < 2:
            raise ValueError(f"{_KEY}.window={window} must be at least 2: a frame and one before it")
        self.window, self.ending = window, options(Ending, ending, f"{_KEY}.ending")
        self.register_buffer("threshold", torch.tensor(self.ending.threshold))
        self.register_buffer("longest", torch.tensor(window))
        self.video = TokenVideo(spec, window, codec, net, conditioning, decoding, training, _KEY)
        encoder: WordEncoder = build(words, f"{_KEY}.words")
        self.reader = WordReader(encoder, self.video.trunk.width, self.video.cond_tokens)

    @property
    def codec(self) -> LookupFreeTokenizer:
        """The tokenizer, which is trained apart."""
        return self.video.codec

    @property
    def max_frames(self) -> int:
        """Frames after which a golden trajectory ends, whatever it shows; see Ending."""
        return self.ending.max_frames or int(self.longest)

    def check(self, instructions: Sequence[str]) -> None:
        """Refuse instructions that would be cut.

        Raises:
            ConfigError: naming the text and the fix.
        """
        self.reader.check(sorted(set(instructions)))

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Training loss of clips of successful episodes, and figures to log.

        Args:
            clip: TensorDict [B] with frames uint8 [W, V, 3, H, W], valid bool [W], success float32 [W] (NaN
                where nobody says so) and text uint8 [TEXT_BYTES] (specs.text_to_bytes).
        """
        tokens, valid = self.video.encode(clip["frames"]), clip["valid"]
        success = torch.where(valid, clip["success"], torch.nan)
        cond = self.reader(bytes_to_text(clip["text"])).expand(-1, tokens.shape[1], -1, -1)
        return self.video.loss(Lesson(tokens, valid[:, 1:], success), cond, None, generator)

    @torch.no_grad()
    def imagine(self, first: Tensor, instruction: Sequence[str], seed: Tensor) -> GoldenTrajectory:
        """Golden trajectories.

        Args:
            first: uint8 [B, V, 3, H, W].
            instruction: B texts.
            seed: int64 [B]; an episode is the same in any batch.
        """
        tokens, done, goal, finished = self._continue(first, instruction, seed)
        frames = torch.cat([to_bytes(self.video.decode(new)) for new in tokens.split(1, 1)], 1)
        return GoldenTrajectory(*(part.to(first.device) for part in (frames, done, goal, finished)))

    @torch.no_grad()
    def imagine_goals(self, first: Tensor, instruction: Sequence[str], seed: Tensor) -> tuple[Tensor, Tensor]:
        """The frames uint8 [B, V, 3, H, W] with which golden trajectories end, and `finished` bool [B]; as of
        `imagine`, of whose other frames none is decoded.
        """
        tokens, _, goal, finished = self._continue(first, instruction, seed)
        ends = tokens[torch.arange(len(goal), device=goal.device), goal]
        frames = to_bytes(self.video.decode(ends[:, None]))[:, 0]
        return frames.to(first.device), finished.to(first.device)

    def _continue(
        self, first: Tensor, instruction: Sequence[str], seed: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Golden trajectories as tokens int64 [B, T, P, F], and what else a GoldenTrajectory says of them."""
        device = next(self.parameters()).device
        cond, known = self.reader(instruction), self.video.net.memory()
        self.video.net.observe(self.video.encode(first[:, None].to(device)), cond, None, known)
        draws = Draws([noise_generator(row, 0, Noise.GOLDEN) for row in seed.tolist()], device)
        ended, limit = torch.zeros(len(first), dtype=torch.bool, device=device), self.max_frames
        tokens: list[Tensor] = []
        done: list[Tensor] = []
        while True:
            new = self.video.next_frame(known, cond, None, draws)
            done_now = self.video.done(self.video.net.observe(new[:, None], cond, None, known).float())[:, 0]
            if tokens:  # those that have ended rest
                new = torch.where(ended[:, None, None], tokens[-1], new)
                done_now = torch.where(ended, done[-1], done_now)
            tokens.append(new)
            done.append(done_now)
            ended = ended | (done_now > self.threshold)
            if len(tokens) == limit or ended.all():
                break
        every = torch.stack(done, 1)
        over = every > self.threshold
        goal = torch.where(ended, over.long().argmax(1), over.shape[1] - 1)
        return torch.stack(tokens, 1), every, goal, ended

    @torch.no_grad()
    def redraw(self, frames: Tensor) -> Tensor:
        """Frames uint8 [B, T, V, 3, H, W] of any cameras as `imagine` would draw them."""
        return self.video.redraw(frames)

    @torch.no_grad()
    def done_along(self, frames: Tensor, instruction: Sequence[str]) -> Tensor:
        """What `imagine` would say of frames uint8 [B, T, V, 3, H, W] if it had made them: whether the task
        is done, float32 [B, T], by each frame and those before it in the window.
        """
        cond, known = self.reader(instruction), self.video.net.memory()
        tokens = self.video.encode(frames.to(cond.device))
        said = [
            self.video.done(self.video.net.observe(one, cond, None, known).float())
            for one in tokens.split(1, 1)
        ]
        return torch.cat(said, 1).to(frames.device)

    @torch.no_grad()
    def done(self, frames: Tensor, instruction: Sequence[str]) -> Tensor:
        """Whether the task is done, as this world says, float32 [B, T] in 0..1 of frames uint8 [B, T, V, 3,
        H, W] that follow one another.
        """
        device = next(self.parameters()).device
        tokens = self.video.encode(frames.to(device))
        cond = self.reader(instruction).expand(-1, tokens.shape[1], -1, -1)
        seen = self.video.net.observe(tokens, cond, None, self.video.net.memory())
        return self.video.done(seen.float()).to(frames.device)
