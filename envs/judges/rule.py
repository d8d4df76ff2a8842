"""The judge that asks physics: a task suite's own success and progress as judgements."""

from __future__ import annotations

from torch import Tensor

from envs.judges.base import Judge, Judgement, judgement_status


class RuleJudge(Judge):
    """The judgement of a task suite itself; it can judge physics only, because no picture shows it.

    Args:
        hold: 1 where the suite counts the hold itself, as suites here do.
    """

    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        """Refused: see `judgement`.

        Raises:
            ValueError: always; generated video has no rule to ask.
        """
        raise ValueError(
            "RuleJudge reads the task suite's own success and cannot judge pictures; use judge=learned for"
            " generated video"
        )

    def judgement(self, success: Tensor, progress: Tensor) -> Judgement:
        """Judgements on what PhysicsEnv says: success bool [B, T] and progress float32 [B, T] in 0..1."""
        probability = success.float()
        return Judgement(probability, progress.clamp(0, 1), judgement_status(progress + probability))
