"""Tasks whose imagined success has been seen far above the true one are not imagined, and that is told."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

import torch

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from pipeline.evaluation.statistics import rate_entry
from pipeline.stages.reinforcement.doubt import Doubt, chosen_among
from tests.embodiments import ARM_DELTAS

CFG: dict[str, Any] = {"task": {"suite": {}}}  # tasks are what robots were told


def entry(imagined: int, true: int, episodes: int = 40) -> dict[str, Any]:
    """What a gap says of a task's starts."""
    every = torch.arange(episodes)
    return {"imagined": rate_entry(every < imagined), "true": rate_entry(every < true)}


def test_a_task_that_succeeds_in_imagination_alone_is_left_out(
    tiny_store: Callable[[Embodiment], ClipStore],
) -> None:
    store = copy(tiny_store(ARM_DELTAS))
    words = ["push it" if number % 3 else "pull it" for number in range(len(store))]
    store.episodes = [{**row, "instruction": said} for row, said in zip(store.episodes, words, strict=True)]
    tasks = {"push it": entry(40, 1), "pull it": entry(7, 6)}
    doubt = Doubt({"tasks": tasks}, 0.2)
    trusted = doubt.trusted(CFG, store, torch.arange(len(store)))
    assert trusted.tolist() == [said == "pull it" for said in words]
    (alarm,) = doubt.alarms()
    assert "push it succeeds in 40 of 40 imagined and 1 of 40 true" in alarm and "left out" in alarm
    assert bool(Doubt({"tasks": tasks}, 1.0).trusted(CFG, store, torch.arange(len(store))).all())


def test_where_all_is_in_doubt_all_is_imagined_and_told(
    tiny_store: Callable[[Embodiment], ClipStore],
) -> None:
    store = tiny_store(ARM_DELTAS)
    doubt = Doubt({"tasks": {}, **entry(150, 60, 200)}, 0.2)
    assert bool(doubt.trusted(CFG, store, torch.arange(len(store))).all())
    (alarm,) = doubt.alarms()
    assert alarm.startswith("the task succeeds in 150 of 200") and "all the same" in alarm


def test_what_chance_does_or_a_strict_judge_is_no_doubt() -> None:
    for gap in (entry(124, 86, 200), entry(5, 60, 200), entry(4, 0, 5)):
        assert not Doubt({"tasks": {}, **gap}, 0.2).alarms()
    assert not Doubt(None, 0.2).alarms()  # without physics nothing is known


def test_starts_keep_their_numbers() -> None:
    trusted = torch.tensor([True, False, True])
    assert chosen_among([2, 1, 0, 0], trusted) == [2, 0, 0]
    assert chosen_among(range(5, 8), trusted, 5) == [5, 7]
