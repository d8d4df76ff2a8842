"""Judges whose frames get logits of success and of progress, fitted to recorded success and time alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor

from envs.judges.base import Judge, Judgement, judgement_status
from envs.specs import Status, text_to_bytes

_AT_ONCE = 512  # frames per forward pass of `score`, so that long clips of many episodes fit into memory


class FittedJudge(Judge):
    """What fitted judges share: the loss, and how logits become a judgement. `forward` takes the data of
    Judge.loss and returns logits of success and progress, float32 [N, 2].

    Args:
        hold: frames in a row that make an episode a success.
        margin: half-width of the band around the threshold in which a clip's best frame makes the judge
            abstain.
        discount: per frame, of the progress target: discount ** (frames until success).
    """

    needs_labels = True

    def __init__(self, hold: int, margin: float, discount: float):
        super().__init__(hold)
        self.margin, self.discount = margin, discount

    @classmethod
    def remedy(cls, options: Mapping[str, Any]) -> str:
        """See Judge.remedy."""
        return (
            f"it abstains within judge.margin={options['margin']} of its threshold: lower that, or teach it"
            " longer or on more episodes (judge_fit)"
        )

    def loss(self, data: TensorDict) -> tuple[Tensor, dict[str, Any]]:
        """Cross-entropy of success, its classes balanced by their shares in the batch, plus that of progress;
        see Judge.loss.
        """
        logit, nearing = self(data).unbind(-1)
        known = torch.isfinite(data["label"])
        count, label = known.sum().clamp(min=1), torch.nan_to_num(data["label"])
        share = (label.sum() / count).clamp(0.02, 0.98)
        weight = torch.where(label > 0.5, 0.5 / share, 0.5 / (1 - share)) * known
        success = (F.binary_cross_entropy_with_logits(logit, label, reduction="none") * weight).sum() / count
        target = torch.nan_to_num(data["progress"])
        shaped = F.binary_cross_entropy_with_logits(nearing, target, reduction="none") * known
        figures = {
            "success": success.detach(),
            "frame_accuracy": (((logit > 0) == (label > 0.5)) & known).sum() / count,
            "progress_error": ((nearing.detach().sigmoid() - target).abs() * known).sum() / count,
        }
        return success + shaped.sum() / count, figures

    def judgement(self, logits: Tensor) -> Judgement:
        """The judgement of logits [B, T, 2], on their device."""
        success, progress = logits.sigmoid().unbind(-1)
        status = judgement_status(success)
        if self.margin:
            near = (success.amax(1) - self.threshold.to(success.device)).abs() < self.margin
            status = torch.where(near & (status == Status.OK.value), Status.ABSTAIN.value, status)
        return Judgement(success, progress, status)


class FrameJudge(FittedJudge):
    """A fitted judge that looks at one frame at a time, in any order."""

    @torch.no_grad()
    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        """See Judge.score; the judgement lies on the device of the frames."""
        batch, count = frames.shape[:2]
        device, text = self.threshold.device, text_to_bytes(instruction)
        rows = torch.arange(batch).repeat_interleave(count)
        shown, parts = frames.flatten(0, 1), []
        for number, some in enumerate(rows.split(_AT_ONCE)):
            seen = shown[number * _AT_ONCE : number * _AT_ONCE + len(some)]
            beside = first[some.to(first.device)]
            data = {"frames": seen.to(device), "first": beside.to(device), "text": text[some].to(device)}
            parts.append(self(TensorDict(data, [len(some)])))
        return self.judgement(torch.cat(parts).to(frames.device).unflatten(0, (batch, count)))
