"""Batches are the same in whichever thread they are made, and each is made where it costs least."""

from __future__ import annotations

from threading import get_ident

import torch
from torch import Tensor

from learners.training.ahead import BatchesAhead


class Rows:
    """Random numbers, and the threads that drew them."""

    def __init__(self, at_hand: bool):
        self.at_hand, self.threads = at_hand, set[int]()

    def __call__(self, step: int, generator: torch.Generator) -> Tensor:
        self.threads.add(get_ident())
        return torch.randint(1000, (4,), generator=generator)


def test_batches_at_hand_are_made_by_whoever_takes_them_and_are_those_of_a_thread() -> None:
    drawn = []
    for at_hand in (True, False):
        rows = Rows(at_hand)
        with BatchesAhead(rows, 0, range(3), [0, 1], "cpu") as batches:
            taken = [batches.take() for _ in range(6)]
        assert (rows.threads == {get_ident()}) is at_hand
        drawn.append([(data.tolist(), generator.get_state().tolist()) for data, generator in taken])
    assert drawn[0] == drawn[1]
