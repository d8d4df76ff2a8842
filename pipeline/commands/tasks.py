"""worldloop tasks: what can be tried in physics, suite by suite."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from envs.physics.suite import build_suite
from envs.targets import ConfigError, nearest
from pipeline.config import choices, composed


def table(chosen: str = "") -> str:
    """A paragraph per task of configs/ that has a suite: its robot, its tasks, and what its options choose
    from; of a suite that is not installed, how to install it.

    Args:
        chosen: one choice of configs/task, of which all is said; "" for all of them in short.

    Raises:
        ConfigError: if there is no such choice.
    """
    if chosen and chosen not in choices("task"):
        raise ConfigError(f"task={chosen} is not a choice of configs/task{nearest(chosen, choices('task'))}")
    names = [chosen] if chosen else choices("task")
    found = {name: composed([f"task={name}"])["task"] for name in names}
    return "\n\n".join(_paragraph(name, task, bool(chosen)) for name, task in found.items() if task["suite"])


def _paragraph(name: str, task: Mapping[str, Any], whole: bool) -> str:
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
