"""Task sections of configs/ for tests, small, and a suite of somebody else that misbehaves."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf

from envs.embodiment import ActionKind, Camera, Embodiment
from envs.physics.suite import Array, Expert, Observation, TaskSuite, task_names
from envs.physics.tabletop.suite import Tabletop
from envs.targets import ConfigError
from tests.sections import CONFIGS, offered


def task_section(choice: str, **changes: Any) -> dict[str, Any]:
    """A task of configs/task, with small pictures and with options of its suite changed."""
    cfg = _load(choice)
    cfg.size = [24, 32]
    cfg.starts = "all"  # what configs/config.yaml says
    cfg.suite = {**cfg.suite, **changes}
    section = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(section, dict)
    del section["starts"]
    return section  # type: ignore[return-value]


def physical_tasks() -> dict[str, dict[str, Any]]:
    """Every task that choices of configs/task with a suite play, and push commanded by joints, by name."""
    known = [name for name in offered("task") if _load(name).suite is not None]
    out = {"push-joints": task_section("push", actions="joints")}
    for choice in known:
        section = task_section(choice)
        names = task_names(section["name"])
        for name in names:
            key = choice if len(names) == 1 else f"{choice}-{name}"
            out[key] = {**section, "name": name}
    return out


def _load(choice: str) -> DictConfig:
    cfg = OmegaConf.load(CONFIGS / "task" / f"{choice}.yaml")
    assert isinstance(cfg, DictConfig)
    return cfg


class Counting(TaskSuite):
    """A suite that counts, and does what `fault` says when an action is above 1.

    Args:
        fault: "raise", or "exit" to end the process, or "" for none.
        at_start: the same, when the suite is made.
        tasks: its names.
        shows: (height, width) of what it renders, whatever its camera says.
    """

    def __init__(
        self,
        fault: str,
        at_start: str = "",
        tasks: tuple[str, ...] = ("count",),
        shows: tuple[int, int] = (4, 4),
    ):
        self.fault, self.tasks, self.shows = fault, tasks, shows
        self.embodiment = Embodiment(
            "counter", ("a",), ActionKind.OTHER, False, (), ("n",), (Camera("eye", (4, 4)),), 10.0
        )
        _misbehave(at_start)

    def reset(self, task: str, seed: int) -> None:
        self.task, self.count = task, float(seed)

    def step(self, action: Array) -> None:
        if action[0] > 1:
            _misbehave(self.fault)
        self.count += 1

    def render(self) -> Any:
        return np.full((1, 3, *self.shows), int(self.count) % 256, np.uint8)

    def observe(self) -> Observation:
        return Observation(np.array([self.count]), np.zeros(1), self.task, False, 0.0)

    def privileged(self) -> dict[str, Array]:
        return {"count": np.array(self.count)}

    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        return lambda: np.array([noise_level * 2])


class Scriptless(Counting):
    """Counts, and has no scripted behaviour but random actions."""

    def expert(self, noise_level: float, rng: np.random.Generator) -> Expert:
        if noise_level < 1:
            raise NotImplementedError("nobody has written it")
        return super().expert(0.0, rng)


# Workers import the modules of such suites: here that takes half a second, beside torch five.
class OddSeed(Counting):
    """Counts, and breaks at the first action of one seed."""

    def step(self, action: Array) -> None:
        super().step(action)
        if self.count == 9_000_001:
            raise RuntimeError("the bench is on fire")


class Hanging(Counting):
    """Counts, and hangs at the first action above 1 of all its processes, which leaves the file `once`."""

    def __init__(self, once: str):
        super().__init__("")
        self.once = Path(once)

    def step(self, action: Array) -> None:
        super().step(action)
        if action[0] > 1 and not self.once.exists():
            self.once.touch()
            time.sleep(600)


class Slow(Counting):
    """Counts, a step in 1.2 s."""

    def step(self, action: Array) -> None:
        super().step(action)
        time.sleep(1.2)


class Startless(Counting):
    """Counts, and cannot lay out what every third seed draws."""

    def reset(self, task: str, seed: int) -> None:
        super().reset(task, seed)
        if seed % 3 == 0:
            raise RuntimeError("things lie in each other")


class Solved(Tabletop):
    """The table top, whose block is put where it belongs before the first action."""

    def reset(self, task: str, seed: int) -> None:
        super().reset(task, seed)
        self.put = False

    def step(self, action: Array) -> None:
        goal, data = self._bench.goal, self._bench.data
        if not self.put:
            data.qpos[goal.joint : goal.joint + 2], self.put = goal.target, True
        super().step(action)


class Stopped(Solved):
    """The same, with the seeds that it lays out in a file, a line each; it refuses another while there is a
    file `stop` beside that, which holds their number.
    """

    def __init__(self, laid_out: str, **options: Any):
        super().__init__(**options)
        self.laid_out = Path(laid_out)

    def reset(self, task: str, seed: int) -> None:
        super().reset(task, seed)
        stop, lines = self.laid_out.with_name("stop"), self.laid_out.read_text().split()
        if stop.exists() and len(lines) == int(stop.read_text()):
            raise ConfigError("stopped, as asked")
        self.laid_out.write_text("\n".join([*lines, str(seed)]))


def _misbehave(how: str) -> None:
    if how == "exit":
        os._exit(3)
    if how == "raise":
        raise RuntimeError("the bench is on fire")
