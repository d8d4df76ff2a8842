"""The contract of a judge, and how frame verdicts become an episode's success."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from envs.specs import Status


class Verdict(NamedTuple):
    """success float32 [B, T] (probability in 0..1), progress float32 [B, T] in 0..1, status int64 [B]
    (schema.Status).
    """

    success: Tensor
    progress: Tensor
    status: Tensor


class Judge(nn.Module):
    """Scores video against an instruction.

    Args:
        threshold: frame probability from which a frame counts as success.
        hold: frames in a row that must count before the episode does.
    """

    threshold: Tensor

    def __init__(self, threshold: float = 0.5, hold: int = 4):
        super().__init__()
        self.register_buffer("threshold", torch.tensor(threshold))
        self.hold = hold

    def score(self, frames: Tensor, first: Tensor, tokens: Tensor, objects: Tensor | None = None) -> Verdict:
        """Judge clips.

        Args:
            frames: uint8 [B, T, V, 3, H, W].
            first: uint8 [B, V, 3, H, W], the episode's first frame, in which everything can still be seen.
            tokens: int64 [B, WORDS], the instruction (language.tokenize).
            objects: float32 [B, T, 2, 4] true places of block and target (schema.OBJECT_DIM); only the rule
                judge looks.
        """
        raise NotImplementedError

    def begin(self, frames: Tensor, first: Tensor, tokens: Tensor) -> Any:
        """Hand clips over for a verdict that is fetched later with `end`; a judge in this process puts it off
        until then.
        """
        return frames, first, tokens

    def end(self, ticket: Any) -> Verdict:
        """The verdict on what `begin` was given."""
        return self.score(*ticket)

    def streak(self, success: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Whether `hold` frames in a row were successes by the end of each frame.

        Args:
            success: [B, T] probabilities; before: int64 [B], the run of successes that precedes them.

        Returns:
            done bool [B, T] and the run at the end, int64 [B].
        """
        run, done = before, []
        for frame in (success >= self.threshold).unbind(1):
            run = torch.where(frame, run + 1, 0)
            done.append(run >= self.hold)
        return torch.stack(done, 1), run

    def episode(self, success: Tensor, valid: Tensor) -> Tensor:
        """Episode success bool [B] from frame probabilities [B, T] and which frames exist [B, T]."""
        masked = torch.where(valid, success, 0.0)
        done, _ = self.streak(masked, torch.zeros(len(success), dtype=torch.int64, device=success.device))
        return done.any(1)


def frame_labels(success: Tensor, hold: int) -> Tensor:
    """Frame targets y_i = 1[i >= i_success], float32 [B, T], from the recorded success [B, T].

    Recorded success turns true at the end of the hold; i_success is the first frame of that hold.
    """
    ever = success.cummax(-1).values.float()
    ahead = torch.nn.functional.pad(ever, (0, hold - 1), mode="replicate") if ever.ndim > 1 else ever
    return ahead[..., hold - 1 :]


def ok_status(success: Tensor) -> Tensor:
    """Status int64 [B]: ERROR where a probability is not finite, OK elsewhere."""
    bad = ~torch.isfinite(success).all(1)
    return torch.where(bad, Status.ERROR.value, Status.OK.value)
