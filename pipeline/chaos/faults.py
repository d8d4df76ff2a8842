"""Faults of a disk, at a chosen moment of a process: it is killed, or the disk is full, at its n-th write.

Python tells audit hooks of every file that is opened, renamed, made or removed, before it is done; what a
library writes by itself is met at the next of these.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal


class Killed(BaseException):
    """Stands for SIGKILL within a process: nothing on the disk can be changed any more."""


@dataclass
class Fault:
    """A fault that waits for its moment.

    Args:
        folder: writes elsewhere are not counted, and succeed.
        after: writes that still succeed.
        kind: "kill" lets nothing be changed any more, "full" nothing be added.
        tripped: whether the moment has come.
    """

    folder: str
    after: int
    kind: Literal["kill", "full"]
    tripped: bool = False

    def meet(self, path: str, removes: bool) -> None:
        """A write is about to happen."""
        if not path.startswith(self.folder) or (removes and self.kind == "full"):
            return
        self.after -= 1
        if self.after >= 0:
            return
        self.tripped = True
        if self.kind == "kill":
            raise Killed(path)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)


_waiting: list[Fault] = []
_hooked = False


@contextmanager
def faulty_disk(folder: Path, after: int, kind: Literal["kill", "full"]) -> Iterator[Fault]:
    """Within, the disk under a folder fails after so many writes, and goes on failing."""
    global _hooked
    if not _hooked:
        sys.addaudithook(_hear)
        _hooked = True
    fault = Fault(str(folder.resolve()), after, kind)
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
