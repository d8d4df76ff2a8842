"""Tasks whose imagined success is far above the true one are told."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from pipeline.evaluation.by_task import unseen_first
from pipeline.evaluation.statistics import rate_entry
from pipeline.stages.prove import _gap, too_kind
from tests.embodiments import ARM_DELTAS


def entry(imagined: int, true: int, episodes: int = 40) -> dict[str, Any]:
    """What a gap says of a task's starts."""
    every = torch.arange(episodes)
    rates = {"imagined": rate_entry(every < imagined), "true": rate_entry(every < true)}
    return {**rates, "unseen": episodes // 2}


def test_a_task_that_succeeds_in_imagination_alone_is_an_alarm() -> None:
    tasks = {"push": entry(40, 1), "door": entry(7, 6), "drawer": entry(40, 31)}
    (alarm,) = too_kind({"tasks": tasks})
    assert "push succeeds in 40 of 40 imagined and 1 of 40 true" in alarm and "rounds.deploy" in alarm
    assert "20 of them held out" in alarm
    assert not too_kind({"tasks": {name: tasks[name] for name in ("door", "drawer")}})


def test_without_several_tasks_all_starts_are_one() -> None:
    (alarm,) = too_kind({"tasks": {}, **entry(150, 60, 200)})
    assert alarm.startswith("the task succeeds in 150 of 200")
    assert not too_kind({"tasks": {}, **entry(124, 86, 200)})  # kind, and usual
    assert not too_kind({"tasks": {}, **entry(5, 60, 200)})  # too strict teaches little, but nothing false
    assert not too_kind({"tasks": {}, **entry(4, 0, 5)})  # too few to tell


def test_both_sides_of_a_gap_are_of_the_starts_that_could_be_judged() -> None:
    truth, unseen = torch.arange(10) < 5, torch.arange(10) > 1
    found = _gap(truth, truth, truth, unseen)  # the judge abstains wherever it failed
    assert found["gap"] == 0.0 and found["true"] == found["imagined"] == rate_entry(truth[:5])
    assert found["unseen"] == 3
    assert _gap(truth, truth, torch.zeros(10, dtype=torch.bool), unseen)["gap"] is None


def test_starts_are_those_that_were_learned_from_least(
    tiny_store: Callable[[Embodiment], ClipStore],
) -> None:
    store = tiny_store(ARM_DELTAS)
    cfg, every = {"task": {"suite": {}}}, torch.arange(len(store))
    held, calibration = store.split("held_out"), store.split("calibration")
    first = len(held) + len(calibration)
    assert len(held) > 0 and len(held) < first < len(store) and not bool(torch.isin(every[:1], held).any())
    assert unseen_first(cfg, store, every, len(held)).tolist() == held.tolist()
    assert set(unseen_first(cfg, store, every, first).tolist()) == {*held.tolist(), *calibration.tolist()}
    assert sorted(unseen_first(cfg, store, every, 10**6).tolist()) == every.tolist()
    mine = every[1::2]
    assert set(unseen_first(cfg, store, mine, 10**6).tolist()) == set(mine.tolist())
