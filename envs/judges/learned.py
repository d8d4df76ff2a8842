"""The learned judge: every frame gets a success probability and a progress, given the episode's first frame
and the instruction.

The first frame says where things were before an arm stood in front of them or a block lay upon the target.
Whether
it is done is a matter of millimetres between things, so some of the judge's key-points are taught to lie on
them, as
far as the data say where they are, and it looks closely there. How far they lie apart on the ground decides
on
success, and nothing else: whatever was learned beside it cost verdicts. Progress, and success where the data
say
nothing of places, take in all that is seen.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.encoders import Gaze, PatchEncoder, WordEncoder, to_signed
from envs.judges.base import Judge, Verdict, ok_status
from envs.specs import Status


class LearnedJudge(Judge):
    """Convolutional frame judge with a success and a progress head (GE-Sim 2.0's judge, at a small size).

    Args:
        views: cameras per frame; the first is looked at closely, the others in passing.
        hold: frames in a row that make an episode a success.
        margin: half-width of the band around the threshold in which a clip's best frame makes the judge
            abstain.
        width, points: of the encoder of the first view.
        aims: key-points that are taught to lie on the objects of the data, in their order; 0 where no gap
            between things makes a success.
    """

    def __init__(
        self,
        views: int = 3,
        hold: int = 4,
        margin: float = 0.0,
        width: int = 24,
        points: int = 24,
        aims: int = 2,
    ):
        super().__init__(0.5, hold)
        self.margin, self.aims = margin, aims
        self.main = Gaze(points, width, aims, pictures=2)
        self.sides = nn.ModuleList(PatchEncoder(16, 8) for _ in range(views - 1))
        self.words = WordEncoder(16)
        self.apart = nn.Sequential(
            nn.Linear(self.main.gaps + 16, 64), nn.SiLU(), nn.Linear(64, 64), nn.SiLU(), nn.Linear(64, 1)
        )
        self.look = nn.Sequential(
            nn.Linear(self.main.out_features + 16 * views, 128),
            nn.SiLU(),
            nn.Linear(128, 128),
            nn.SiLU(),
            nn.Linear(128, 1),
        )
        self.sharpness = nn.Parameter(torch.tensor([2.0]))  # FSDP2 takes no scalars
        self.enough = nn.Linear(16, 1)
        # Words say which two things it is about, not how near is near: that they learned from colours by
        # heart.
        self.pair = nn.Parameter(torch.zeros(16, self.main.gaps))
        self.near = nn.Parameter(torch.ones(self.main.gaps))
        self.strictness = nn.Parameter(torch.tensor([2.5]))

    def forward(
        self, frames: Tensor, first: Tensor, tokens: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Logits of success and of progress, float32 [N], and where it sees the objects, at a first look and
        closely, [N, 2, aims, 2] in half-pictures from the middle.

        Args:
            frames, first: uint8 or float (-1..1) [N, V, 3, H, W]; tokens: int64 [N, WORDS].
            generator: draws what is left out in training; see also CloseUp.
        """
        pictures = to_signed(frames)
        pair = torch.cat((pictures[:, 0], to_signed(first[:, 0])), 1)
        seen, aimed = self.main(pair, generator)
        parts = [seen, *(side(pictures[:, k + 1]) for k, side in enumerate(self.sides))]
        words = self.words(tokens)
        look = self.look(torch.cat([*parts, words], -1)).float()
        # what is seen can be learned by heart: half of the time the gaps must do without it
        if generator is not None:
            look = look * (torch.rand((len(look), 1), generator=generator) < 0.5).to(look.device)
        gaps = seen[:, seen.shape[1] - self.main.gaps :]
        progress = (self.apart(torch.cat((gaps, words), -1)).float() + look)[:, 0]
        # Success is progress beyond what the words call enough; progress is taught by every frame, and by
        # centimetres only:
        # taught by successes too, it saw things closer together than they are. Gaps are detached for the same
        # reason.
        success = self.sharpness * progress.detach() + self.enough(words)[:, 0].float()
        if self.main.gaps:
            nearer = ((words @ self.pair).softmax(-1) * (self.near - gaps.detach())).sum(-1).float()
            success = torch.where(self.main.surveyed.all(), self.strictness.exp() * nearer, success)
        return success, progress, aimed

    @torch.no_grad()
    def score(self, frames: Tensor, first: Tensor, tokens: Tensor, objects: Tensor | None = None) -> Verdict:
        """See Judge.score; `objects` is ignored."""
        batch, count = frames.shape[:2]  # of the first frames only the first view is looked at
        logit, progress, _ = self(
            frames.flatten(0, 1), first[:, :1].repeat_interleave(count, 0), tokens.repeat_interleave(count, 0)
        )
        success = logit.sigmoid().unflatten(0, (batch, count))
        status = ok_status(success)
        if self.margin:
            near = ((success.amax(1) - self.threshold).abs() < self.margin) & (status == Status.OK.value)
            status = torch.where(near, Status.ABSTAIN.value, status)
        return Verdict(success, progress.sigmoid().unflatten(0, (batch, count)), status)

    def loss(
        self, data: TensorDict, share: float, generator: torch.Generator | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Class-balanced cross-entropy of success plus the absolute errors of progress and of where things
        are seen.

        Args:
            data: TensorDict [N] with frames, first and tokens as in `forward`, label float in {0, 1} and
                progress float in 0..1, both NaN
                where nobody knows, where float [aims, 2], half-pictures from the middle of the first view,
                NaN where nobody knows, and
                drill, pictures [2, 3, H, W] of the first view now and at first, with drilled [aims, 2], where
                things are in them.
            share: fraction of positive frames in the data, by which the classes are balanced.
            generator: see `forward`.
        """
        logit, towards, aimed = self(data["frames"], data["first"], data["tokens"], generator)
        known = torch.isfinite(data["label"])
        count, label = known.sum().clamp(min=1), torch.nan_to_num(data["label"])
        weight = torch.where(label > 0.5, 0.5 / max(share, 1e-3), 0.5 / max(1 - share, 1e-3)) * known
        success = (F.binary_cross_entropy_with_logits(logit, label, reduction="none") * weight).sum() / count
        # Cross-entropy hardly minds a few hundredths of progress, which are the centimetre that decides.
        shaped = ((towards.sigmoid() - torch.nan_to_num(data["progress"])).abs() * known).sum() / count
        right = (((logit > 0) == (label > 0.5)) & known).sum() / count
        off = Gaze.missed(aimed, data["where"])
        more = self.main.drill(data["drill"].flatten(1, 2), data["drilled"], generator)
        figures = {
            "success": success.detach(),
            "frame_accuracy": right,
            "progress_error": shaped.detach(),
            "aim_error": off[1].detach(),
        }
        return success + 10.0 * shaped + 48.0 * (off.sum() + more), figures
