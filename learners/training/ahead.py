"""Batches made ahead: while one is learned from, a thread gathers the next from disk and moves it over.

Where handing a batch over takes longer than making it, it is made when it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import torch

from envs.rng import step_generator

Batch = Callable[[int, torch.Generator], Any]
Drawn = tuple[Any, torch.Generator]


class BatchesAhead:
    """The microbatches of training steps in their order, each made while its predecessor is learned from.

    A batch depends on seed, step and microbatch alone, so it is the same whenever and by whom it is made.

    Args:
        batch: (step, generator) -> anything; runs in another thread, so it must not read what training
            changes. If it has a true attribute `at_hand`, it runs in this one, when its batch is asked for:
            two threads wait for Python's lock at every operation, which a few rows in memory are not worth.
        seed: of the generators, see envs/rng.py.
        steps: numbers of the steps.
        parts: the microbatches of this process, of every step.
        device: to which whatever has a `to` is moved.
    """

    def __init__(
        self, batch: Batch, seed: int, steps: range, parts: Sequence[int], device: torch.device | str
    ):
        self.batch, self.seed, self.device = batch, seed, device
        self._order: Iterator[tuple[int, int]] = ((step, part) for step in steps for part in parts)
        # With one core's arithmetic: torch gives each thread that asks a team as large as the machine, and
        # two teams wait for each other at every operation (a U-Net's step on two cores: 204 ms, so 143).
        self._thread = ThreadPoolExecutor(1, "batches", initializer=torch.set_num_threads, initargs=(1,))
        self._next: Future[Drawn] | None = None
        self._at_hand = getattr(batch, "at_hand", False)

    def __enter__(self) -> BatchesAhead:
        if not self._at_hand:
            self._submit_next()
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown(cancel_futures=True)

    def take(self) -> Drawn:
        """The next batch, and its generator for whatever else is drawn in its step.

        Raises:
            Exception: whatever making it raised.
        """
        if self._at_hand:
            return self._make(*next(self._order))
        assert self._next is not None, "there are no more batches"
        drawn = self._next.result()
        self._submit_next()
        return drawn

    def _submit_next(self) -> None:
        following = next(self._order, None)
        self._next = None if following is None else self._thread.submit(self._make, *following)

    def _make(self, step: int, part: int) -> Drawn:
        generator = step_generator(self.seed, step, part)
        data = self.batch(step, generator)
        return data.to(self.device) if hasattr(data, "to") else data, generator
