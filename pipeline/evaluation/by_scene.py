"""Figures scene by scene, where a task suite says which scene an episode plays in."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.physics.suite import build_suite, scene_of

Cell = Mapping[str, Any]


def scenes_of_seeds(cfg: Mapping[str, Any], seeds: Iterable[int]) -> list[str]:
    """The scene of each episode in physics, by its seed; "" of suites without scenes."""
    scenes = build_suite(cfg["task"]["suite"]).scenes
    return [scene_of(scenes, int(seed)) for seed in seeds]


def scenes_of_episodes(cfg: Mapping[str, Any], store: ClipStore, episodes: Tensor) -> list[str]:
    """The scene of each of a store's episodes int64 [N]; "" of recordings without physics."""
    if not cfg["task"].get("suite"):
        return [""] * len(episodes)
    return scenes_of_seeds(cfg, (store.episodes[number]["seed"] for number in episodes.tolist()))


def by_scene(
    tasks: Sequence[str], scenes: Sequence[str], summarise: Callable[..., Cell], *values: Tensor
) -> list[dict[str, Any]]:
    """What `summarise` says of each task in each scene, with task and scene: of `values`, tensors [N] beside
    tasks [N] and scenes [N]. Only those that occur; [] if all are one task in one scene.
    """
    where = list(zip(tasks, scenes, strict=True))
    cells = sorted(set(where))
    if len(cells) < 2:
        return []
    mine = {cell: torch.tensor([one == cell for one in where]) for cell in cells}
    return [
        {"task": task, "scene": scene, **summarise(*(value[mine[task, scene]] for value in values))}
        for task, scene in cells
    ]
