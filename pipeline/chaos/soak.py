"""Kills, signals, full disks and corruption over all stages of a run, by a seeded schedule.

A run that nobody disturbs is the reference. Others, in one process and on Ray by turns, are disturbed all the
time: each life of the command is killed, asked to leave, or meets a full disk at some moment; between lives,
files of finished stages and checkpoints are spoiled. Every disturbance must be answered as the documentation
says, and a run that has come through must hold the reference's files, bit for bit but for times. Books are
kept event by event, so a soak goes on where it was interrupted.
"""

from __future__ import annotations

import json
import random
import shutil
import signal
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from envs.files import write_json
from pipeline.chaos import life
from pipeline.chaos.compare import differences
from pipeline.chaos.corruption import spoil
from pipeline.chaos.fleet import ChaosFailure
from pipeline.chaos.processes import nothing_left

_WEIGHTS = {"SIGKILL": 4, "SIGTERM": 1, "SIGINT": 1, "disk full": 2, "corruption": 2}
_LEAVES_WITHIN = 60.0  # seconds after a signal; the longest step of any stage and a checkpoint
_STUCK = 6  # lives in a row without a finished stage, after which one is left alone


@dataclass
class Books:
    """What was done and what came of it.

    Args:
        events: disturbances so far, by kind.
        answers: what came of them, by kind.
        runs: disturbed runs that came through, equal to the reference.
        lives: processes that were started.
        undisturbed: lives that ended before their disturbance came.
        seconds: spent.
    """

    events: dict[str, int] = field(default_factory=dict)
    answers: dict[str, int] = field(default_factory=dict)
    runs: int = 0
    lives: int = 0
    undisturbed: int = 0
    seconds: float = 0.0

    @property
    def count(self) -> int:
        """Disturbances so far."""
        return sum(self.events.values())

    def note(self, kind: str, answer: str) -> None:
        """Enter a disturbance and its answer."""
        self.events[kind] = self.events.get(kind, 0) + 1
        said = f"{kind}: {answer}"
        self.answers[said] = self.answers.get(said, 0) + 1


