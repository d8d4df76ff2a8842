"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file through a temporary neighbour and rename it into place.

    Args:
        path: the file; its folder is made.
        write: called with the neighbour's path.

    Raises:
        OSError: naming the file, for instance when the disk is full; an older file of that name is intact.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part")
    try:
        write(temporary)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OSError(error.errno, f"cannot write {path}: {error.strerror}", str(path)) from error
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
