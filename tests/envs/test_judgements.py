"""What a judge of somebody else answers is held to the contract, and its errors are told as its own."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from envs.judges.base import Judge, JudgeError, Judgement, MissingFeatures, ask
from envs.specs import Status
from tests.embodiments import ARM_DELTAS
from tests.envs.test_world import Fixed, world

FRAMES = torch.zeros(2, 3, 1, 3, 4, 4, dtype=torch.uint8)
FINE = {"success": torch.full((2, 3), 0.5), "progress": torch.ones(2, 3), "status": torch.zeros(2).long()}


class Odd(Judge):
    """Answers what it is given, or raises it."""

    def __init__(self, answer: Any):
        super().__init__(hold=1)
        self.answer = answer

    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer  # type: ignore[no-any-return]


def asked(answer: Any) -> Judgement:
    return ask(Odd(answer), FRAMES, FRAMES[:, 0], ["do it"] * 2)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("success", torch.full((2, 3), 8.0), r"success 8 where its status is OK; give 0\.\.1"),
        ("success", torch.full((2, 3), torch.nan), r"success nan where its status is OK"),
        ("success", torch.ones(2, 3, dtype=torch.bool), r"success bool \[2, 3\] .* give float32 \[2, 3\]"),
        ("success", torch.ones(2), r"success float32 \[2\] on 2 clips of 3 frames; give float32 \[2, 3\]"),
        ("progress", 100 * torch.ones(2, 3), r"progress 100 where its status is OK"),
        ("progress", [[0.5] * 3] * 2, r"progress list on"),
        ("status", torch.zeros(2, 1).long(), r"status int64 \[2, 1\] .* give int64 \[2\]"),
        ("status", torch.zeros(2), r"status float32 \[2\] .* give int64 \[2\]"),
        ("status", None, r"status NoneType on"),
        ("status", torch.full((2,), 7), r"status \[7, 7\]; each is one of envs\.specs\.Status"),
    ],
)
def test_what_is_no_judgement_is_refused_by_name(name: str, value: Any, said: str) -> None:
    with pytest.raises(JudgeError, match=rf"judge: Odd\.score gives {said}"):
        asked(Judgement(**{**FINE, name: value}))


def test_a_tuple_is_no_judgement_and_other_precisions_are_brought_to_ours() -> None:
    with pytest.raises(JudgeError, match=r"Odd\.score gives a tuple; give an envs\.judges\.base\.Judgement"):
        asked(tuple(FINE.values()))
    found = asked(Judgement(FINE["success"].double(), FINE["progress"].half(), FINE["status"].int()))
    assert [value.dtype for value in found] == [torch.float32, torch.float32, torch.int64]


def test_numbers_of_episodes_that_were_not_judged_mean_nothing() -> None:
    nothing = torch.full((2, 3), torch.nan)
    status = torch.full((2,), Status.ABSTAIN.value)
    assert torch.equal(asked(Judgement(nothing, nothing, status)).status, status)


def test_an_error_of_a_judge_names_its_class_and_line_and_keeps_its_cause() -> None:
    cause = KeyError("lens")
    with pytest.raises(
        JudgeError, match=r"Odd\.score raised KeyError: 'lens' \(.*test_judgements\.py, line"
    ) as told:
        asked(cause)
    assert told.value.__cause__ is cause
    for known in (JudgeError("budget"), MissingFeatures("none")):
        with pytest.raises(type(known), match=str(known)):
            asked(known)


@pytest.mark.parametrize("progress", [0.0, 1.0])
def test_reinforcement_learning_asks_so(progress: float) -> None:
    odd = world(ARM_DELTAS.robot, 2, Fixed(8.0), progress=progress)
    with pytest.raises(JudgeError, match=r"judge: Fixed\.score gives success 8"):
        odd.rollout(1)
