"""The judge that asks physics."""

from __future__ import annotations

import pytest
import torch

from envs.judges import LearnedJudge, RuleJudge
from envs.specs import Status
from tests.embodiments import ARM_DELTAS, world_spec


def test_physics_own_judgement_passes_through_and_pictures_are_refused() -> None:
    judge = RuleJudge(hold=1)
    success = torch.tensor([[False, True], [False, False]])
    judgement = judge.judgement(success, torch.tensor([[0.5, 1.2], [0.1, torch.nan]]))
    assert judgement.success.tolist() == [[0.0, 1.0], [0.0, 0.0]] and float(judgement.progress[0, 1]) == 1.0
    assert judgement.status.tolist() == [Status.OK.value, Status.ERROR.value]
    with pytest.raises(ValueError, match="judge=learned"):
        judge.score(torch.zeros(1), torch.zeros(1), [""])


def test_near_its_threshold_a_judge_abstains() -> None:
    spec = world_spec(ARM_DELTAS)
    judge = LearnedJudge(
        spec, 2, 0.1, 0.9, width=8, points=4, hidden=8, cameras="all", instruction_keypoints=0
    ).eval()
    frames = torch.zeros(1, 2, spec.views, 3, *spec.size, dtype=torch.uint8)
    best = judge.score(frames, frames[:, 0], ["x"]).success.max()
    for away, status in ((0.05, Status.ABSTAIN), (0.2, Status.OK)):
        judge.threshold.fill_(float(best) + away)
        assert int(judge.score(frames, frames[:, 0], ["x"]).status) == status.value


def test_a_hold_of_no_frames_is_refused() -> None:
    with pytest.raises(ValueError, match=r"judge\.hold=0"):
        RuleJudge(hold=0)
