"""Which processes belong to a life: those of its session, and whatever inherited its mark."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from pipeline.chaos.life import MARK

_PHYSICS = "envs.physics.worker"


def belonging(mark: str, session: int) -> list[str]:
    """Living processes of a session or with a mark, with the beginning of their command lines."""
    found, wanted = [], f"{MARK}={mark}".encode()
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            state, _, _, its = (entry / "stat").read_text().rsplit(")", 1)[1].split()[:4]
            if int(its) != session and wanted not in (entry / "environ").read_bytes().split(b"\0"):
                continue
            line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue  # it ended while we looked
        if state != "Z":
            found.append(f"{entry.name} {line[:80]}")
    return found


def nothing_left(
    mark: str, session: int, failure: Callable[[str], Exception], patience: float = 30.0
) -> None:
    """Wait until none of them lives, for as long as what was told to end may take.

    Raises:
        Exception: what `failure` makes of it, if some stay.
    """
    deadline = time.monotonic() + patience
    while left := belonging(mark, session):
        if time.monotonic() > deadline:
            raise failure(f"processes outlive it: {left[:5]}")
        time.sleep(0.1)


def kill_worker(mark: str, session: int, chance: random.Random) -> bool:
    """Kill one of the workers of a life that can be replaced: a physics process, a host or an evaluator on
    Ray; returns whether there was one.
    """
    workers = [
        line
        for line in belonging(mark, session)
        if _PHYSICS in line or ("ray::" in line and "Agent" not in line)
    ]
    if not workers:
        return False
    worker = chance.choice(workers)
    with suppress(ProcessLookupError):  # it ended while we chose
        # Physics leads a session of its own. A library of MuJoCo's asks a child for the version of another
        # one; outliving who asked, it would tell a traceback that is nobody's.
        (os.killpg if _PHYSICS in worker else os.kill)(int(worker.split()[0]), signal.SIGKILL)
    return True
