"""Worker processes that hold benches, so that a batch of true worlds uses every core.

Benches are dealt to workers by slot number, and what a bench does depends on its episode's seed alone: the
number of workers changes the speed and nothing else.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import traceback
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.physics.tabletop.bench import Bench, BenchConfig


def available_cores() -> int:
    """Cores this process may run on, which in containers and batch systems is less than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass
class Track:
    """What one episode leaves behind, a row per video frame; row 0 is the start.

    frames uint8 [T, V, 3, H, W], commands and achieved [T, 14], states [T, 16], c2w [T, V, 4, 4], success
    [T],
    progress [T], objects [T, 2, 4] = places of block and target (schema.OBJECT_DIM); a disc has no heading.
    """

    seed: int
    instruction: str
    intrinsic: NDArray[Any]
    rows: dict[str, list[Any]] = field(default_factory=dict)

    def add(self, bench: Bench) -> None:
        """Append the bench as it stands now."""
        _, c2w = bench.cameras()
        row = {
            "frames": bench.render(),
            "commands": bench.command.copy(),
            "achieved": bench.achieved(),
            "states": bench.state(),
            "c2w": c2w,
            "success": bench.success,
            "progress": bench.task.progress(bench.distance),
            "objects": np.stack([bench.block, np.array([*bench.layout.target, 0.0, np.nan])]),
        }
        for name, value in row.items():
            self.rows.setdefault(name, []).append(value)


@dataclass
class Slot:
    """One bench of a worker with the episode it is in."""

    bench: Bench
    steps: int = 0
    over: bool = True
    track: Track | None = None


class Worker:
    """The work of one process; also runs in the caller's process when the pool has one worker."""

    def __init__(self, config: BenchConfig, slots: int, horizon: int):
        self.config, self.horizon = config, horizon
        self.slots = [Slot(Bench(config)) for _ in range(slots)]

    def reset(self, seeds: dict[int, int], record: bool) -> dict[int, dict[str, Any]]:
        """Start episodes {slot: seed}; returns an observation per slot."""
        out = {}
        for index, seed in seeds.items():
            slot = self.slots[index]
            slot.bench.reset(seed)
            slot.steps, slot.over = 0, False
            slot.track = (
                Track(seed, slot.bench.layout.instruction, slot.bench.cameras()[0]) if record else None
            )
            if slot.track is not None:
                slot.track.add(slot.bench)
            out[index] = self._observe(slot)
        return out

    def step(self, chunks: dict[int, NDArray[Any]]) -> dict[int, dict[str, Any]]:
        """Carry out chunks {slot: [K, 14] absolute}, each to its end, as imagined worlds do; an episode that
        is over stands still.
        """
        out = {}
        for index, chunk in chunks.items():
            slot = self.slots[index]
            for command in () if slot.over else chunk:
                slot.bench.step(command)
                slot.steps += 1
                if slot.track is not None:
                    slot.track.add(slot.bench)
            slot.over = slot.bench.success or slot.steps >= self.horizon
            out[index] = self._observe(slot)
            if slot.over and slot.track is not None:
                out[index]["track"], slot.track = slot.track, None
        return out

    def script(self, jobs: list[tuple[int, float]], chunk: int = 1) -> list[Track]:
        """Whole episodes of scripted behaviours for (seed, noise_level) pairs; recorded to the horizon, or to
        the end of the `chunk` steps in which they succeed.
        """
        from envs.physics.tabletop.experts import Behaviour

        out = []
        for seed, noise_level in jobs:
            bench = self.slots[0].bench
            bench.reset(seed)
            behaviour = Behaviour(
                bench.task,
                bench.layout,
                noise_level,
                np.random.default_rng([seed, 1]),
                1 / self.config.control_hz,
            )
            near = bench.layout.arm * 7
            track = Track(seed, bench.layout.instruction, bench.cameras()[0])
            track.add(bench)
            for step in range(self.horizon):
                if bench.success and step % chunk == 0:
                    break
                command = bench.command.copy()
                command[near : near + 2] = behaviour.fingertip(bench.block[:2], command[near : near + 2])
                bench.step(command)
                track.add(bench)
            out.append(track)
        return out

    def picture(self, seed: int, size: tuple[int, int], views: tuple[str, ...]) -> NDArray[np.uint8]:
        """A picture with shadows of an episode's start, uint8 [V, 3, H, W]."""
        self.slots[0].bench.reset(seed)
        return self.slots[0].bench.render(views, size, shadows=True)

    def _observe(self, slot: Slot) -> dict[str, Any]:
        bench = slot.bench
        intrinsic, c2w = bench.cameras()
        return {
            "image": bench.render() if slot.track is None else slot.track.rows["frames"][-1],
            "state": bench.state(),
            "command": bench.command.copy(),
            "intrinsic": intrinsic,
            "c2w": c2w,
            "success": bench.success,
            "progress": bench.task.progress(bench.distance),
            "instruction": bench.layout.instruction,
            "over": slot.over,
        }


