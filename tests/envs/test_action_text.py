"""Actions as the text of their digits."""

from __future__ import annotations

import pytest
import torch

from envs.conditioning import ActionText, ActionVector
from tests.embodiments import ARM_DELTAS


def test_digits_signs_and_points_are_words() -> None:
    text = ActionText(ARM_DELTAS, decimals=1)
    assert text.describe([-37.04, 0.25, 120.0]) == "minus 3 7 point 0 plus 0 point 2 plus 1 2 0 point 0"
    assert ActionText(ARM_DELTAS, decimals=0).describe([-0.6]) == "minus 1"


def test_it_stands_in_for_the_vector_and_nothing_of_it_learns() -> None:
    commands, now = torch.tensor([[[1.0, -2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0]]]), torch.zeros(1, 4)
    text, vector = ActionText(ARM_DELTAS, decimals=0), ActionVector(ARM_DELTAS)
    for told in (text, vector):
        assert told(commands, now).shape == (1, 2, told.size)
    rows = text(commands, now)[0]
    assert torch.equal(rows[0], text(commands[:, :1], now)[0, 0])  # whatever stands beside it
    assert not torch.allclose(rows[0], rows[1])
    assert not torch.allclose(rows[1], text(commands.flip(-1), now)[0, 1])  # their order tells
    assert not [p for p in text.parameters() if p.requires_grad]


def test_text_that_would_be_cut_is_refused() -> None:
    many = ActionText(ARM_DELTAS, decimals=40)
    with pytest.raises(ValueError, match=r"4 numbers with 40 decimals take 3\d\d letters, and 256 are read"):
        many(torch.ones(1, 2, 4), torch.zeros(1, 4))
