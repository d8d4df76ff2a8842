"""worldloop verify: every file of a run against the hashes that its stages left."""

from __future__ import annotations

import re
from pathlib import Path

from tqdm import tqdm

from envs.manifest import DamagedArtefact, check, check_whole, read_manifest
from envs.targets import ConfigError

_PLACES = ("stages", "finetune")  # of a run's folder, in which stages leave theirs
_ARTEFACT = re.compile(r".+-[0-9a-f]{12}")  # a stage and its key


def verify_run(root: Path) -> str:
    """What was found, in a line.

    Raises:
        ConfigError: if the folder holds no stages.
        DamagedArtefact: naming everything that has changed.
    """
    folders = sorted(
        path for place in _PLACES for path in (root / place).glob("*") if _ARTEFACT.fullmatch(path.name)
    )
    if not folders:
        raise ConfigError(f"{root} holds no stages; say a run's folder, such as runs/quickstart")
    wrong, files, unfinished = [], 0, 0
    for folder in tqdm(folders, desc="verify", unit="stage", dynamic_ncols=True):
        try:
            manifest = read_manifest(folder)
            if manifest is None:
                unfinished += 1
                check_whole(folder)
                continue
            check(folder, manifest)
            files += len(manifest.get("files", {}))
        except DamagedArtefact as error:
            wrong.append(str(error))
    if wrong:
        raise DamagedArtefact("\n".join(wrong))
    half = f", {unfinished} unfinished" if unfinished else ""
    return f"{len(folders) - unfinished} stages of {root}: {files} files are what they were{half}"
