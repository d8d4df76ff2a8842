"""Files that are either whole or not there: written beside their place and renamed into it.

A process killed at any moment, or a full disk, leaves the previous file as it was.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A neighbour of `path` to write a file or a folder to; it takes the path's place when the block ends.

    Folders above are made. A folder that stands at `path` is removed first.

    Raises:
        OSError: if it cannot be written, naming the path and the fix; what stood there is kept.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        remove(part)
        yield part
        if part.is_dir() and path.is_dir():
            shutil.rmtree(path)
        os.replace(part, path)
    except OSError as error:
        with suppress(OSError):
            remove(part)
        reason = error.strerror or str(error)
        raise OSError(
            error.errno,
            f"cannot write {path}: {reason}; free disk space or make the folder writable, and start again:"
            " finished work is kept",
        ) from error
    except BaseException:
        remove(part)
        raise


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file by `write`, which is called with the neighbour's path; see `atomic`."""
    with atomic(path) as part:
        write(part)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all; see `atomic`."""
    with atomic(path) as part:
        part.write_text(text)


def write_json(path: Path, value: Any) -> None:
    """Write what JSON can hold, and numbers of NumPy and torch, whole or not at all; see `atomic`.

    Raises:
        ValueError: for NaN and infinite numbers, which JSON does not know: what is not there is None.
    """
    write_text(path, json.dumps(value, indent=2, allow_nan=False, default=float) + "\n")


def new_neighbour(path: Path) -> Path:
    """An empty folder beside `path` that no other process has; folders above are made. See `put`.

    Raises:
        OSError: if nothing can be written there.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    return Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))


def put(part: Path, path: Path, stands: Callable[[], bool]) -> None:
    """Rename a finished neighbour to `path`, where other processes may put theirs at the same time.

    Whoever has files of an older folder there mapped keeps them until he lets go.

    Args:
        stands: whether what stands at `path` will do; then the neighbour is left as it is.
    """
    for _ in range(3):
        try:
            part.rename(path)
            return
        except OSError:
            if stands():  # another process was faster
                return
            shutil.rmtree(path, ignore_errors=True)
    part.rename(path)


def files_below(folder: Path, above: tuple[Path, ...] = ()) -> Iterator[Path]:
    """The files of a folder and of those in it, in the order of their paths; links are followed, but not back
    into the folders that they stand in. None where there is no folder.

    Args:
        above: real paths of the folders that this one is in.
    """
    real = folder.resolve()
    if real in above or not real.is_dir():
        return
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            yield from files_below(path, (*above, real))
        elif path.is_file():
            yield path


def remove(path: Path) -> None:
    """Remove a file or a folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def named_files(name: str) -> list[Path]:
    """The file of this name, or the files that lie directly in that folder; hidden ones are no part of it.

    [] for a text that names nothing.
    """
    path = Path(name)
    try:
        if name and path.is_dir():
            inside = sorted(path.iterdir())
            return [one for one in inside if one.is_file() and not one.name.startswith(".")]
        return [path] if path.is_file() else []
    except (OSError, ValueError):  # too long for a name, or a folder of somebody else's
        return []