def _serve(pipe: Connection, config: BenchConfig, slots: int, horizon: int) -> None:
    try:
        worker = Worker(config, slots, horizon)
        pipe.send(("ok", None))
    except Exception:
        pipe.send(("error", traceback.format_exc()))
        return
    while True:
        try:
            message = pipe.recv()
        except EOFError:
            return
        if message is None:
            return
        name, arguments = message
        try:
            pipe.send(("ok", getattr(worker, name)(*arguments)))
        except Exception:
            pipe.send(("error", traceback.format_exc()))


class PoolError(RuntimeError):
    """A physics worker failed; the message holds its own traceback."""


class BenchPool:
    """`slots` benches over `workers` processes.

    Args:
        config: the bench's options.
        slots: how many episodes run side by side.
        horizon: control steps after which an episode is over.
        workers: processes; 0 means one per core, 1 runs in this process.
    """

    def __init__(self, config: BenchConfig, slots: int, horizon: int, workers: int = 0):
        count = min(workers or available_cores(), slots)
        self.owner = [slot % count for slot in range(slots)]
        self.local = [slot // count for slot in range(slots)]
        sizes = [self.owner.count(k) for k in range(count)]
        self._inline: Worker | None = None
        self._pipes: list[Connection] = []
        self._processes: list[Any] = []
        if count == 1:
            self._inline = Worker(config, slots, horizon)
            return
        context = multiprocessing.get_context(
            "forkserver"
        )  # whose imports later pools share; a fork of this process would share its threads' locks
        # torchrl for the script that started us, which workers import anew
        context.set_forkserver_preload(["torchrl.envs", __name__])
        for size in sizes:
            ours, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, config, size, horizon), daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)
        for index in range(count):
            self._receive(index)

    def _receive(self, index: int) -> Any:
        try:
            status, value = self._pipes[index].recv()
        except (EOFError, ConnectionResetError) as error:
            code = self._processes[index].exitcode
            raise PoolError(
                f"physics worker {index} died (exit code {code}); out of memory or a broken GL driver"
            ) from error
        if status == "error":
            raise PoolError(f"physics worker {index} failed:\n{value}")
        return value

    def _scatter(self, name: str, work: dict[int, Any], *extra: Any) -> dict[int, Any]:
        if self._inline is not None:
            return getattr(self._inline, name)(work, *extra)
        shares: dict[int, dict[int, Any]] = {}
        for slot, item in work.items():
            shares.setdefault(self.owner[slot], {})[self.local[slot]] = item
        for index, share in shares.items():
            self._pipes[index].send((name, (share, *extra)))
        count = len(self._pipes)
        out = {}
        for index in shares:
            for local, value in self._receive(index).items():
                out[local * count + index] = value
        return out

    def reset(self, seeds: dict[int, int], record: bool = False) -> dict[int, dict[str, Any]]:
        """Start episodes {slot: seed} and return their first observations."""
        return self._scatter("reset", seeds, record)

    def step(self, chunks: dict[int, NDArray[Any]]) -> dict[int, dict[str, Any]]:
        """Carry out chunks {slot: [K, 14]} and return the observations after them."""
        return self._scatter("step", chunks)

    def script(self, jobs: list[tuple[int, float]], chunk: int = 1) -> list[Track]:
        """Scripted episodes for (seed, noise_level) pairs, in the order of `jobs`; see Worker.script."""
        if self._inline is not None:
            return self._inline.script(jobs, chunk)
        count = len(self._pipes)
        for index, pipe in enumerate(self._pipes):
            pipe.send(("script", (jobs[index::count], chunk)))
        shares = [self._receive(index) for index in range(count)]
        return [shares[k % count][k // count] for k in range(len(jobs))]

    def close(self) -> None:
        """End the workers."""
        for pipe in self._pipes:
            with contextlib.suppress(OSError):  # gone already, which is what we ask for
                pipe.send(None)
        for pipe, process in zip(self._pipes, self._processes, strict=True):
            process.join(timeout=5)
            if process.is_alive():
                process.kill()
            pipe.close()
        self._pipes, self._processes, self._inline = [], [], None
