"""Worker processes that hold task suites, so that a batch of true worlds uses every core.

Episodes are dealt to workers by slot number, and what happens in one depends on its task, seed and actions
alone: the number of workers changes the speed and nothing else. So a worker that dies can be replaced by
another (process.py).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.machine import available_cores
from envs.physics import process
from envs.physics.process import PoolError, WorkerProcess
from envs.physics.suite import task_names
from envs.physics.worker import Track, WorkerSpec
from envs.targets import ConfigError, to_plain

LOST = 0.05  # share of the episodes of a pool that may be given up before it stops

__all__ = ["PoolError", "TaskPool", "Track"]


class TaskPool:
    """`slots` episodes of a suite over worker processes.

    Args:
        suite: config section of the task suite.
        task: a name of its tasks, or several, which are played by turns; see task_of.
        slots: how many episodes run side by side.
        horizon: actions after which an episode is over.
        workers: processes; 0 means one per core.

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
        self._begun = 0
        self._remotes: list[WorkerProcess] = []
        try:
            for k in range(count):
                self._remotes.append(WorkerProcess(k, spec, self.owner.count(k), self._check_losses))
                self._remotes[k].send("modules")
            for remote in self._remotes:
                remote.answer()
        except BaseException:
            self.close()
            raise

    @property
    def lost(self) -> list[int]:
        """Seeds of the episodes that were given up: physics crashed, or the suite raised an error, in them
        again and again.
        """
        return [seed for remote in self._remotes for seed in remote.lost]

    def reset(self, seeds: dict[int, int], record: bool) -> dict[int, dict[str, Any]]:
        """Start episodes {slot: seed} and return their first observations, as NumPy arrays by name; slots
        whose episodes are given up are missing.

        Raises:
            PoolError: if too many are given up.
        """
        self._begun += len(seeds)
        return self._scatter("reset", seeds, record)

    def step(self, chunks: dict[int, NDArray[Any]]) -> dict[int, dict[str, Any]]:
        """Carry out chunks {slot: [K, A]} of commands and return the observations after them; where a
        recorded episode ends, its Track stands under "track". Slots whose episodes are given up are missing,
        and are not to be asked for until their next reset.

        Raises:
            PoolError: if too many are given up.
        """
        return self._scatter("step", chunks)

    def script(self, jobs: list[tuple[int, float]], chunk: int | None) -> list[Track]:
        """Scripted episodes for (seed, noise_level) pairs, in the order of `jobs`; those that are given up
        are missing. See Worker.script.

        Raises:
            PoolError: if too many are given up.
        """
        self._begun += len(jobs)
        return self._deal("script", jobs, chunk)

    def segment(
        self, jobs: list[tuple[int, NDArray[Any]]]
    ) -> list[tuple[NDArray[np.uint8] | None, NDArray[np.uint8], dict[str, NDArray[Any]]]]:
        """What repeated episodes show, in the order of `jobs`; see Worker.segment.

        Raises:
            PoolError: if an episode crashes physics again and again.
        """
        return self._deal("segment", jobs)

    def _deal(self, name: str, jobs: list[Any], *extra: Any) -> list[Any]:
        """What a method of Worker that takes a list of jobs gives, each job by whoever is free."""
        waiting = deque(enumerate(jobs))
        busy: dict[Connection, tuple[WorkerProcess, int]] = {}
        made: dict[int, Any] = {}

        def give(remote: WorkerProcess) -> None:
            if waiting:
                number, job = waiting.popleft()
                remote.send(name, [job], *extra)
                busy[remote.pipe] = remote, number

        for remote in self._remotes:
            give(remote)
        while busy:
            heard = wait(list(busy), process.PATIENCE)
            for pipe in heard or list(busy):  # none: all that are left hang
                assert isinstance(pipe, Connection)
                if heard and not busy[pipe][0].answered():
                    continue  # it is alive
                remote, number = busy.pop(pipe)
                for one in self._answer(remote, [other for other, _ in busy.values()]):
                    made[number] = one
                give(remote)
        return [made[number] for number in sorted(made)]

    def picture(self, seed: int, size: tuple[int, int]) -> NDArray[np.uint8]:
        """Pictures for people of an episode's start, uint8 [V, 3, H, W]."""
        return self._request("picture", seed, size)

    def modules(self) -> list[str]:
        """Names of the modules that a worker has imported."""
        return self._request("modules")

    def processes(self) -> list[int]:
        """Ids of the worker processes."""
        return [remote.process.pid for remote in self._remotes]

    def close(self) -> None:
        """End the workers."""
        for remote in self._remotes:
            remote.close(5.0)
        self._remotes = []

    def _request(self, name: str, *arguments: Any) -> Any:
        self._remotes[0].send(name, *arguments)
        return self._remotes[0].answer()

    def _scatter(self, name: str, work: dict[int, Any], *extra: Any) -> dict[int, Any]:
        shares: dict[int, dict[int, Any]] = {}
        for slot, item in work.items():
            shares.setdefault(self.owner[slot], {})[self.local[slot]] = item
        for index, share in shares.items():
            self._remotes[index].send(name, share, *extra)
        count, indices = len(self._remotes), list(shares)
        out = {}
        for number, index in enumerate(indices):
            others = [self._remotes[other] for other in indices[number + 1 :]]
            for local, value in self._answer(self._remotes[index], others).items():
                out[local * count + index] = value
        return out

    def _answer(self, remote: WorkerProcess, others: list[WorkerProcess]) -> Any:
        """What one of them says; if that is an error, `others` that are still at work are not heard out."""
        try:
            return remote.answer()
        except (PoolError, ConfigError):
            for other in others:
                other.give_up()
            raise

    def _check_losses(self, trouble: str) -> None:
        """Stop where too many episodes are lost, the last one to `trouble`.

        Raises:
            PoolError: with their seeds.
        """
        lost = self.lost
        if len(lost) > LOST * max(self._begun, round(1 / LOST)):
            raise PoolError(
                f"physics crashed again and again in {len(lost)} of {self._begun} episodes (seeds"
                f" {lost[:4]}), more than a share of {LOST}; the last time it {trouble}"
            )
