"""Worker processes that hold task suites, so that a batch of true worlds uses every core.

Episodes are dealt to workers by slot number, and what happens in one depends on its task, seed and actions
alone: the number of workers changes the speed and nothing else. So a worker that dies can be replaced by
another that runs its episodes again up to where they were, bit for bit.
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.physics.suite import task_names
from envs.physics.worker import Track, Worker, WorkerSpec
from envs.targets import ConfigError, to_plain

log = logging.getLogger(__name__)
RETRIES = 3  # replacements of one worker that may die in a row before the pool gives up

__all__ = ["PoolError", "TaskPool", "Track", "available_cores"]


class PoolError(RuntimeError):
    """A physics worker failed; the message holds its own traceback."""


class _Died(Exception):
    """The process at the other end of a pipe is gone."""


def available_cores() -> int:
    """Cores this process may run on, which in containers and batch systems is less than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass
class _Episode:
    """What it takes to run an episode again: its seed and all chunks so far."""

    seed: int
    record: bool
    chunks: list[NDArray[Any]] = field(default_factory=list)


class _Remote:
    """A worker process, and what it takes to replace it by another that stands where it stood.

    Args:
        index: of the worker, for messages.
        spec: of suite and task.
        slots: episodes side by side.
    """

    def __init__(self, index: int, spec: WorkerSpec, slots: int):
        self.index, self.spec, self.slots = index, spec, slots
        self._episodes: dict[int, _Episode] = {}
        self._request: tuple[str, tuple[Any, ...]] | None = None
        self._start()

    def send(self, name: str, *arguments: Any) -> None:
        """Ask for a method of Worker; `answer` waits for what it gives."""
        self._request = (name, arguments)
        if not self._fresh:
            self._write(self._request)

    def answer(self) -> Any:
        """What the last request gave; a worker that died is replaced and asked again.

        Raises:
            PoolError: if the method failed, or if replacements keep dying.
        """
        for _ in range(1 + RETRIES):
            try:
                if self._fresh:
                    self._catch_up()
                value = self._read()
                self._remember()
                return value
            except _Died:
                code = self.close(0.0)
                log.warning("physics worker %d died (exit code %s); its episodes run again", self.index, code)
                self._start()
        raise PoolError(
            f"physics worker {self.index} died {1 + RETRIES} times in a row (exit code {code})"
            f"{self._where()}; out of memory, a broken GL driver, or a suite that crashes in this episode"
        )

    def _where(self) -> str:
        """The episodes that were asked for, in words; "" if none were."""
        name, arguments = self._request or ("", ())
        seeds: list[int] = []
        if name in ("script", "segment"):
            seeds = [seed for seed, _ in arguments[0]]
        elif name == "reset":
            seeds = list(arguments[0].values())
        elif name == "step":
            seeds = [self._episodes[slot].seed for slot in arguments[0]]
        return f" in the episodes of the seeds {seeds[:4]}" if seeds else ""

    def close(self, patience: float) -> int | None:
        """End the process, by force after `patience` seconds; returns its exit code."""
        self._write(None)
        try:
            self.process.wait(patience)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.pipe.close()
        return self.process.returncode

    def _start(self) -> None:
        self.pipe, theirs = Pipe()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "envs.physics.worker", str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            start_new_session=True,  # a terminal's Ctrl-C is for the owner, whose end closes the pipe
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
        )
        theirs.close()
        self._fresh = True
        self._write((self.spec, self.slots))

    def _catch_up(self) -> None:
        """Wait for a new process, run its episodes up to where the last one stood, and repeat the request."""
        self._read()
        for slot, episode in self._episodes.items():
            self._write(("reset", ({slot: episode.seed}, episode.record)))
            self._read()
            for chunk in episode.chunks:
                self._write(("step", ({slot: chunk},)))
                self._read()
        self._fresh = False
        self._write(self._request)

    def _remember(self) -> None:
        assert self._request is not None
        name, arguments = self._request
        if name == "reset":
            seeds, record = arguments
            self._episodes |= {slot: _Episode(seed, record) for slot, seed in seeds.items()}
        elif name == "step":
            for slot, chunk in arguments[0].items():
                self._episodes[slot].chunks.append(chunk)

    def _write(self, message: Any) -> None:
        with contextlib.suppress(OSError):  # it died, which the next `_read` finds
            self.pipe.send(message)

    def _read(self) -> Any:
        try:
            status, value = self.pipe.recv()
        except (EOFError, OSError) as error:
            raise _Died from error
        if status == "config":
            raise ConfigError(value)
        if status == "error":
            raise PoolError(f"physics worker {self.index} failed:\n{value}")
        return value


