"""A judge that sees imagined episodes when they are over."""

from __future__ import annotations

import torch

from envs.judges.base import Judge, Judgement
from envs.specs import Status
from pipeline.evaluation.value.whole import Onlooker


class Bright(Judge):
    """Takes bright frames for successes, and gives no judgement on an episode that begins black."""

    def __init__(self) -> None:
        super().__init__(hold=2)
        self.shown: list[torch.Size] = []

    def score(
        self,
        frames: torch.Tensor,
        first: torch.Tensor,
        instruction: list[str],
        features: torch.Tensor | None = None,
    ) -> Judgement:
        self.shown.append(frames.shape)
        success = (frames.float().flatten(2).mean(2) > 100).float()
        dark = first.float().flatten(1).mean(1) == 0
        status = torch.where(dark, Status.ABSTAIN.value, Status.OK.value)
        return Judgement(success, success, status)


def test_episodes_are_judged_once_as_one_clip() -> None:
    bright = Bright()
    judge, texts = Onlooker(bright, 3), ["a", "b", "c"]
    first = torch.tensor([9, 9, 0], dtype=torch.uint8)[:, None, None, None, None].expand(3, 1, 3, 4, 4)
    frames = torch.zeros(3, 6, 1, 3, 4, 4, dtype=torch.uint8)
    frames[0, 1:3] = 200  # across two chunks, and over before the end
    frames[1, 1] = frames[1, 3] = 200  # never two in a row
    for _ in range(2):  # as often as there are repeats
        found = [judge.score(frames[:, 2 * n : 2 * n + 2], first, texts) for n in range(3)]
        assert not any(bool(one.success.any()) for one in found[:2])
        assert found[2].success.tolist() == [[1.0, 1.0], [0.0, 0.0], [0.0, 0.0]]
        assert found[2].status.tolist() == [Status.OK.value] * 2 + [Status.ABSTAIN.value]
        assert bool(judge.streak(found[2].success, torch.zeros(3, dtype=torch.int64))[0][0].all())
    assert [tuple(shape[:2]) for shape in bright.shown] == [(3, 6)] * 2
    judge.score(frames[:, :2], first, texts)  # broke off
    other = first + 1
    for n in range(3):
        found[n] = judge.score(frames[:, 2 * n : 2 * n + 2], other, texts)
    assert len(bright.shown) == 3 and found[2].success[0].all()
