"""Figures task by task, where a run plays several tasks by turns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.physics.suite import task_names, task_of


def tasks_of_seeds(cfg: Mapping[str, Any], seeds: Iterable[int]) -> list[str]:
    """The task of each episode in physics, by its seed."""
    names = task_names(cfg["task"]["name"])
    return [task_of(names, int(seed)) for seed in seeds]


def tasks_of_episodes(cfg: Mapping[str, Any], store: ClipStore, episodes: Tensor) -> list[str]:
    """The task of each of a store's episodes int64 [N]: of those that physics laid out, by the seed; of other
    recordings, what the robot was told (which LeRobot calls the task).
    """
    rows = [store.episodes[number] for number in episodes.tolist()]
    if cfg["task"].get("suite"):
        return tasks_of_seeds(cfg, (row["seed"] for row in rows))
    return [row["instruction"] for row in rows]


def by_task(
    tasks: Sequence[str], summarise: Callable[..., Mapping[str, Any]], *values: Tensor
) -> dict[str, Mapping[str, Any]]:
    """What `summarise` says of each task's part of `values`, tensors [N] beside tasks [N]; {} if all are of
    one task, of which the whole says everything.
    """
    names = sorted(set(tasks))
    if len(names) < 2:
        return {}
    mine = {name: torch.tensor([task == name for task in tasks]) for name in names}
    return {name: summarise(*(value[mine[name]] for value in values)) for name in names}
