"""What a stage is: a function, the config sections it may read, and where it runs."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

from pipeline.graph.view import ConfigView

Result = Mapping[str, Any]
WEIGHTS = "weights.safetensors"  # of a stage that has trained something


class Place(Enum):
    """Where a stage runs.

    DRIVER: in the process of the command line. LEARNERS: in launch.learners processes that train together.
    EVALUATOR: with launch.place.evaluator's resources, on Ray launches.
    """

    DRIVER = "driver"
    LEARNERS = "learners"
    EVALUATOR = "evaluator"


@dataclass(frozen=True)
class Inputs:
    """Folders of the stages that a stage builds on, by the role they play for it.

    Args:
        found: a folder or folders per role; a role that nobody plays is absent.
        settings: what tells this node from others of the same stage, such as the round's number.
    """

    found: Mapping[str, Path | tuple[Path, ...]] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)

    def folder(self, role: str) -> Path:
        """The folder of the one stage that plays a role."""
        folder = self.found[role]
        assert isinstance(folder, Path), f"{role} are several folders"
        return folder

    def folders(self, role: str) -> tuple[Path, ...]:
        """The folders of the stages that play a role together, none if nobody does."""
        folders = self.found.get(role, ())
        return (folders,) if isinstance(folders, Path) else folders

    def weights(self, role: str) -> Path | None:
        """The weights that the stage of a role left, None if nobody plays it."""
        return self.folder(role) / WEIGHTS if role in self.found else None


@dataclass(frozen=True)
class Stage:
    """A kind of node of the graph.

    Args:
        run: (config view, own folder, inputs) -> result for the manifest, plain numbers and texts.
        reads: dotted paths of the config that `run` may read; {phase} and the like stand for settings.
        place: where it runs.
    """

    run: Callable[[ConfigView, Path, Inputs], Result]
    reads: tuple[str, ...]
    place: Place = Place.DRIVER

    @property
    def path(self) -> str:
        """Where other processes find it: module:name."""
        return f"{self.run.__module__}:{self.run.__name__}"

    def reads_of(self, settings: Mapping[str, Any]) -> tuple[str, ...]:
        """The config paths of a node with these settings."""
        return tuple(path.format(**settings) for path in self.reads)

    def view(self, name: str, config: Mapping[str, Any], settings: Mapping[str, Any]) -> ConfigView:
        """The part of the config that a node of this stage is handed."""
        return ConfigView(config, self.reads_of(settings), name)


def stage(
    reads: tuple[str, ...], place: Place = Place.DRIVER
) -> Callable[[Callable[[ConfigView, Path, Inputs], Result]], Stage]:
    """Make a function a Stage."""
    return lambda run: Stage(run, reads, place)


def find_stage(path: str) -> Stage:
    """The stage at Stage.path."""
    module, _, name = path.partition(":")
    found = getattr(importlib.import_module(module), name)
    assert isinstance(found, Stage)
    return found