class Soak:
    """A soak in a folder.

    Args:
        cfg: resolved config.
        words: the overrides that made it.
        folder: of the soak; one that was interrupted goes on.
    """

    def __init__(self, cfg: Mapping[str, Any], words: list[str], folder: Path):
        self.cfg, self.folder, self.seed = cfg, folder.resolve(), int(cfg["seed"])
        self.words = [w for w in words if not w.startswith(("runs=", "name=", "track=", "launch"))]
        self.path, self.log = self.folder / "books.json", self.folder / "lives.log"
        known = json.loads(self.path.read_text()) if self.path.exists() else {}
        self.books = Books(**known)
        self.stuck = 0

    def run(self, events: int) -> Books:
        """Disturb until so many events are in the books.

        Raises:
            ChaosFailure: at the first thing that is not as promised; the message says which.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        self._reference()
        with tqdm(
            total=events, initial=self.books.count, desc="soak", unit="event", dynamic_ncols=True
        ) as bar:
            while self.books.count < events:
                began = time.monotonic()
                chance = random.Random(f"{self.seed} {self.books.count} {self.books.lives}")
                self._disturb(chance)
                self.books.seconds += time.monotonic() - began
                write_json(self.path, asdict(self.books))
                bar.n = self.books.count
                bar.set_postfix_str(f"{self.books.runs} runs came through")
        self._finish()
        write_json(self.path, asdict(self.books))
        return self.books

    # -- lives
    def _begin(self, name: str, full_after: int | None = None) -> Any:
        self.books.lives += 1
        self.mark = f"{self.seed}-{self.books.lives}"
        with self.log.open("a") as log:
            log.write(f"\n##### life {self.books.lives} of {name}\n")
        self.said_from = self.log.stat().st_size
        where = ["launch=ray", "launch.cpus=4"] if self._on_ray(name) else ["launch=local"]
        words = ["run", *self.words, *where, f"runs={self.folder}", f"name={name}", "track=disabled"]
        return life.begin(words, self.mark, self.log, self.folder / name, full_after)

    def _end(self, process: Any, within: float | None = None) -> int:
        """Its exit status; everything that it started must be gone soon after."""
        process.join(within)
        if process.exitcode is None:
            life.send(process, signal.SIGABRT)
            process.join(10)
            process.kill()
            raise self._failure(f"it did not leave within {within:.0f} s")
        nothing_left(self.mark, process.pid, self._failure)
        return int(process.exitcode)

    def _said(self) -> str:
        with self.log.open("rb") as log:
            log.seek(self.said_from)
            return log.read().decode(errors="replace")

    def _failure(self, what: str) -> ChaosFailure:
        return ChaosFailure(
            f"event {self.books.count}, life {self.books.lives}: {what}. It said: ...{self._said()[-1500:]}\n"
            f"See {self.log}; the same command goes on from there"
        )

    # -- the runs
    def _reference(self) -> None:
        done = self.folder / "reference/result.json"
        if not done.exists():
            status = self._end(self._begin("reference"))
            if status:
                raise self._failure(f"the undisturbed run ended with {status}")

    @property
    def name(self) -> str:
        """Of the run that is being disturbed."""
        return f"run-{self.books.runs}"

    def _on_ray(self, name: str) -> bool:
        """Every other disturbed run; the reference is local, and all must be equal to it."""
        return name != "reference" and self.books.runs % 2 == 1

    def _came_through(self) -> None:
        """Compare the finished run with the reference, and begin another."""
        odd = differences(self.folder / "reference", self.folder / self.name)
        if odd:
            raise self._failure(f"{self.folder / self.name} differs from the reference in {odd[:8]}")
        shutil.rmtree(self.folder / self.name)
        self.books.runs += 1
        self.stuck = 0

    def _finish(self) -> None:
        """Let the last run come through, too."""
        if (self.folder / self.name).exists():
            if self._end(self._begin(self.name)):
                raise self._failure("it could not be finished")
            self._came_through()

    def _stages(self) -> int:
        return len(list((self.folder / self.name / "stages").glob("*/manifest.json")))

    # -- disturbances
    def _disturb(self, chance: random.Random) -> None:
        kind = chance.choices(list(_WEIGHTS), list(_WEIGHTS.values()))[0]
        if self.stuck >= _STUCK:
            self._leave_alone()
        elif kind == "corruption":
            self._corrupt(chance)
        elif kind == "disk full":
            self._fill(chance)
        else:
            self._signal(chance, kind)

    def _leave_alone(self) -> None:
        """A life until another stage has ended, then killed: or long stages would never end."""
        process, before = self._begin(self.name), self._stages()
        while process.exitcode is None and self._stages() == before:
            process.join(0.1)
        self.stuck = 0
        self._deliver(process, "SIGKILL")

    def _signal(self, chance: random.Random, kind: str) -> None:
        process, before = self._begin(self.name), self._stages()
        process.join(10 ** chance.uniform(-1, 1))
        self._deliver(process, kind)
        self.stuck = 0 if self._stages() > before else self.stuck + 1

    def _deliver(self, process: Any, kind: str) -> None:
        """A signal to a life, unless it has ended already, and what came of it."""
        if process.exitcode is None:
            number = getattr(signal, kind)
            life.send(process, number)
            status = self._end(process, _LEAVES_WITHIN)
            wanted = -number if kind == "SIGKILL" else 128 + number
            if status == wanted:
                if kind != "SIGKILL" and "Traceback" in self._said():
                    raise self._failure(f"{kind} was answered by a traceback")
                self.books.note(kind, "ended as asked")
                return
        else:
            status = self._end(process)
        if status:
            raise self._failure(f"it ended with {status} before or after {kind}")
        self.books.undisturbed += 1
        self._came_through()

    def _fill(self, chance: random.Random) -> None:
        """A life whose disk becomes full."""
        before = self._stages()
        status = self._end(self._begin(self.name, int(10 ** chance.uniform(0, 2.5))))
        self.stuck = 0 if self._stages() > before else self.stuck + 1
        if status == 0:
            self.books.undisturbed += 1
            self._came_through()
            return
        said = self._said()
        if status != 1 or "Traceback" in said or "No space left" not in said:
            raise self._failure(f"a full disk was answered by exit status {status}")
        self.books.note("disk full", "told in a line")

    def _corrupt(self, chance: random.Random) -> None:
        """A spoiled file, a life that must notice it, and the fix that it names."""
        done = spoil(self.folder / self.name / "stages", chance)
        if done is None:  # nothing is there yet
            self._signal(chance, "SIGKILL")
            return
        folder, what = done
        status = self._end(self._begin(self.name))
        said = self._said()
        if status == 0:
            raise self._failure(f"{what} was not noticed")
        if status != 1 or "Traceback" in said or folder.name not in said:
            raise self._failure(f"{what} was answered by exit status {status}")
        shutil.rmtree(folder)
        self.books.note("corruption", "told by name")
