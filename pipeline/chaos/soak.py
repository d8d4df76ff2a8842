"""Kills, signals, full disks and corruption over all stages of a run, by a seeded schedule.

A run that nobody disturbs is the reference. Others are disturbed all the time: each life of the command, in
one process or on Ray, is killed, asked to leave, or meets a full disk while a stage that was chosen for it is
at work; between lives, files of finished stages and checkpoints are spoiled. Every disturbance must be
answered as the documentation says, and a run that has come through must hold the reference's files, bit for
bit but for times. Books are kept event by event, so a soak goes on where it was interrupted.
"""

from __future__ import annotations

import json
import random
import shutil
import signal
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from envs.files import write_json
from envs.manifest import MANIFEST
from pipeline.chaos import life
from pipeline.chaos.books import Books
from pipeline.chaos.compare import differences
from pipeline.chaos.corruption import spoil
from pipeline.chaos.faults import Fault
from pipeline.chaos.fleet import ChaosFailure
from pipeline.chaos.processes import kill_worker, nothing_left
from pipeline.config import load_config
from pipeline.graph.graph import Graph
from pipeline.loop import build_loop

_SIGNALS = {"SIGKILL": 3, "SIGTERM": 2, "SIGINT": 2}  # while a stage is at work
_WRITES = {"SIGKILL at a write": 2, "disk full": 3}  # at some write of a stage
_WEIGHTS = {**_SIGNALS, **_WRITES, "corruption": 3}
# Stages that a life passes before the one it shall be disturbed in; -1: before it comes to any.
_AHEAD = {-1: 1, 0: 5, 1: 4, 2: 1}
_ON_RAY, _WITH_WORKERS = 0.15, 0.25  # shares of lives on Ray, and with two physics workers instead of one
_WORKER_KILLED = 0.5  # share of lives that lose a worker, if they have any
_CORES = 1  # of each life: training sums in another order on another number
_BETWEEN = "between stages"


