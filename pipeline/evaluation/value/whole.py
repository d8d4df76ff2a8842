"""Imagined episodes judged when they are over, as one clip (WPE): what a judge is shown is then the whole
rollout, and it is asked once, where RL asks it after every chunk.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from envs.judges.base import Judge, Judgement, ask
from envs.specs import Status


class Onlooker(Judge):
    """Watches the chunks of episodes that begin together, and judges them at the last by another judge.

    Until then nobody has succeeded; then all frames of the last chunk are successes, or none. Progress is
    worth nothing: at an episode's beginning it is not to be asked (judge.rewards.progress=0).

    Args:
        judge: who decides.
        chunks: of an episode.
    """

    def __init__(self, judge: Judge, chunks: int):
        super().__init__(hold=1)
        self.judge, self.chunks = judge, chunks
        self.reads_features = judge.reads_features
        self._seen: list[tuple[Tensor, ...]] = []
        self._first: Tensor | None = None

    def facts(self) -> dict[str, Any]:
        """See Judge.facts; those of the judge."""
        return self.judge.facts()

    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        """See Judge.score: of one chunk [B, K, ...] of every episode."""
        if self._first is None or not torch.equal(self._first, first):  # the episodes before broke off
            self._seen, self._first = [], first.clone()
        self._seen.append((frames.cpu(), *([] if features is None else [features.cpu()])))
        nobody = torch.zeros(frames.shape[:2], device=frames.device)
        fine = torch.full((len(frames),), Status.OK.value, device=frames.device)
        if len(self._seen) < self.chunks:
            return Judgement(nobody, nobody, fine)
        whole = [torch.cat(parts, 1) for parts in zip(*self._seen, strict=True)]
        self._seen, self._first = [], None
        found = ask(self.judge, whole[0], first.cpu(), instruction, *whole[1:])
        every = torch.ones(found.success.shape, dtype=torch.bool, device=found.success.device)
        won = self.judge.episode(found.success, every).to(frames.device)
        success = won[:, None].float().expand_as(nobody)
        return Judgement(success, success, found.status.to(frames.device))
