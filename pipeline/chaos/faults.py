"""Faults at a chosen moment of a process: it is killed, or its disk is full, at its n-th write.

Python tells audit hooks of every file that is opened, renamed, made or removed, before it is done; what a
library writes by itself is met at the next of these.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

Kind = Literal["stop", "die", "full"]


class Stopped(BaseException):
    """Stands for SIGKILL within a process that lives on: nothing on the disk can be changed any more."""


@dataclass
class Fault:
    """A fault that waits for its moment.

    Args:
        folder: writes elsewhere are not counted, and succeed.
        after: writes that still succeed.
        kind: "stop" lets nothing be changed any more, "die" is SIGKILL, "full" lets nothing be added.
        since: writes are counted from the first one below this path on.
        tripped: whether the moment has come.
    """

    folder: Path
    after: int
    kind: Kind
    since: Path | None = None
    tripped: bool = False

    def meet(self, path: str, removes: bool) -> None:
        """A write is about to happen."""
        if not path.startswith(str(self.folder)) or (removes and self.kind == "full"):
            return
        if self.since is not None and not path.startswith(str(self.since)):
            return
        self.since = None
        self.after -= 1
        if self.after >= 0:
            return
        self.tripped = True
        if self.kind == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.kind == "stop":
            raise Stopped(path)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)


_waiting: list[Fault] = []
_hooked = False


@contextmanager
def faulty(fault: Fault) -> Iterator[Fault]:
    """Within, the fault waits for its moment; once that has come, it stays."""
    global _hooked
    if not _hooked:
        sys.addaudithook(_hear)
        _hooked = True
    _waiting.append(fault)
    try:
        yield fault
    finally:
        _waiting.remove(fault)


def _hear(event: str, words: tuple[Any, ...]) -> None:
    if not _waiting or event not in ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir"):
        return
    path = words[1] if event == "os.rename" else words[0]
    if not isinstance(path, (str, os.PathLike)):
        return
    if event == "open" and not _writes(words[1], words[2]):
        return
    for fault in list(_waiting):
        fault.meet(os.fspath(path), event in ("os.remove", "os.rmdir"))


def _writes(mode: str | None, flags: int | None) -> bool:
    if mode is not None:
        return any(letter in mode for letter in "wax+")
    return bool((flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
