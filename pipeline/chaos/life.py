"""One life of a command, in a process of its own, from its beginning to its end or to what happens to it.

Lives are forked from a server that has imported everything and done nothing, so that a thousand of them do
not spend an hour importing.
"""

from __future__ import annotations

import atexit
import faulthandler
import multiprocessing
import os
import random
import signal
import sys
from contextlib import nullcontext, suppress
from multiprocessing.process import BaseProcess
from pathlib import Path

from pipeline.chaos.faults import Fault, faulty
from pipeline.cli.main import main

MARK = "WORLDLOOP_CHAOS"  # environment variable by which the children of a life are known
OVERLOOKED = 99  # exit status of a command that ended well although it could not write

_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload(["pipeline.chaos.life", "pipeline.chaos.imports"])


def begin(words: list[str], mark: str, log: Path, fault: Fault | None = None, cores: int = 0) -> BaseProcess:
    """Start `worldloop <words>`.

    Args:
        words: command and overrides.
        mark: value of MARK in its environment.
        log: file that its output is added to.
        fault: that it meets.
        cores: that it may use, 0 for all; small work on busy cores waits for itself more than it computes.
    """
    process = _context.Process(target=_live, args=(words, mark, str(log), fault, cores))
    process.start()
    return process


def _live(words: list[str], mark: str, log: str, fault: Fault | None, cores: int) -> None:
    os.setsid()
    if cores and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, random.SystemRandom().sample(sorted(os.sched_getaffinity(0)), cores))
    os.environ[MARK] = mark
    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(file, 1)
    os.dup2(file, 2)
    # the server's streams are not this log
    sys.stdout, sys.stderr = os.fdopen(1, "w", buffering=1), os.fdopen(2, "w", buffering=1)
    # shells start what runs in the background deaf to Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)
    faulthandler.enable(sys.stderr)  # SIGABRT tells where a life that does not leave stands
    sys.argv = ["worldloop", *words]
    try:
        with nullcontext() if fault is None else faulty(fault):
            main()
        if fault is not None and fault.tripped:
            sys.exit(OVERLOOKED)
    finally:
        atexit._run_exitfuncs()  # a forked process ends without them, and Ray's would stay
        sys.stdout.flush()
        sys.stderr.flush()


def kill(process: BaseProcess | None) -> None:
    """End a life, if there is one, with its session."""
    if process is None or process.pid is None or process.exitcode is not None:
        return
    with suppress(ProcessLookupError):  # it has no session of its own yet
        os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.join()


def send(process: BaseProcess, number: int) -> None:
    """A signal to the command itself; what it started is its own affair."""
    assert process.pid is not None
    os.kill(process.pid, number)
