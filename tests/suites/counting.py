"""Suites of somebody else that count, and misbehave.

Workers import the module of their suite: this one takes them nothing, one that also tests takes seconds.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from envs.embodiment import ActionKind, Camera, Embodiment
from envs.physics.suite import Array, Expert, Observation, TaskSuite


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


class TwoCameras(Counting):
    """Counts; of its cameras the first is calibrated, and `tells` names what it says of them: "" what is
    due, or a mistake.
    """

    def __init__(self, tells: str):
        super().__init__("")
        eyes = (Camera("eye", (4, 4), calibrated=True), Camera("other", (4, 4)))
        self.embodiment, self.tells = replace(self.embodiment, cameras=eyes), tells

    def render(self) -> Any:
        return np.repeat(super().render(), 2, 0)

    def observe(self) -> Observation:
        seen = super().observe()
        seen.intrinsic, seen.c2w = (np.stack([np.eye(n), np.full((n, n), np.nan)]) for n in (3, 4))
        if self.tells == "nothing":
            seen.c2w = seen.intrinsic = None
        elif self.tells == "no poses":
            seen.c2w = None
        elif self.tells == "one camera":
            seen.intrinsic = seen.intrinsic[:1]
        elif self.tells == "nan":
            seen.c2w[0, 1, 2] = np.nan
        elif self.tells == "zeros":
            seen.c2w[1] = 0.0
        return seen


SAID: dict[str, dict[str, Any]] = {
    "lists": {"state": [3], "command": [0.0], "success": np.bool_(False), "progress": np.float32(0.25)},
    "arrays": {"success": np.zeros(1, bool), "progress": np.full(1, 0.25), "command": np.zeros(1, int)},
    "no state": {"state": None},
    "long state": {"state": np.zeros(2)},
    "words for numbers": {"command": ["left"]},
    "no words": {"instruction": None},
    "much progress": {"progress": 7.5},
    "less than none": {"progress": -0.1},
    "many progresses": {"progress": np.zeros(2)},
    "unknown progress": {"progress": np.nan},
    "infinite": {"state": np.array([np.inf])},
    "numbers for success": {"success": 0.0},
    "no arms": {"poses": np.zeros((1, 7))},
}


class Saying(Counting):
    """Counts, and says of itself what SAID has under `what` from its frame `since`, and in no more than
    `frames` of them.
    """

    def __init__(self, what: str, since: int = 0, frames: int = 99):
        super().__init__("")
        self.what, self.since, self.frames = what, since, frames
        self.reset("count", 0)

    def reset(self, task: str, seed: int) -> None:
        super().reset(task, seed)
        self.tick = 0

    def step(self, action: Array) -> None:
        super().step(action)
        self.tick += 1

    def observe(self) -> Observation:
        now = self.since <= self.tick < self.since + self.frames
        said = {"won": {"success": True}, "more things": {}, **SAID}[self.what] if now else {}
        return replace(super().observe(), **said)

    def privileged(self) -> dict[str, Array]:
        many = self.what == "more things" and self.tick >= self.since
        return {"object_poses": np.zeros((1 + many, 3))}


class Done(Counting):
    """Counts; what seeds from 5 to 7 lay out is done before anybody acts."""

    def observe(self) -> Observation:
        return replace(super().observe(), success=self.count >= 5)

    def reset(self, task: str, seed: int) -> None:
        super().reset(task, seed)
        self.count = float(seed if 5 <= seed < 8 else -20)


def _misbehave(how: str) -> None:
    if how == "exit":
        os._exit(3)
    if how == "raise":
        raise RuntimeError("the bench is on fire")
