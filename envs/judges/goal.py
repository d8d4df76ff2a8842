"""Judges that compare frames with a picture of the goal: how much nearer to it than the episode began."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from envs.judges.base import Judge, Judgement, judgement_status
from envs.specs import WorldSpec
from envs.targets import build

_NEAREST = 1e-3  # of a first frame to its goal; nearer ones would make noise into progress
_AT_ONCE = 512  # frames compared in one pass


class Goals(NamedTuple):
    """Goals of B episodes: frames uint8 [B, V, 3, H, W], and known bool [B], whether there is one at all."""

    frames: Tensor
    known: Tensor


class GoalJudge(Judge):
    """Progress is the share of the first frame's distance to the goal that is gone; subclasses say what the
    goal is, and may say by something else when the task is done.

    Args:
        spec: what frames show.
        hold: frames in a row that make an episode a success.
        threshold: of success, until calibration sets it.
        metric: `_target_` and options of a distance of pictures: a module of two [N, 3, H, W] to [N] with a
            `name`, such as envs.judges.perceptual.PerceptualDistance or envs.judges.lpips.LPIPS.
        cameras: which are compared: "all", "main", or names.
    """

    def __init__(
        self,
        spec: WorldSpec,
        hold: int,
        threshold: float,
        metric: Mapping[str, Any],
        cameras: str | Sequence[str],
    ):
        super().__init__(hold, threshold)
        self.chosen = list(spec.embodiment.views_of(cameras))
        self.metric = build(metric, "judge.metric")
        self.metric.requires_grad_(False)

    @classmethod
    def check(cls, options: Mapping[str, Any]) -> None:
        """See Judge.check: what the metric needs is there."""
        build(options["metric"], "judge.metric")

    def goals(self, first: Tensor, instruction: list[str]) -> Goals:
        """The goals of episodes that began with `first` uint8 [B, V, 3, H, W], on its device."""
        raise NotImplementedError

    def as_goals(self, frames: Tensor) -> Tensor:
        """Frames uint8 [B, T, V, 3, H, W] of some cameras as a goal would show them, so that what making
        goals does to pictures is no distance from them; here as they are.
        """
        return frames

    def away(self, frames: Tensor, goals: Tensor) -> Tensor:
        """Distances float32 [B, T] of frames uint8 [B, T, V, 3, H, W], as goals show them, from goals uint8
        [B, V, 3, H, W], by the metric, mean over the cameras that are compared.
        """
        seen = self.as_goals(frames[:, :, self.chosen])
        wanted = goals[:, None, self.chosen].expand_as(seen)
        lead = seen.shape[:3]
        pairs = zip(seen.flatten(0, 2).split(_AT_ONCE), wanted.flatten(0, 2).split(_AT_ONCE), strict=True)
        return torch.cat([self.metric(one, other) for one, other in pairs]).unflatten(0, lead).mean(-1)

    def done(
        self, frames: Tensor, instruction: list[str], progress: Tensor, features: Tensor | None = None
    ) -> Tensor:
        """Probabilities [B, T] that the task is done in frames; here it is progress itself. Features as of
        `score`.
        """
        return progress

    def unknown(self, success: Tensor, status: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
        """Success [B, T] and status [B] where goals may not be `known` [B]; here they always are."""
        return success, status

    def facts(self) -> dict[str, Any]:
        """See Judge.facts."""
        return {"metric": self.metric.name}

    @torch.no_grad()
    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        """See Judge.score; the judgement lies on the device of the frames."""
        device = self.threshold.device
        frames_here, first_here = frames.to(device), first.to(device)
        goals = self.goals(first_here, instruction)
        begin = self.away(first_here[:, None], goals.frames).clamp(min=_NEAREST)
        progress = (1 - self.away(frames_here, goals.frames) / begin).clamp(0, 1)
        success = self.done(frames_here, instruction, progress, features)
        status = judgement_status(success + progress)
        success, status = self.unknown(success, status, goals.known)
        return Judgement(*(part.to(frames.device) for part in (success, progress, status)))
