"""The rule judge: the true distance between block and target, behind the interface of the learned one."""

from __future__ import annotations

import torch
from torch import Tensor

from envs.judges.base import Judge, Verdict, ok_status
from envs.physics.tabletop.tasks import Push


class RuleJudge(Judge):
    """Applies the task's own rule to true positions; can judge physics only.

    Args:
        task: whose radius, hold and scale apply.
        control_hz: frames per second.
    """

    def __init__(self, task: Push | None = None, control_hz: float = 10.0):
        self.task = task or Push()
        super().__init__(threshold=0.5, hold=max(1, round(self.task.hold * control_hz)))

    def score(self, frames: Tensor, first: Tensor, tokens: Tensor, objects: Tensor | None = None) -> Verdict:
        """See Judge.score.

        Raises:
            ValueError: without true positions, as in imagination.
        """
        if objects is None:
            raise ValueError(
                "judge=rule needs true object positions, which only physics has; use judge=learned for imagined video"
            )
        distance = (objects[..., 0, :2] - objects[..., 1, :2]).norm(dim=-1)
        success = (distance < self.task.radius).float()
        progress = (1 - distance / self.task.scale).clamp(0, 1)
        return Verdict(
            success, progress, ok_status(torch.where(torch.isfinite(distance), success, torch.nan))
        )
