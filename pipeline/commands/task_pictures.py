"""worldloop tasks task=... pictures=FOLDER: a sheet of a suite's scenes, and a GIF of each task's expert."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from envs.episodes.filming import Picture, side_by_side, titled, write_gif
from envs.physics.suite import Expert, NoExpert, TaskSuite, build_suite, expert_of, task_names
from envs.rng import Stream, episode_rng

_TILE, _COLUMNS = 112, 10  # pixels of a scene's picture, and pictures in a row
_BAR = 13  # pixels of the line under it
_GIF = (144, 144)  # pixels of each view
_SEED = 9_000_000  # of the episodes that are shown


def draw(choice: str, task: Mapping[str, Any], folder: Path) -> Iterator[Path]:
    """Write <choice>-scenes.jpg, where the suite has scenes, and <choice>-<task>.gif for the tasks that a
    choice of configs/task, of section `task`, plays; yields their paths.
    """
    folder.mkdir(parents=True, exist_ok=True)
    groups = _scenes(task)
    if groups:
        path = folder / f"{choice}-scenes.jpg"
        cv2.imwrite(str(path), _sheet(task, groups)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
        yield path
    for name in task_names(task["name"]):
        path = folder / f"{choice}-{name}.gif"
        write_gif(path, _episode(task, name), build_suite(task["suite"]).embodiment.fps)
        yield path


def _scenes(task: Mapping[str, Any]) -> dict[str, list[str]]:
    """Scenes of the suite as configured, and those that each variant adds, by what brings them in."""
    groups: dict[str, list[str]] = {}
    for title, changes in {"": {}, **task.get("variants", {})}.items():
        seen = {name for names in groups.values() for name in names}
        new = [name for name in build_suite({**task["suite"], **changes}).scenes if name not in seen]
        if new:
            groups[title] = new
    return groups


def _sheet(task: Mapping[str, Any], groups: Mapping[str, list[str]]) -> Picture:
    """A picture of the start of an episode in each scene; under those of variants, a lighter line."""
    tiles = []
    for title, names in groups.items():
        for number, scene in enumerate(names):
            suite = build_suite({**task["suite"], "scenes": [scene]})
            suite.reset(suite.tasks[0], _SEED + number)
            picture = suite.picture((_TILE, _TILE))[suite.embodiment.main_view].transpose(1, 2, 0)
            bar = np.full((_BAR, _TILE, 3), 90 if title else 24, np.uint8)
            cv2.putText(bar, scene, (2, 10), cv2.FONT_HERSHEY_SIMPLEX, 0.28, (235, 235, 235), 1, cv2.LINE_AA)
            tiles.append(np.concatenate((picture, bar)))
    rows = -(-len(tiles) // _COLUMNS)
    tiles += [np.zeros_like(tiles[0])] * (rows * _COLUMNS - len(tiles))
    return np.concatenate(
        [np.concatenate(tiles[k : k + _COLUMNS], 1) for k in range(0, len(tiles), _COLUMNS)]
    )


def _episode(task: Mapping[str, Any], name: str) -> list[Picture]:
    """All views of an expert's episode side by side, under the words; of a task without one, its start."""
    suite = build_suite(task["suite"])
    suite.reset(name, _SEED)
    act, frames = _expert(suite, name), list[Picture]()
    for _ in range(task["horizon"]):
        frames += titled(side_by_side(suite.picture(_GIF)[None]), suite.observe().instruction)
        if act is None or suite.observe().success:
            break
        suite.step(act())
    return [*frames, *[frames[-1]] * 3]


def _expert(suite: TaskSuite, name: str) -> Expert | None:
    try:
        return expert_of(suite, name, 0.0, episode_rng(_SEED, Stream.BEHAVIOUR))
    except NoExpert:
        return None
