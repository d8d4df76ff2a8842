"""The learned judge: every frame gets a success probability and a progress, given the episode's first frame and the instruction.

The first frame says where things were before an arm stood in front of them or a block lay upon the target.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from envs.encoders import PatchEncoder, SpatialEncoder, WordEncoder, to_signed
from envs.judges.base import Judge, Verdict, ok_status
from envs.schema import Status


class LearnedJudge(Judge):
    """Convolutional frame judge with a success and a progress head (GE-Sim 2.0's judge, at a small size).

    Args:
        views: cameras per frame; the first is looked at closely, the others in passing.
        hold: frames in a row that make an episode a success.
        margin: half-width of the band around the threshold in which a clip's best frame makes the judge abstain.
    """

    def __init__(self, views: int = 3, hold: int = 4, margin: float = 0.0, width: int = 24, points: int = 24):
        super().__init__(0.5, hold)
        self.margin = margin
        self.main = SpatialEncoder(points, width, pictures=2)
        self.sides = nn.ModuleList(PatchEncoder(16, 8) for _ in range(views - 1))
        self.words = WordEncoder(16)
        self.sharpness = nn.Parameter(torch.tensor(2.0))
        self.head = nn.Sequential(nn.Linear(self.main.out_features + 16 * views, 128), nn.SiLU(), nn.Linear(128, 128), nn.SiLU(), nn.Linear(128, 2))

    def forward(self, frames: Tensor, first: Tensor, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Logits of success and of progress, float32 [N], for frames and first frames uint8 or float (-1..1) [N, V, 3, H, W] and tokens [N, WORDS]."""
        pictures = to_signed(frames)
        parts = [self.main(torch.cat((pictures[:, 0], to_signed(first[:, 0])), 1))] + [side(pictures[:, k + 1]) for k, side in enumerate(self.sides)]
        out = self.head(torch.cat([*parts, self.words(tokens)], -1)).float()
        # Success is for the most part progress beyond some point, and progress is taught by every frame.
        return out[:, 0] + self.sharpness * out[:, 1], out[:, 1]

    @torch.no_grad()
    def score(self, frames: Tensor, first: Tensor, tokens: Tensor, objects: Tensor | None = None) -> Verdict:
        """See Judge.score; `objects` is ignored."""
        batch, count = frames.shape[:2]
        logit, progress = self(frames.flatten(0, 1), first.repeat_interleave(count, 0), tokens.repeat_interleave(count, 0))
        success = logit.sigmoid().unflatten(0, (batch, count))
        status = ok_status(success)
        if self.margin:
            near = ((success.amax(1) - self.threshold).abs() < self.margin) & (status == Status.OK.value)
            status = torch.where(near, Status.ABSTAIN.value, status)
        return Verdict(success, progress.sigmoid().unflatten(0, (batch, count)), status)

    def loss(self, frames: Tensor, first: Tensor, tokens: Tensor, label: Tensor, progress: Tensor, share: float) -> tuple[Tensor, dict[str, Any]]:
        """Class-balanced cross-entropy of success plus the absolute error of progress.

        Args:
            label: float [N] in {0, 1}; progress: float [N] in 0..1.
            share: fraction of positive frames in the data, by which the classes are balanced.
        """
        logit, towards = self(frames, first, tokens)
        weight = torch.where(label > 0.5, 0.5 / max(share, 1e-3), 0.5 / max(1 - share, 1e-3))
        success = (F.binary_cross_entropy_with_logits(logit, label, reduction="none") * weight).mean()
        # Cross-entropy hardly minds a few hundredths of progress, which are the centimetre that decides.
        shaped = (towards.sigmoid() - progress).abs().mean()
        right = ((logit > 0) == (label > 0.5)).float().mean()
        return success + 10.0 * shaped, {"success": success.detach(), "frame_accuracy": right, "progress_error": shaped.detach()}
