"""The stage graph: a stage is keyed by its config and its parents, run once, reused for ever, resumed when
cut short.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from pipeline.artefact import finish, read_manifest, write_text


@dataclass
class Stage:
    """One node.

    Args:
        name: unique in the graph; rounds add a number, as in vision-2.
        parents: names of the stages whose folders it reads.
        config: all it depends on besides its parents; equal configs and parents give equal keys.
        run: (folder, folders of the parents) -> result for the manifest.
    """

    name: str
    parents: tuple[str, ...]
    config: Mapping[str, Any]
    run: Callable[[Path, dict[str, Path]], Mapping[str, Any]]


@dataclass
class Graph:
    """Stages in the order they were added, which must be one in which parents come first.

    Args:
        root: folder that holds the stages' folders.
    """

    root: Path
    stages: dict[str, Stage] = field(default_factory=dict, init=False)
    _keys: dict[str, str] = field(default_factory=dict, init=False, repr=False)

    def add(self, stage: Stage) -> str:
        """Add a stage and return its name."""
        if stage.name in self.stages:
            raise ValueError(f"stage {stage.name} exists already")
        unknown = [parent for parent in stage.parents if parent not in self.stages]
        if unknown:
            raise ValueError(f"stage {stage.name} comes before its parents {unknown}")
        # Worked out once: by way of all its parents again, the ways through a graph multiply with every
        # round.
        text = json.dumps(
            [stage.name, stage.config, [self.key(parent) for parent in stage.parents]],
            sort_keys=True,
            default=str,
        )
        self.stages[stage.name], self._keys[stage.name] = (
            stage,
            hashlib.sha256(text.encode()).hexdigest()[:12],
        )
        return stage.name

    def key(self, name: str) -> str:
        """Hash of the stage's config, as it was when the stage was added, and of its ancestors' keys."""
        return self._keys[name]

    def folder(self, name: str) -> Path:
        """Where the stage's artefact lies or will lie."""
        return self.root / f"{name}-{self.key(name)}"

    def run(self, until: str | None = None) -> dict[str, dict[str, Any]]:
        """Run what is unfinished, in order; returns every stage's manifest.

        Args:
            until: stop after this stage and run only what it needs.

        Raises:
            KeyError: if `until` is not a stage.
        """
        wanted = set(self.stages) if until is None else self._needs(until)
        manifests = {}
        for name, stage in self.stages.items():
            if name not in wanted:
                continue
            folder = self.folder(name)
            manifest = read_manifest(folder)
            if manifest is None:
                folder.mkdir(parents=True, exist_ok=True)
                resumed = any(folder.iterdir())
                tqdm.write(f"=== {name}{' (resumed)' if resumed else ''} -> {folder}")
                spent = folder / "seconds.json"  # what earlier, interrupted attempts took
                earlier = json.loads(spent.read_text()) if spent.exists() else 0.0
                began = time.perf_counter()
                try:
                    result = stage.run(folder, {parent: self.folder(parent) for parent in stage.parents})
                except BaseException:
                    with contextlib.suppress(OSError):  # a full disk must not hide what went wrong
                        write_text(spent, json.dumps(earlier + time.perf_counter() - began))
                    raise
                seconds = earlier + time.perf_counter() - began
                spent.unlink(missing_ok=True)
                finish(
                    folder,
                    name,
                    self.key(name),
                    stage.config,
                    {p: self.key(p) for p in stage.parents},
                    seconds,
                    result,
                )
                manifest = read_manifest(folder)
                assert manifest is not None
                tqdm.write(f"    {name} took {seconds:.0f} s {_brief(manifest['result'])}")
            else:
                tqdm.write(f"=== {name} is finished, reused from {folder}")
            manifests[name] = manifest
        return manifests

    def _needs(self, name: str) -> set[str]:
        if name not in self.stages:
            raise KeyError(f"no stage {name}; this graph has {list(self.stages)}")
        out = {name}
        for earlier in reversed(self.stages):  # parents come first, so that every child was met before
            if earlier in out:
                out.update(self.stages[earlier].parents)
        return out


def _brief(result: Mapping[str, Any]) -> str:
    parts = [
        f"{key}={value:.3g}" if isinstance(value, float) else f"{key}={value}"
        for key, value in result.items()
        if isinstance(value, (int, float, str)) and not isinstance(value, bool)
    ]
    return ", ".join(parts[:6])
