"""Targets from success and time alone."""

from __future__ import annotations

import pytest
import torch

from envs.judges.labels import progress_to_success, success_labels


def test_progress_rises_towards_the_first_success_and_stays() -> None:
    success = torch.tensor([[0, 0, 0, 1, 0, 1], [0, 0, 0, 0, 0, 0]]).bool()
    progress = progress_to_success(success, 0.5)
    assert progress[0].tolist() == [0.125, 0.25, 0.5, 1.0, 1.0, 1.0]
    assert progress[1].tolist() == [0.0] * 6
    assert torch.equal(progress_to_success(success[0], 0.5), progress[0])


@pytest.mark.parametrize("discount", [0.0, 1.5])
def test_a_discount_that_is_none_is_refused(discount: float) -> None:
    with pytest.raises(ValueError, match=f"discount={discount}"):
        progress_to_success(torch.ones(3), discount)


def test_success_begins_where_its_hold_began_and_lasts() -> None:
    success = torch.tensor([0, 0, 0, 0, 1, 0]).bool()
    assert success_labels(success, 1).tolist() == [0, 0, 0, 0, 1, 1]
    assert success_labels(success, 3).tolist() == [0, 0, 1, 1, 1, 1]
    assert success_labels(torch.zeros(2, 4).bool(), 3).tolist() == [[0.0] * 4] * 2


def test_success_known_only_at_the_end_still_makes_a_whole_streak() -> None:
    success = torch.tensor([0, 0, 0, 0, 0, 1]).bool()  # as next.success of a foreign data set
    assert success_labels(success, 4).sum() == 4
