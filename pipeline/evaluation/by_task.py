"""Figures task by task, where a run plays several by turns, and scene by scene, where a suite has any."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.physics.suite import TaskSuite, build_suite, scene_of, task_names, task_of
from envs.targets import ConfigError, nearest

T = TypeVar("T")
_MOST = 8  # instructions that are told apart, where they alone tell tasks apart
_VARIOUS = "various instructions"  # in place of a task, where there are more
START = "start"  # the source of first frames that physics has laid out by turns, with nothing after them


def tasks_of_seeds(cfg: Mapping[str, Any], seeds: Iterable[int]) -> list[str]:
    """The task of each episode in physics, by its seed."""
    names = task_names(cfg["task"]["name"])
    return [task_of(names, int(seed)) for seed in seeds]


def variant_of(cfg: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """The options of the suite that a variant of the task changes; of "", the task as it is, none.

    Raises:
        ConfigError: for a variant that the task does not have.
    """
    known = cfg["task"].get("variants", {})
    if name and not known:
        raise ConfigError(
            f"variant={name}: this task has no variants; leave it out (a study's column by"
            " study.columns=[success]), or add task.variants"
        )
    if name and name not in known:
        raise ConfigError(f"variant={name} is not one of task.variants{nearest(name, known)}")
    return dict(known[name]) if name else {}


def tasks_told(
    suite: TaskSuite, names: Sequence[str], episodes: Iterable[tuple[int, str]]
) -> list[str | None]:
    """The task of each episode, of its seed and its instruction: the one of `names` whose turn it is by the
    seed, or where the suite says something else there, as of recordings of another task.name, one of its
    tasks that it says so of; None if it says so of none.

    A task that has said an instruction once is not asked for it again; the suite is left in mid-episode.
    """
    found: dict[str, list[str]] = {}  # tasks by what was told
    out: list[str | None] = []
    for seed, told in episodes:
        turn, known = task_of(names, seed), found.get(told)
        if known is None or (known and turn not in known):
            found[told] = known = known or []
            for task in dict.fromkeys((turn, *known, *names, *suite.tasks)):
                if task not in known:
                    suite.reset(task, seed)
                    if suite.observe().instruction == told:
                        known.append(task)
                if task in known:
                    break
        out.append(turn if turn in known else next(iter(known), None))
    return out


def tasks_of_episodes(cfg: Mapping[str, Any], store: ClipStore, episodes: Tensor) -> list[str]:
    """The task of each of a store's episodes int64 [N]: of those that this physics laid out, see tasks_told;
    of other recordings, what the robot was told (which LeRobot calls the task).
    """
    rows = [store.episodes[number] for number in episodes.tolist()]
    tasks = [row["instruction"] for row in rows]
    if cfg["task"].get("suite"):
        seeded = store.seeded(episodes).tolist()
        suite, names = build_suite(cfg["task"]["suite"]), task_names(cfg["task"]["name"])
        told = [(row["seed"], row["instruction"]) for row, known in zip(rows, seeded, strict=True) if known]
        laid_out = iter(tasks_told(suite, names, told))
        tasks = [(known and next(laid_out)) or task for known, task in zip(seeded, tasks, strict=True)]
    return tasks


def tasks_of_first_frames(cfg: Mapping[str, Any], store: ClipStore) -> list[str]:
    """The task of each of a store's first frames: as tasks_of_episodes, but of those with source START the
    one whose turn it was. A variant of the task may say other words at a seed than the task itself.
    """
    tasks = tasks_of_episodes(cfg, store, torch.arange(len(store)))
    laid_out = store.select([START]).tolist()
    turns = tasks_of_seeds(cfg, (store.episodes[number]["seed"] for number in laid_out))
    for number, task in zip(laid_out, turns, strict=True):
        tasks[number] = task
    return tasks


def groups_of_episodes(cfg: Mapping[str, Any], store: ClipStore, episodes: Tensor) -> list[str]:
    """The task of each of a store's episodes int64 [N], to have figures of each: as tasks_of_episodes, but
    where words alone tell tasks apart, people say one thing in many ways, and more than _MOST are one group.
    """
    tasks = tasks_of_episodes(cfg, store, episodes)
    many = not cfg["task"].get("suite") and len(set(tasks)) > _MOST
    return [_VARIOUS] * len(tasks) if many else tasks


def evenly(cfg: Mapping[str, Any], store: ClipStore, episodes: Tensor, count: int) -> Tensor:
    """`count` of a store's episodes int64 [N], or all if they are fewer, in their order: of each task as many
    as of the others, as far as there are.
    """
    tasks = tasks_of_episodes(cfg, store, episodes)
    turns, turn = dict.fromkeys(tasks, 0), []
    for task in tasks:
        turn.append(turns[task])
        turns[task] += 1
    first = torch.tensor(turn, dtype=torch.int64).argsort(stable=True)[:count]
    return episodes[first.sort().values]


def unseen_first(cfg: Mapping[str, Any], store: ClipStore, episodes: Tensor, count: int) -> Tensor:
    """`count` of a store's `episodes` int64 [N], of each split shared out over tasks: those that are held
    out, then those that judges alone have not seen, and only then those that everything has learned from.
    """
    chosen = episodes[:0]
    for split in ("held_out", "calibration", "train"):
        mine = episodes[torch.isin(episodes, store.split(split))]
        chosen = torch.cat((chosen, evenly(cfg, store, mine, count - len(chosen))))
    return chosen


def by_task(tasks: Sequence[str], summarise: Callable[..., T], *values: Tensor) -> dict[str, T]:
    """What `summarise` says of each task's part of `values`, tensors [N] beside tasks [N]; {} if all are of
    one task, of which the whole says everything.
    """
    names = sorted(set(tasks))
    if len(names) < 2:
        return {}
    mine = {name: torch.tensor([task == name for task in tasks]) for name in names}
    return {name: summarise(*(value[mine[name]] for value in values)) for name in names}


def scenes_of_seeds(
    cfg: Mapping[str, Any], seeds: Iterable[int], changes: Mapping[str, Any] | None = None
) -> list[str]:
    """The scene of each episode in physics, by its seed, of the suite with options changed as a variant of
    the task changes them; "" of suites without scenes.
    """
    scenes = build_suite({**cfg["task"]["suite"], **(changes or {})}).scenes
    return [scene_of(scenes, int(seed)) for seed in seeds]


def scenes_of_episodes(cfg: Mapping[str, Any], store: ClipStore, episodes: Tensor) -> list[str]:
    """The scene of each of a store's episodes int64 [N]; "" of those that physics did not lay out."""
    none = [""] * len(episodes)
    if not cfg["task"].get("suite"):
        return none
    laid_out = scenes_of_seeds(cfg, (store.episodes[number]["seed"] for number in episodes.tolist()))
    return _where(store.seeded(episodes), laid_out, none)


def by_scene(
    tasks: Sequence[str], scenes: Sequence[str], summarise: Callable[..., Mapping[str, Any]], *values: Tensor
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


def _where(known: Tensor, names: Sequence[str], others: Sequence[str]) -> list[str]:
    """Names where they are known, bool [N], and others elsewhere."""
    return [name if of else other for of, name, other in zip(known.tolist(), names, others, strict=True)]
