"""What a finished folder says of itself: manifest.json, with a hash of every file beside it.

Whoever opens such a file, on whatever machine, first sees whether it is still what its stage left there.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from envs.files import remove, write_json, write_text

MANIFEST = "manifest.json"
_WHOLE = ".whole.json"  # of an unfinished folder: hashes of what is whole in it


class DamagedArtefact(RuntimeError):
    """Files of a finished stage are not what they were when it ended; the message names them and the fix."""


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The manifest of a finished artefact, or None.

    Raises:
        DamagedArtefact: if it cannot be read.
    """
    path = folder / MANIFEST
    if not path.exists():
        return None
    try:
        manifest = dict(json.loads(path.read_text()))
    except (ValueError, TypeError):
        _refuse(folder, [MANIFEST])
    whole = {"stage", "result"} <= manifest.keys()
    if not whole or (manifest.keys() & {"files", "seal"} and manifest.get("seal") != _seal(manifest)):
        _refuse(folder, [MANIFEST])
    return manifest


def write_manifest(folder: Path, manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Write a manifest with the hashes of what lies beside it, and its own; returns it.

    Raises:
        DamagedArtefact: if a file has changed since it was whole.
    """
    check_whole(folder)
    plain = json.loads(json.dumps({**manifest, "files": hashes(folder)}, default=float))
    plain["seal"] = _seal(plain)
    write_text(folder / MANIFEST, json.dumps(plain, indent=1))
    remove(folder / _WHOLE)
    return dict(plain)


def keep_whole(folder: Path, files: Iterable[Path]) -> None:
    """Remember the hashes of files that are whole long before their stage ends; of those already remembered
    nothing is read.
    """
    known = whole_files(folder)
    new = {path.relative_to(folder).as_posix(): path for path in files}
    new = {name: path for name, path in new.items() if name not in known}
    if new:
        write_json(folder / _WHOLE, {**known, **{name: digest_of(path) for name, path in new.items()}})


def whole_files(folder: Path) -> dict[str, str]:
    """Hashes, by path, of those files of an unfinished artefact that are whole.

    Raises:
        DamagedArtefact: if the list cannot be read.
    """
    path = folder / _WHOLE
    if not path.exists():
        return {}
    try:
        return dict(json.loads(path.read_text()))
    except (ValueError, TypeError):
        _refuse(folder, [_WHOLE])


def check_whole(folder: Path) -> None:
    """See that those files of an unfinished artefact that are whole are what they were.

    Raises:
        DamagedArtefact: if one has changed or is missing.
    """
    check(folder, {"files": whole_files(folder)})


def _seal(manifest: Mapping[str, Any]) -> str:
    """A hash of the manifest itself."""
    held = {key: value for key, value in manifest.items() if key != "seal"}
    return hashlib.sha256(json.dumps(held, sort_keys=True).encode()).hexdigest()


def digest_of(path: Path) -> str:
    """SHA-256 of a file."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            found.update(part)
    return found.hexdigest()


def mark_of(path: Path) -> str:
    """What tells a file, such as weights, from others: the key of the stage that left it, else its hash; ""
    where there is no file.
    """
    manifest = read_manifest(path.parent) or {}
    return str(manifest.get("key") or (digest_of(path) if path.is_file() else ""))


def hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a folder by its path, but for the manifest, what is hidden (caches), and
    checkpoints, which are removed after it.
    """
    out = {}
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder)
        passing = any(part.startswith((".", "checkpoint-")) for part in inside.parts)
        if path.is_file() and inside.name != MANIFEST and not passing:
            out[inside.as_posix()] = digest_of(path)
    return out


def check(folder: Path, manifest: Mapping[str, Any], under: str = "") -> None:
    """See that a finished artefact is what it was.

    Args:
        folder: the artefact.
        manifest: what it says of itself.
        under: path within it; only that file, or what lies in that folder, is read.

    Raises:
        DamagedArtefact: if a file has changed or is missing.
    """
    changed = []
    for name, value in manifest.get("files", {}).items():
        if under and name != under and not name.startswith(f"{under}/"):
            continue
        path = folder / name
        if not path.is_file():
            changed.append(f"{name} (missing)")
        elif digest_of(path) != value:
            changed.append(name)
    if changed:
        _refuse(folder, changed)


@functools.cache
def check_part(path: Path) -> None:
    """The same for a file or folder that lies directly in an artefact, once in a process; what is part of
    none passes.

    Raises:
        DamagedArtefact: if a file has changed or is missing.
    """
    manifest = read_manifest(path.parent)
    if manifest is not None:
        check(path.parent, manifest, path.name)


def _refuse(folder: Path, names: list[str]) -> NoReturn:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    raise DamagedArtefact(
        f"{folder} is not what its stage left there: {', '.join(names[:5])}{more}. Bring the files back, or"
        " delete the folder: the same command then makes it anew"
    )
