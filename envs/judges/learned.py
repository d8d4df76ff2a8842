"""The learned judge: each frame gets a success probability and a progress, from pixels and words alone.

The episode's first frame is shown beside each frame, because it says where things were before something moved
or hid them (GE-Sim 2.0 judges video so, with a large vision-language model).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.encoders import MultiViewEncoder, to_signed
from envs.judges.base import Judge, Judgement, judgement_status
from envs.language import TextEncoder
from envs.ranges import Count, Discount, Natural, Share
from envs.specs import Status, WorldSpec, text_to_bytes

_AT_ONCE = 512  # frames per forward pass of `score`, so that long clips of many episodes fit into memory


class LearnedJudge(Judge):
    """Convolutional frame judge with a success and a progress head.

    Args:
        spec: what frames show; any number of views of any size.
        cameras: which it looks through: "all", "main", or names.
        hold: frames in a row that make an episode a success.
        margin: half-width of the band around the threshold in which a clip's best frame makes the judge
            abstain.
        discount: per frame, of the progress target: discount ** (frames until success).
        width: channels of the encoder at half resolution.
        points: soft key-points of the encoder.
        text: size of the encoded instruction.
        hidden: width of the last layers.
        asked: key-points per view that look for what the instruction says.
    """

    def __init__(
        self,
        spec: WorldSpec,
        hold: Count,
        margin: Share,
        discount: Discount,
        width: Count,
        points: Count,
        text: Count,
        hidden: Count,
        cameras: str | Sequence[str],
        asked: Natural,
    ):
        super().__init__(hold)
        self.spec, self.margin, self.discount = spec, margin, discount
        self.encoder = MultiViewEncoder(
            spec, points, width, pictures=2, cameras=cameras, asked=asked, words=text
        )
        self.asked = asked
        self.words = TextEncoder(text)
        self.head = nn.Sequential(
            nn.Linear(self.encoder.out_features + text, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            nn.Linear(hidden, 2),
        )

    def forward(self, frames: Tensor, first: Tensor, text: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of success and of progress, each float32 [N].

        Args:
            frames, first: [N, V, 3, H, W], uint8 or float in -1..1.
            text: uint8 [N, TEXT_BYTES], the instructions (specs.text_to_bytes).
        """
        bytes_alone = frames.dtype == first.dtype == torch.uint8  # the encoder converts what it looks at
        both = (frames, first) if bytes_alone else (to_signed(frames), to_signed(first))
        words = self.words(text)
        seen = self.encoder(torch.cat(both, 2), words if self.asked else None)
        success, progress = self.head(torch.cat((seen, words), -1)).float().unbind(-1)
        return success, progress

    @torch.no_grad()
    def score(self, frames: Tensor, first: Tensor, instruction: list[str]) -> Judgement:
        """See Judge.score; the judgement lies on the device of the frames."""
        batch, count = frames.shape[:2]
        device, text = self.threshold.device, text_to_bytes(instruction)
        rows = torch.arange(batch).repeat_interleave(count)
        shown, parts = frames.flatten(0, 1), []
        for number, some in enumerate(rows.split(_AT_ONCE)):
            seen = shown[number * _AT_ONCE : number * _AT_ONCE + len(some)]
            beside = first[some.to(first.device)]
            parts.append(torch.stack(self(seen.to(device), beside.to(device), text[some].to(device))))
        success, progress = torch.cat(parts, 1).sigmoid().to(frames.device).unflatten(1, (batch, count))
        return Judgement(success, progress, self._status(success))

    def _status(self, success: Tensor) -> Tensor:
        """Status [B] of probabilities [B, T]."""
        status = judgement_status(success)
        if not self.margin:
            return status
        near = (success.amax(1) - self.threshold.to(success.device)).abs() < self.margin
        return torch.where(near & (status == Status.OK.value), Status.ABSTAIN.value, status)

    def loss(self, data: TensorDict, share: float) -> tuple[Tensor, dict[str, Any]]:
        """Class-balanced cross-entropy of success plus cross-entropy of progress.

        Args:
            data: TensorDict [N] with frames, first and text as in `forward`, label float32 in {0, 1} and
                progress float32 in 0..1, both NaN where nobody labelled the episode: such frames teach
                nothing.
            share: fraction of successes among the labels, by which the classes are balanced.
        """
        logit, nearing = self(data["frames"], data["first"], data["text"])
        known = torch.isfinite(data["label"])
        count, label = known.sum().clamp(min=1), torch.nan_to_num(data["label"])
        weight = torch.where(label > 0.5, 0.5 / max(share, 1e-3), 0.5 / max(1 - share, 1e-3)) * known
        success = (F.binary_cross_entropy_with_logits(logit, label, reduction="none") * weight).sum() / count
        target = torch.nan_to_num(data["progress"])
        shaped = F.binary_cross_entropy_with_logits(nearing, target, reduction="none") * known
        figures = {
            "success": success.detach(),
            "frame_accuracy": (((logit > 0) == (label > 0.5)) & known).sum() / count,
            "progress_error": ((nearing.detach().sigmoid() - target).abs() * known).sum() / count,
        }
        return success + shaped.sum() / count, figures
