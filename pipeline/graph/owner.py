"""One run, one owner: whoever writes into a run's folder, or a data set's, holds its lock.

The system lets go of the lock when its holder ends, however that happens, on network file systems too where
they know `flock`; elsewhere a lock file with the holder's process number stands in for it (filelock).
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from envs.files import remove, write_json

_LOCK, _HOLDER = ".lock", ".owner.json"


class RunInUse(RuntimeError):
    """Another process works in the run's folder; the message says which and since when."""


@contextmanager
def owning(
    root: Path, command: str, otherwise: str = "say name=<another>", passing: bool = False
) -> Iterator[None]:
    """Hold a run for the length of the block.

    Args:
        root: the run's folder, made if it is not there.
        command: what for; it is told to whoever comes meanwhile.
        otherwise: what he may do instead of waiting.
        passing: leave no lock file in the folder. Two may then hold it one right after the other in the
            belief to be the first, so whoever does looks what lies there once he has it.

    Raises:
        RunInUse: if another process holds it.
        OSError: if the folder cannot be written.
    """
    root.mkdir(parents=True, exist_ok=True)
    lock = FileLock(root / _LOCK, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise RunInUse(f"{_described(root)}; wait for its end or stop it, or {otherwise}") from error
    try:
        since = datetime.now().astimezone().isoformat(timespec="seconds")
        mine = {"host": socket.gethostname(), "pid": os.getpid(), "command": command, "since": since}
        write_json(root / _HOLDER, mine)
        yield
    finally:
        with suppress(OSError):
            remove(root / _HOLDER)
            if passing:
                remove(root / _LOCK)
        lock.release()


def held_files(root: Path) -> set[Path]:
    """What an owner keeps in the folder while he has it."""
    return {root / _LOCK, root / _HOLDER}


def _described(root: Path) -> str:
    """Who holds a run, in words."""
    try:
        holder: dict[str, Any] = json.loads((root / _HOLDER).read_text())
        return (
            f"{root} belongs to `worldloop {holder['command']}`, process {holder['pid']} on {holder['host']},"
            f" since {holder['since']}"
        )
    except (OSError, ValueError, KeyError):  # it has just begun, or has just ended
        return f"{root} belongs to another process"