class TaskPool:
    """`slots` episodes of a suite over worker processes.

    Args:
        suite: config section of the task suite.
        task: a name of its tasks, or several, which are played by turns; see task_of.
        slots: how many episodes run side by side.
        horizon: actions after which an episode is over.
        workers: processes; 0 means one per core, 1 runs in this process.

    Raises:
        ConfigError: if there is no such suite or task.
        PoolError: if a worker does not start.
    """

    def __init__(
        self, suite: Mapping[str, Any], task: str | Sequence[str], slots: int, horizon: int, workers: int
    ):
        self.slots, self.horizon = slots, horizon
        spec = WorkerSpec(to_plain(suite), task_names(task), horizon)
        count = min(workers or available_cores(), slots)
        self.owner = [slot % count for slot in range(slots)]
        self.local = [slot // count for slot in range(slots)]
        self._inline = Worker(spec, slots) if count == 1 else None
        self._remotes: list[_Remote] = []
        if count > 1:
            self._remotes = [_Remote(k, spec, self.owner.count(k)) for k in range(count)]
            for remote in self._remotes:
                remote.send("modules")
            for remote in self._remotes:
                remote.answer()

    def reset(self, seeds: dict[int, int], record: bool) -> dict[int, dict[str, Any]]:
        """Start episodes {slot: seed} and return their first observations, as NumPy arrays by name."""
        return self._scatter("reset", seeds, record)

    def step(self, chunks: dict[int, NDArray[Any]]) -> dict[int, dict[str, Any]]:
        """Carry out chunks {slot: [K, A]} of commands and return the observations after them; where a
        recorded episode ends, its Track stands under "track".
        """
        return self._scatter("step", chunks)

    def script(self, jobs: list[tuple[int, float]], chunk: int) -> list[Track]:
        """Scripted episodes for (seed, noise_level) pairs, in the order of `jobs`; see Worker.script."""
        return self._deal("script", jobs, chunk)

    def segment(self, jobs: list[tuple[int, NDArray[Any]]]) -> list[tuple[NDArray[np.uint8] | None, Any]]:
        """Labels and pictures of repeated episodes, in the order of `jobs`; see Worker.segment."""
        return self._deal("segment", jobs)

    def _deal(self, name: str, jobs: list[Any], *extra: Any) -> list[Any]:
        """What a method of Worker that takes a list of jobs gives, each job by whoever is free."""
        if self._inline is not None:
            return list(getattr(self._inline, name)(jobs, *extra))
        waiting = deque(enumerate(jobs))
        busy: dict[Connection, tuple[_Remote, int]] = {}
        made: dict[int, Any] = {}

        def give(remote: _Remote) -> None:
            if waiting:
                number, job = waiting.popleft()
                remote.send(name, [job], *extra)
                busy[remote.pipe] = remote, number

        for remote in self._remotes:
            give(remote)
        while busy:
            for pipe in wait(list(busy)):
                assert isinstance(pipe, Connection)
                remote, number = busy.pop(pipe)
                (made[number],) = remote.answer()
                give(remote)
        return [made[number] for number in range(len(jobs))]

    def picture(self, seed: int, size: tuple[int, int]) -> NDArray[np.uint8]:
        """Pictures for people of an episode's start, uint8 [V, 3, H, W]."""
        return self._ask("picture", seed, size)

    def modules(self) -> list[str]:
        """Names of the modules that a worker has imported."""
        return self._ask("modules")

    def processes(self) -> list[int]:
        """Ids of the worker processes; none if the work is done in this one."""
        return [remote.process.pid for remote in self._remotes]

    def close(self) -> None:
        """End the workers."""
        for remote in self._remotes:
            remote.close(5.0)
        self._remotes, self._inline = [], None

    def _ask(self, name: str, *arguments: Any) -> Any:
        if self._inline is not None:
            return getattr(self._inline, name)(*arguments)
        self._remotes[0].send(name, *arguments)
        return self._remotes[0].answer()

    def _scatter(self, name: str, work: dict[int, Any], *extra: Any) -> dict[int, Any]:
        if self._inline is not None:
            return getattr(self._inline, name)(work, *extra)
        shares: dict[int, dict[int, Any]] = {}
        for slot, item in work.items():
            shares.setdefault(self.owner[slot], {})[self.local[slot]] = item
        for index, share in shares.items():
            self._remotes[index].send(name, share, *extra)
        count = len(self._remotes)
        out = {}
        for index in shares:
            for local, value in self._remotes[index].answer().items():
                out[local * count + index] = value
        return out
