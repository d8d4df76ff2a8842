"""worldloop tasks: what can be tried in physics, suite by suite."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from envs.physics.suite import build_suite, check_task, task_names
from envs.targets import ConfigError, nearest
from pipeline.config import choices, read_config


def chosen_tasks(words: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Sections task of the config by their choice: of the one that task=... names among the words, or of all.

    Args:
        words: other overrides among them, such as hydra.searchpath=[file://my_choices].

    Raises:
        ConfigError: if there is no such choice, or an override cannot be read.
    """
    known = choices("task", words)
    named = [word.partition("=")[2] for word in words if word.startswith("task=")]
    for name in named:
        if name not in known:
            raise ConfigError(f"task={name} is not a choice of configs/task{nearest(name, known)}")
    rest = [word for word in words if not word.startswith("task=")]
    return {name: read_config([*rest, f"task={name}"])["task"] for name in named[-1:] or known}


def check_chosen(task: Mapping[str, Any]) -> None:
    """See that the suite of a section task can be built, and that it has the tasks that are named.

    Raises:
        ConfigError: naming the key and the nearest names.
    """
    if task["suite"]:
        suite = build_suite(task["suite"])
        for name in task_names(task["name"]):
            check_task(name, suite.tasks)


def table(found: Mapping[str, Mapping[str, Any]]) -> str:
    """A paragraph per task that has a suite: its robot, its tasks, and what its options choose from, of one
    alone all of it; of a suite that is not installed, how to install it.

    Args:
        found: see chosen_tasks.
    """
    whole = len(found) == 1
    return "\n\n".join(
        _paragraph(name, task, whole) for name, task in found.items() if task["suite"] or whole
    )


def _paragraph(name: str, task: Mapping[str, Any], whole: bool) -> str:
    if not task["suite"]:
        return (
            f"task={name}\n  no physics: robot and instructions are those of recordings, task.data=[FOLDER]"
        )
    try:
        suite = build_suite(task["suite"])
    except ConfigError as error:
        return f"task={name}\n  {error}"
    robot = suite.embodiment
    cameras = ", ".join(camera.name for camera in robot.cameras)
    known = f"{'calibrated' if robot.calibrated else 'uncalibrated'} cameras {cameras}"
    lists = {"task.name": suite.tasks, **{f"task.suite.{key}": given for key, given in suite.offers.items()}}
    if task.get("variants"):
        lists["task.variants"] = list(task["variants"])
    lines = [
        f"task={name}",
        f"  robot {robot.robot}: {len(robot.action_names)} numbers per action ({robot.action_kind.value}),"
        f" {robot.fps:g} actions a second, {known}",
        *([f"  scenes: {len(suite.scenes)}, drawn by the seed"] if suite.scenes else []),
        *(line for key, given in lists.items() for line in _wrapped(key, list(given), whole)),
    ]
    return "\n".join(lines)


def _wrapped(key: str, given: list[str], whole: bool) -> Iterator[str]:
    """A list under its option's name; of long ones the beginning."""
    shown = given if whole else given[:8]
    rest = f", ... ({len(given)}; `worldloop tasks task=...` says all)" if len(shown) < len(given) else ""
    text = f"{key}: {', '.join(shown)}{rest}"
    yield from textwrap.wrap(text, 108, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False)
