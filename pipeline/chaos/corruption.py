"""What a bad disk, a bad copy or a careless hand does to the files of a run."""

from __future__ import annotations

import random
from pathlib import Path

from envs.manifest import MANIFEST, read_manifest, whole_files


def spoil(stages: Path, chance: random.Random) -> tuple[Path, str] | None:
    """Spoil one file of a finished stage, of a checkpoint, or a whole one of a stage that is not finished.

    Returns:
        The folder whose removal is the fix, and what was done in words; None if there is nothing to spoil.
    """
    places = []
    for stage in sorted(stages.glob("*")):
        if (manifest := read_manifest(stage)) is not None:
            # checkpoints that a killed process left beside its manifest are removed, not read
            places.append((stage, [stage / name for name in (MANIFEST, *manifest["files"])]))
            continue
        places += [(checkpoint, _files(checkpoint)) for checkpoint in sorted(stage.rglob("checkpoint-*"))]
        if whole := [stage / name for name in sorted(whole_files(stage))]:
            places.append((stage, whole))
    if not places:
        return None
    folder, files = chance.choice(places)
    # what is gone with its manifest is unfinished work, and made again without a word
    path = chance.choice(files)
    ways = ["flip", "cut", "grow"] if path.name == MANIFEST else ["flip", "cut", "grow", "remove"]
    way, content = chance.choice(ways), path.read_bytes()
    if way == "remove":
        path.unlink()
    elif way == "grow" or not content:
        path.write_bytes(content + b"\0")
    elif way == "cut":
        path.write_bytes(content[: chance.randrange(len(content))])
    else:
        at = chance.randrange(len(content))
        path.write_bytes(content[:at] + bytes([content[at] ^ 1 << chance.randrange(8)]) + content[at + 1 :])
    return folder, f"{way} of {path}"


def _files(folder: Path) -> list[Path]:
    """All files of a folder that are not hidden."""
    return sorted(
        path
        for path in folder.rglob("*")
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )
