"""What one worker process does: it holds a suite a slot, runs episodes, and answers over a pipe.

`python -m envs.physics.worker FILE_DESCRIPTOR` starts it, so it imports neither torch nor the script of its
owner.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.physics.checked import beginning, observation, privileged, rendered
from envs.physics.suite import Array, Observation, TaskSuite, build_suite, check_task, expert_of, task_of
from envs.rng import Stream, episode_rng
from envs.targets import ConfigError

ALIVE = "alive"  # the status of a sign of life


@dataclass
class Track:
    """What one episode leaves behind, a row per frame; row 0 is the start.

    Args:
        seed: of the episode.
        instruction: the task in words.
        intrinsic: float [V, 3, 3] in pixels, None if no camera is calibrated.
        rows: lists by name: frames uint8 [V, 3, H, W], commands [A], states [S], success bool, and where the
            suite has them c2w [V, 4, 4] and poses [arms, 7].
        privileged: lists by name of what only physics knows, true progress among them.
    """

    seed: int
    instruction: str
    intrinsic: Array | None
    rows: dict[str, list[Any]] = field(default_factory=dict)
    privileged: dict[str, list[Any]] = field(default_factory=dict)

    def add(self, suite: TaskSuite, observed: Observation) -> None:
        """Append things as they stand now; suites may hand out memory that goes on changing."""
        row = {
            "frames": rendered(suite),
            "commands": observed.command,
            "states": observed.state,
            "success": observed.success,
            "c2w": observed.c2w,
            "poses": observed.poses,
        }
        for name, value in row.items():
            if value is not None:
                self.rows.setdefault(name, []).append(np.array(value))
        for name, value in {"progress": observed.progress, **privileged(suite, self.privileged)}.items():
            self.privileged.setdefault(name, []).append(np.array(value))

    def __len__(self) -> int:
        return len(self.rows["frames"])

    def stack(self) -> dict[str, Array]:
        """`rows` as arrays [T, ...]."""
        return {name: np.stack(values) for name, values in self.rows.items()}


@dataclass(frozen=True)
class WorkerSpec:
    """What a worker process is made from.

    Args:
        suite: config section of the task suite, plain.
        tasks: names of the suite's tasks, played by turns; see task_of.
        horizon: actions after which an episode is over.
    """

    suite: dict[str, Any]
    tasks: tuple[str, ...]
    horizon: int


@dataclass
class Slot:
    """One bench with the episode that it is in."""

    suite: TaskSuite
    steps: int = 0
    over: bool = True
    track: Track | None = None
    observed: Observation | None = None


class Worker:
    """The work of one process.

    Args:
        spec: of the suite and its tasks.
        slots: episodes side by side.
        alive: called after all that may take long.

    Raises:
        ConfigError: if there is no such suite or task.
    """

    def __init__(self, spec: WorkerSpec, slots: int, alive: Callable[[], None] = lambda: None):
        self.spec, self._alive = spec, alive
        self.slots: list[Slot] = []
        while len(self.slots) < slots:
            self.slots.append(Slot(build_suite(spec.suite)))
            alive()
        self._played: list[set[str]] = [set() for _ in range(slots)]  # tasks of each slot's suite so far
        for task in spec.tasks:
            check_task(task, self.slots[0].suite.tasks)

    def reset(self, seeds: dict[int, int], record: bool) -> dict[int, dict[str, Any]]:
        """Start episodes {slot: seed}; returns an observation per slot.

        Raises:
            SuiteError: if what it shows or says is not what its embodiment announces.
        """
        self._exchange({index: task_of(self.spec.tasks, seed) for index, seed in seeds.items()})
        out = {}
        for index, seed in seeds.items():
            slot = self.slots[index]
            self._lay_out(slot.suite, seed)
            slot.steps, slot.over, slot.track = 0, False, None
            slot.observed = observed = beginning(slot.suite)
            if record:
                slot.track = Track(seed, observed.instruction, observed.intrinsic)
                slot.track.add(slot.suite, observed)
            out[index] = self._answer(slot, observed)
        return out

    def _exchange(self, tasks: dict[int, str]) -> None:
        """Give slots {slot: task} that begin anew each other's suites, so that as many as can be have played
        their task before. Suites keep a model for each task: made for every slot and task, fifty tasks would
        take fifty times the memory.
        """
        free = [(self.slots[index].suite, self._played[index]) for index in tasks]
        waiting = []
        for index, task in tasks.items():
            fit = next((n for n, (_, played) in enumerate(free) if task in played), None)
            if fit is None:
                waiting.append(index)
            else:
                self.slots[index].suite, self._played[index] = free.pop(fit)
        free.sort(key=lambda one: len(one[1]))
        for index, (suite, played) in zip(waiting, free, strict=True):
            self.slots[index].suite, self._played[index] = suite, played
            played.add(tasks[index])

    def step(self, chunks: dict[int, NDArray[Any]]) -> dict[int, dict[str, Any]]:
        """Carry out chunks {slot: [K, A]} of commands, each to its end, as imagined worlds do; an episode
        that is over stands still.
        """
        out = {}
        for index, chunk in chunks.items():
            slot = self.slots[index]
            observed = slot.observed
            assert observed is not None  # it was reset
            for command in () if slot.over else chunk:
                slot.suite.step(command)
                slot.steps += 1
                slot.observed = observed = observation(slot.suite, observed)
                if slot.track is not None:
                    slot.track.add(slot.suite, observed)
                self._alive()
            slot.over = slot.over or observed.success or slot.steps >= self.spec.horizon
            out[index] = self._answer(slot, observed)
            if slot.over and slot.track is not None:
                out[index]["track"], slot.track = slot.track, None
        return out

    def script(self, jobs: list[tuple[int, float]], chunk: int | None) -> list[Track]:
        """Whole episodes of scripted behaviours for (seed, noise_level) pairs; recorded to the horizon, or to
        the end of the `chunk` actions in which they succeed, if it is not None. Without a horizon, where
        nobody acts, no behaviour is asked for.

        Raises:
            SuiteError: see reset.
            NoExpert: if a task has no such behaviour.
        """
        out = []
        suite = self.slots[0].suite
        for seed, noise_level in jobs:
            self._lay_out(suite, seed)
            task, rng = task_of(self.spec.tasks, seed), episode_rng(seed, Stream.BEHAVIOUR)
            act = expert_of(suite, task, noise_level, rng) if self.spec.horizon else None
            observed = beginning(suite)
            track = Track(seed, observed.instruction, observed.intrinsic)
            track.add(suite, observed)
            for step in range(self.spec.horizon):
                if act is None or (observed.success and chunk is not None and step % chunk == 0):
                    break
                suite.step(act())
                observed = observation(suite, observed)
                track.add(suite, observed)
                self._alive()
            out.append(track)
        return out

    def segment(
        self, jobs: list[tuple[int, Array]]
    ) -> list[tuple[NDArray[np.uint8] | None, Array, dict[str, Array]]]:
        """For episodes that are repeated from (seed, commands [T, A]), of which the first is in force at the
        start: what each pixel shows, uint8 [T, V, H, W] (TaskSuite.segment), None of suites that do not know;
        and, by which one sees whether it is the same episode, pictures uint8 [2, V, 3, H, W] of the first and
        the last frame, and TaskSuite.privileged at the start.
        """
        out = []
        suite = self.slots[0].suite
        for seed, commands in jobs:
            self._lay_out(suite, seed)
            labels, pictures = [suite.segment()], [rendered(suite)]
            start = {name: np.array(value) for name, value in suite.privileged().items()}
            for command in commands[1:]:
                suite.step(command)
                labels.append(suite.segment())
                self._alive()
            pictures.append(rendered(suite))
            known = [one for one in labels if one is not None]
            out.append((np.stack(known) if len(known) == len(labels) else None, np.stack(pictures), start))
        return out

    def picture(self, seed: int, size: tuple[int, int]) -> NDArray[np.uint8]:
        """Pictures for people of an episode's start, uint8 [V, 3, H, W]."""
        suite = self.slots[0].suite
        self._lay_out(suite, seed)
        return suite.picture(size)

    def modules(self) -> list[str]:
        """Names of all modules that this process has imported."""
        return sorted(sys.modules)

    def _lay_out(self, suite: TaskSuite, seed: int) -> None:
        suite.reset(task_of(self.spec.tasks, seed), seed)
        self._alive()

    def _answer(self, slot: Slot, observed: Observation) -> dict[str, Any]:
        answer = {
            "image": rendered(slot.suite) if slot.track is None else slot.track.rows["frames"][-1],
            "state": observed.state,
            "command": observed.command,
            "success": observed.success,
            "progress": observed.progress,
            "instruction": observed.instruction,
            "over": slot.over,
        }
        cameras = {"intrinsic": observed.intrinsic, "c2w": observed.c2w}
        return answer | {name: value for name, value in cameras.items() if value is not None}


def serve(pipe: Connection) -> None:
    """Answer requests until the pipe closes, at whatever moment its owner dies: (spec, slots), then (method,
    arguments), None to end. An answer is (status, value); signs of life may go before it.
    """
    last = time.monotonic()

    def alive() -> None:
        nonlocal last
        if (now := time.monotonic()) - last >= 1.0:
            last = now
            pipe.send((ALIVE, None))

    with contextlib.suppress(EOFError, OSError):
        spec, slots = pipe.recv()
        try:
            worker = Worker(spec, slots, alive)
        except ConfigError as error:
            pipe.send(("config", str(error)))
            return
        except Exception:
            pipe.send(("broken", traceback.format_exc()))
            return
        pipe.send(("ok", None))
        while (asked := pipe.recv()) is not None:
            try:
                answer = ("ok", getattr(worker, asked[0])(*asked[1]))
            except ConfigError as error:
                answer = ("config", str(error))
            except Exception:
                answer = ("error", traceback.format_exc())
            pipe.send(answer)


if __name__ == "__main__":
    # Under its real name, so that what is sent has the types that the other side imports.
    from envs.physics import worker as _this

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who interrupts the pool's owner ends the pipe, and so us
    _this.serve(Connection(int(sys.argv[1])))
