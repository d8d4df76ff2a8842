"""One process that holds task suites, and what it takes to replace it by another that stands where it stood.

A process that dies takes its episodes with it. They run again, one at a time, bit for bit as before; so an
episode in which physics crashes again and again is found and given up, and the others go on. A suite that
raises an error stands wherever that left it, and one in which nothing happens for PATIENCE may never come
back: their processes are replaced as well. Workers give signs of life between frames, however long an answer
takes.
"""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing import Pipe
from typing import Any

from numpy.typing import NDArray

from envs.physics.worker import ALIVE, WorkerSpec
from envs.targets import ConfigError

log = logging.getLogger(__name__)
RETRIES = 3  # replacements of a process that may die in a row at one request
PATIENCE = 600.0  # s for a sign of life: a frame, or an episode's layout, of a slow suite on a busy machine
_RAISED = "raised an error:"
Request = tuple[str, tuple[Any, ...]]  # a method of Worker and its arguments


class PoolError(RuntimeError):
    """Physics failed; if it was an error of the suite, the message holds its traceback."""


class _Died(Exception):
    """The process at the other end of a pipe is gone, or no good any more for what this says."""


@dataclass
class _Episode:
    """What it takes to run an episode again: its seed and all chunks so far."""

    seed: int
    record: bool
    chunks: list[NDArray[Any]] = field(default_factory=list)


class WorkerProcess:
    """A worker process; see the module's docstring.

    Args:
        index: of the worker, for messages.
        spec: of suite and task.
        slots: episodes side by side.
        on_loss: told of every episode that is given up, and what of; it may raise a PoolError.

    Attributes:
        lost: seeds of the episodes that were given up.
    """

    def __init__(self, index: int, spec: WorkerSpec, slots: int, on_loss: Callable[[str], None]):
        self.index, self.spec, self.slots, self._on_loss = index, spec, slots, on_loss
        self._trouble = ""  # what the last process that was replaced did
        self._episodes: dict[int, _Episode] = {}
        self._request: Request | None = None
        self._said: tuple[str, Any] | None = None  # an answer that was read and not yet asked for
        self.lost: list[int] = []
        self._start()

    def send(self, name: str, *arguments: Any) -> None:
        """Ask for a method of Worker; `answer` waits for what it gives."""
        self._request = (name, arguments)
        if not self._fresh:
            self._write(self._request)

    def answer(self) -> Any:
        """What the last request gave. A process that died or failed is replaced and asked again, episode by
        episode; of one in which its successors do as well there is no answer, and its seed joins `lost`.

        Raises:
            PoolError: if too many are lost, or if processes die before they come to an episode.
        """
        assert self._request is not None
        try:
            return self._attempt()
        except _Died as died:
            self._replace(died)
        name, (work, *extra) = self._request[0], self._request[1] or (None,)
        if name == "script":
            answers = [self._insist((name, ([job], *extra)), job[0]) for job in work]
            return [track for some in answers for track in some or []]
        if name in ("reset", "step"):
            seeds = work if name == "reset" else {slot: self._episodes[slot].seed for slot in work}
            answers = [self._insist((name, ({slot: work[slot]}, *extra)), seeds[slot], slot) for slot in work]
            return {slot: value for some in answers for slot, value in (some or {}).items()}
        return self._insist(self._request)

    def answered(self) -> bool:
        """Whether `answer` would find an answer, or a dead process, at once."""
        try:
            while self._said is None and self.pipe.poll():
                self._said = _answer_in(self.pipe.recv())
        except (EOFError, OSError):
            return True
        return self._said is not None

    def _insist(self, request: Request, seed: int | None = None, slot: int | None = None) -> Any:
        """What a request gives that is about one episode, or none; None if physics crashes in it anew."""
        self.send(request[0], *request[1])
        reached, times = False, 1
        while times <= RETRIES:
            try:
                return self._attempt()
            except _Died as died:
                reached, before = not self._fresh, self._trouble
                self._replace(died)
            times += 1
            if reached and seed is not None and self._trouble == before and before.startswith(_RAISED):
                break  # word for word, in a new process and with no episode beside it: it always will
        if not reached or seed is None:
            raise PoolError(f"{times} times in a row physics worker {self.index} {self._trouble}")
        log.warning("physics failed %d times in the episode of seed %d; it is dropped", times, seed)
        self.lost.append(seed)
        if slot is not None:
            self._episodes.pop(slot, None)
        self._on_loss(self._trouble)
        return None

    def _attempt(self) -> Any:
        if self._fresh:
            self._catch_up()
        value = self._read()
        self._remember()
        return value

    def _replace(self, died: _Died) -> None:
        """Another process in place of one that died or failed; says why, at length the first time."""
        code, before = self.close(0.0), self._trouble
        self._trouble = str(died) or (
            f"died (exit code {code}): out of memory, a broken GL driver, or a suite that crashes"
        )
        what = "did the same again" if self._trouble == before else self._trouble
        log.warning("its episodes run again, for physics worker %d %s", self.index, what)
        self._start()

    def give_up(self) -> None:
        """Let the last request be: its answer would be taken for that to the next one. Another process will
        stand where this one stood before.
        """
        self.close(0.0)
        self._start()

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
        self._fresh, self._said = True, None
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
        said, self._said = self._said, None
        try:
            while said is None:
                if not self.pipe.poll(PATIENCE):
                    raise _Died(f"gave no sign of life for {PATIENCE:g} s: a suite that hangs")
                said = _answer_in(self.pipe.recv())
        except (EOFError, OSError) as error:
            raise _Died from error
        status, value = said
        if status == "config":
            raise ConfigError(value)
        if status == "broken":
            raise PoolError(f"physics worker {self.index} cannot start:\n{value}")
        if status == "error":
            raise _Died(f"{_RAISED}\n{value}")
        return value


def _answer_in(message: tuple[str, Any]) -> tuple[str, Any] | None:
    """A worker's message if it is an answer, None if it is a sign of life."""
    return None if message[0] == ALIVE else message
