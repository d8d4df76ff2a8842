"""What was measured once, by what it depends on, so that studies go on where they were stopped."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from safetensors.torch import load_file, save_file
from torch import Tensor

from envs.files import atomic
from pipeline.graph.code_version import json_digest

Tensors = dict[str, Tensor]
_ODD = r"[^\w.+-]+"  # in names of files


class Kept:
    """Files of tensors by what they depend on.

    Args:
        folder: made if it is not there.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self._left: dict[Path, bool] = {}  # of each file that was asked for, whether it was there by then

    @property
    def reused(self) -> int:
        """How many files were asked for that had been there before, each counted once."""
        return sum(self._left.values())

    def get(self, name: str, identity: Mapping[str, Any], make: Callable[[], Tensors]) -> Tensors:
        """What `make` gave for this identity, now or at some earlier time."""
        key = json_digest(identity)
        path = self.folder / f"{re.sub(_ODD, '_', name)}-{key}.safetensors"
        there = path.exists()
        self._left.setdefault(path, there)
        if there:
            return load_file(path)
        made = make()
        with atomic(path) as part:
            save_file({field: value.contiguous() for field, value in made.items()}, part)
        return made