class Soak:
    """A soak in a folder.

    Args:
        words: the overrides that make the config of the runs.
        seed: of the schedule.
        folder: of the soak; one that was interrupted goes on.
        patience: seconds within which a life that is asked to leave must have left.
    """

    def __init__(self, words: list[str], seed: int, folder: Path, patience: float):
        self.folder, self.seed, self.patience = folder.resolve(), seed, patience
        self.words = [w for w in words if not w.startswith(("runs=", "name=", "track=", "launch"))]
        self.path, self.log = self.folder / "books.json", self.folder / "lives.log"
        known = json.loads(self.path.read_text()) if self.path.exists() else {}
        self.books = Books(**known)
        self.graphs: dict[str, Graph] = {}
        self.process: Any = None

    def run(self, events: int) -> Books:
        """Disturb until so many events are in the books.

        Raises:
            ChaosFailure: at the first thing that is not as promised; the message says which.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            return self._run(events)
        except BaseException:  # whatever ends this command ends the life that it began
            life.kill(self.process)
            raise

    def _run(self, events: int) -> Books:
        self._reference()
        with tqdm(
            total=events, initial=self.books.count, desc="soak", unit="event", dynamic_ncols=True
        ) as bar:
            while self.books.count < events:
                began = time.monotonic()
                self._disturb(random.Random(f"{self.seed} {self.books.count} {self.books.lives}"))
                self.books.seconds += time.monotonic() - began
                write_json(self.path, asdict(self.books))
                bar.n = self.books.count
                bar.set_postfix_str(f"{self.books.runs} runs came through")
        self._finish()
        write_json(self.path, asdict(self.books))
        return self.books

    # -- lives
    def _begin(self, chance: random.Random, name: str, fault: Fault | None = None) -> Any:
        """A life, on a launch that chance chooses: what comes out is the same on all."""
        self.books.lives += 1
        self.mark = f"{self.seed}-{self.books.lives}"
        self.launch = "ray" if chance.random() < _ON_RAY else "local"
        workers = 2 if chance.random() < _WITH_WORKERS else 1
        with self.log.open("a") as log:
            log.write(f"\n##### life {self.books.lives} of {name} on {self.launch}, {workers} workers\n")
        self.log_start, self.began = self.log.stat().st_size, time.time()
        words = ["run", *self.words, f"runs={self.folder}", f"name={name}", "track=disabled"]
        words += [f"launch={self.launch}", f"launch.workers={workers}"]
        words += ["launch.cpus=4"] if self.launch == "ray" else []
        self.process = life.begin(words, self.mark, self.log, fault, cores=_CORES)
        if self.books.lives == 1:
            tqdm.write(f"life 1 begins, undisturbed; {self.log} has what lives say")
        return self.process

    def _end(self, process: Any, within: float | None = None) -> int:
        """Its exit status; everything that it started must be gone soon after."""
        process.join(within)
        if process.exitcode is None:
            life.send(process, signal.SIGABRT)
            process.join(10)
            process.kill()
            raise self._failure(f"it did not leave within {within:.0f} s")
        nothing_left(self.mark, process.pid, self._failure, self.patience)
        return int(process.exitcode)

    def _output(self) -> str:
        with self.log.open("rb") as log:
            log.seek(self.log_start)
            return log.read().decode(errors="replace")

    def _failure(self, what: str) -> ChaosFailure:
        return ChaosFailure(
            f"life {self.books.lives} said: ...{self._output()[-1500:]}\n"
            f"event {self.books.count}, life {self.books.lives}: {what}. See {self.log}; the same command"
            " goes on from there"
        )

    # -- the runs
    def _reference(self) -> None:
        for run in ("reference", self.name):
            self._forget_older_code(run)
        manifests = {
            name: self._folder(name, "reference") / MANIFEST for name in self._graph("reference").nodes
        }
        known = all(path.exists() for path in manifests.values())
        if not known and (status := self._end(self._begin(random.Random(0), "reference"))):
            raise self._failure(f"the undisturbed run ended with {status}")
        self.takes = {name: _seconds(path) for name, path in manifests.items()}

    def _forget_older_code(self, run: str) -> None:
        """Remove the stages of a soak that was interrupted before the code changed."""
        own = {self._folder(name, run) for name in self._graph(run).nodes}
        for folder in (self.folder / run / "stages").glob("*"):
            if folder not in own:
                shutil.rmtree(folder)

    @property
    def name(self) -> str:
        """Of the run that is being disturbed."""
        return f"run-{self.books.runs}"

    def _graph(self, run: str) -> Graph:
        if run not in self.graphs:
            root = self.folder / run
            self.graphs = {run: build_loop(load_config([*self.words, f"name={run}"]), root)}
        return self.graphs[run]

    def _folder(self, stage: str, run: str = "") -> Path:
        return self._graph(run or self.name).folder(stage)

    def _left(self) -> list[str]:
        """Stages of the run that are not finished, in order."""
        return [name for name in self._graph(self.name).nodes if not (self._folder(name) / MANIFEST).exists()]

    def _at_work(self) -> str:
        """The stage that this life is at or was at, _BETWEEN if it has come to none."""
        for name in reversed(self._left()):
            try:
                if self._folder(name).stat().st_mtime >= self.began:
                    return name
            except FileNotFoundError:
                continue
        return _BETWEEN

    def _came_through(self) -> None:
        """Compare the finished run with the reference, and begin another."""
        odd = differences(self.folder / "reference", self.folder / self.name)
        if odd:
            raise self._failure(f"{self.folder / self.name} differs from the reference in {odd[:8]}")
        for stage, takes in self.takes.items():  # the reference may have met a busy machine
            self.takes[stage] = min(takes, _seconds(self._folder(stage) / MANIFEST))
        shutil.rmtree(self.folder / self.name)
        self.books.runs += 1

    def _finish(self) -> None:
        """Let the last run come through, too."""
        if (self.folder / self.name).exists():
            if self._end(self._begin(random.Random(1), self.name)):
                raise self._failure("it could not be finished")
            self._came_through()

    # -- disturbances
    def _disturb(self, chance: random.Random) -> None:
        kind = chance.choices(list(_WEIGHTS), list(_WEIGHTS.values()))[0]
        left, ahead = self._left(), chance.choices(list(_AHEAD), list(_AHEAD.values()))[0]
        stage = left[min(ahead, len(left) - 1)] if left and ahead >= 0 else ""
        if kind == "corruption":
            self._corrupt(chance)
        elif kind in _WRITES and stage:
            self._at_a_write(chance, kind, stage)
        else:
            self._signal(chance, kind if kind in _SIGNALS else "SIGKILL", stage)

    def _signal(self, chance: random.Random, kind: str, stage: str) -> None:
        """A signal, some time after a life has come to a stage, or has begun if that is "". A worker that it
        loses before must be replaced.
        """
        process = self._begin(chance, self.name)
        while process.exitcode is None and not self._has_come_to(stage):
            process.join(0.03)
        wait = max(0.1, 1.2 * self.takes.get(stage, 0.0))
        process.join(wait * chance.random())
        if chance.random() < _WORKER_KILLED and kill_worker(self.mark, process.pid, chance):
            met = self._at_work()
            process.join(wait * chance.random())
            if process.exitcode in (None, 0):
                self.books.note(met, "worker killed", self.launch, "replaced")
        if process.exitcode is not None:
            self._ended_well(self._end(process))
            return
        met, number = self._at_work(), getattr(signal, kind)
        life.send(process, number)
        status = self._end(process, self.patience)
        if status == 0:  # it was ending already
            self._ended_well(status)
            return
        answers = {-number} if kind == "SIGKILL" else {128 + number}
        if not self._left():  # with all done it has nothing to clean up; shells call both 128 + number
            answers.add(-number)
        if status not in answers:
            raise self._failure(f"it ended with {status} after {kind}")
        if kind != "SIGKILL" and "Traceback" in self._output():
            raise self._failure(f"{kind} was answered by a traceback")
        self.books.note(met, kind, self.launch, "ended as asked")

    def _has_come_to(self, stage: str) -> bool:
        """Whether a life has, or is beyond; of "", whether it has said anything."""
        return self._at_work() == stage or stage not in self._left() if stage else bool(self._output())

    def _ended_well(self, status: int) -> None:
        """A life that ended before its disturbance, because all is done."""
        if status:
            raise self._failure(f"it ended with {status} by itself")
        self.books.undisturbed += 1
        self._came_through()

    def _at_a_write(self, chance: random.Random, kind: str, stage: str) -> None:
        """A life that is killed at some write of a stage, or whose disk is full from then on."""
        run, after = self.folder / self.name, int(10 ** chance.uniform(0, 2)) - 1
        fault = Fault(run, after, "full" if kind == "disk full" else "die", self._folder(stage))
        status = self._end(self._begin(chance, self.name, fault))
        if status == 0:
            self._ended_well(status)
            return
        output, met = self._output(), self._at_work()
        if kind != "disk full":
            if status != -signal.SIGKILL:
                raise self._failure(f"it ended with {status} before it was killed at a write")
            self.books.note(met, kind, self.launch, "ended as asked")
            return
        if status != 1 or "Traceback" in output or "No space left" not in output:
            raise self._failure(f"a full disk was answered by exit status {status}")
        self.books.note(met, kind, self.launch, "told in a line")

    def _corrupt(self, chance: random.Random) -> None:
        """A spoiled file, a life that must notice it, and the fix that it names."""
        run = self.folder / self.name
        done = spoil(run / "stages", chance)
        if done is None:  # nothing is there yet
            self._signal(chance, "SIGKILL", self._left()[0])
            return
        folder, what = done
        status = self._end(self._begin(chance, self.name))
        output = self._output()
        if status == 0:
            raise self._failure(f"{what} was not noticed")
        if status != 1 or "Traceback" in output or folder.name not in output:
            raise self._failure(f"{what} was answered by exit status {status}")
        place = folder.relative_to(run / "stages").parts[0]
        shutil.rmtree(folder)
        self.books.note(place.rpartition("-")[0], "corruption", self.launch, "told by name")


def _seconds(manifest: Path) -> float:
    """What a finished stage took."""
    return float(json.loads(manifest.read_text())["seconds"])
