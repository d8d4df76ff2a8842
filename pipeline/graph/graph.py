"""The stage graph: a node is keyed by what it reads, its parents and its code; it runs once and is reused."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from envs.manifest import check, read_manifest
from envs.targets import target
from learners.training.checkpoint import clear_checkpoints
from pipeline.graph.artefact import Identity, finish
from pipeline.graph.clock import WorkClock
from pipeline.graph.code_version import code_of, digest
from pipeline.graph.stage import Inputs, Stage
from pipeline.graph.view import ConfigView, sections
from pipeline.graph.workers import run_stage
from pipeline.outside import option_files
from pipeline.track import NullTracker, Tracker

Names = Mapping[str, str | Sequence[str] | None]


@dataclass(frozen=True)
class Node:
    """A stage in a graph.

    Args:
        stage: what it does.
        inputs: names of the nodes that it builds on, by role.
        settings: what tells it from other nodes of the same stage.
        identity: what its key is made of.
        cfg: the resolved config that it is run with.
    """

    stage: Stage
    inputs: Mapping[str, str | tuple[str, ...]]
    settings: Mapping[str, Any]
    identity: Identity
    cfg: Mapping[str, Any]

    @property
    def parents(self) -> tuple[str, ...]:
        """Names of all nodes that it builds on, each once."""
        return tuple(self.identity.parents)


@dataclass
class Graph:
    """Nodes in the order they were added, in which parents come first.

    Args:
        cfg: the resolved config, plain containers.
        root: folder that holds the nodes' folders.
    """

    cfg: Mapping[str, Any]
    root: Path
    nodes: dict[str, Node] = field(default_factory=dict, init=False)
    _met: set[str] = field(default_factory=set, init=False)  # finished ones, checked and told

    def add(self, name: str, stage: Stage, inputs: Names | None = None, **settings: Any) -> str:
        """Add a node and return its name.

        Args:
            name: unique in the graph; rounds add a number, as in simulator-2.
            stage: what it does.
            inputs: node names by role; roles of None or () are left out.
            settings: plain values handed to the stage, part of the key.

        Raises:
            ValueError: if the name is taken, or an input is not there yet.
        """
        if name in self.nodes:
            raise ValueError(f"stage {name} exists already")
        roles = {
            role: names if isinstance(names, str) else tuple(names)
            for role, names in (inputs or {}).items()
            if names
        }
        parents = dict.fromkeys(n for names in roles.values() for n in _names(names))
        unknown = [parent for parent in parents if parent not in self.nodes]
        if unknown:
            raise ValueError(f"stage {name} comes before its inputs {unknown}")
        read = sections(self.cfg, stage.reads_of(settings))
        config = {
            path: digest(json.dumps(decisive(path, value), sort_keys=True)) for path, value in read.items()
        }
        for path, value in read.items():
            if files := option_files(path, value):
                config[f"files of {path}"] = digest(json.dumps(files, sort_keys=True))
        identity = Identity(
            stage=name,
            config=config,
            settings=settings,
            parents={parent: self.key(parent) for parent in parents},
            roles={role: list(_names(names)) for role, names in roles.items()},
            code=code_of(stage.run.__module__, read),
        )
        self.nodes[name] = Node(stage, roles, settings, identity, self.cfg)
        return name

    def under(self, cfg: Mapping[str, Any]) -> Graph:
        """The same graph, to which stages of another config can be added."""
        other = Graph(cfg, self.root)
        other.nodes = self.nodes
        return other

    def key(self, name: str) -> str:
        """Hash of the config sections that the node reads, its settings, its parents' keys and its code."""
        return self.nodes[name].identity.key

    def folder(self, name: str) -> Path:
        """Where the node's artefact lies or will lie."""
        return self.root / f"{name}-{self.key(name)}"

    def inputs(self, name: str) -> Inputs:
        """What a node's stage is handed."""
        node = self.nodes[name]
        found = {
            role: self.folder(names) if isinstance(names, str) else tuple(self.folder(n) for n in names)
            for role, names in node.inputs.items()
        }
        return Inputs(found, node.settings)

    def view(self, name: str) -> ConfigView:
        """The part of the config that a node may read."""
        node = self.nodes[name]
        return node.stage.view(name, node.cfg, node.settings)

    def finished(self, name: str) -> bool:
        """Whether the node's artefact is there."""
        return read_manifest(self.folder(name)) is not None

    def manifest(self, name: str) -> dict[str, Any]:
        """What is known of a finished node.

        Raises:
            KeyError: if it is not finished.
        """
        manifest = read_manifest(self.folder(name))
        if manifest is None:
            raise KeyError(f"stage {name} is not finished")
        return manifest

    def result(self, name: str) -> dict[str, Any]:
        """What a finished node returned.

        Raises:
            KeyError: if it is not finished.
        """
        return dict(self.manifest(name)["result"])

    def run(
        self, until: str | Sequence[str] = (), tracker: Tracker | None = None
    ) -> dict[str, dict[str, Any]]:
        """Run what is unfinished, in order; returns every node's manifest.

        Args:
            until: run only these nodes and what they need; () runs all.
            tracker: follows what nodes log while they run.

        Raises:
            KeyError: if `until` names no node.
        """
        wanted = self.needs(until) if until else set(self.nodes)
        following = tracker or NullTracker()
        return {name: self._finished(name, following) for name in self.nodes if name in wanted}

    def _finished(self, name: str, tracker: Tracker) -> dict[str, Any]:
        """The manifest of a node, after running it if need be."""
        folder = self.folder(name)
        manifest = read_manifest(folder)
        if manifest is not None and name in self._met:
            return manifest
        self._met.add(name)
        if manifest is not None:
            check(folder, manifest)
            clear_checkpoints(folder)  # of a process that was killed right after the manifest was there
            tqdm.write(f"=== {name} is finished, reused from {folder}")
            tracker.catch_up(name, folder)
            return manifest
        folder.mkdir(parents=True, exist_ok=True)
        resumed = any(folder.iterdir())
        tqdm.write(f"=== {name}{' (resumed)' if resumed else ''} -> {folder}")
        node = self.nodes[name]
        with WorkClock(folder) as clock, tracker.follow(name, folder):
            result = run_stage(node.stage, name, node.cfg, folder, self.inputs(name))
        read = sections(node.cfg, node.stage.reads_of(node.settings))
        manifest = finish(folder, node.identity, read, clock.seconds, result)
        clear_checkpoints(folder)
        tqdm.write(f"    {name} took {clock.seconds:.0f} s {_brief(manifest['result'])}")
        return manifest

    def why(self, name: str) -> str:
        """Why an unfinished node will run although an older artefact of it exists; "" if there is none."""
        older = [
            manifest
            for path in sorted(self.root.glob(f"{name}-*/manifest.json"), key=lambda p: p.stat().st_mtime)
            if (manifest := read_manifest(path.parent)) is not None and manifest["stage"] == name
        ]
        if not older or (self.folder(name) / "manifest.json").exists():
            return ""
        return self.nodes[name].identity.changed(older[-1]["identity"])

    def needs(self, until: str | Sequence[str]) -> set[str]:
        """Names of nodes and of all that they build on.

        Raises:
            KeyError: if `until` names no node.
        """
        names = _names(until)
        unknown = [name for name in names if name not in self.nodes]
        if unknown:
            raise KeyError(f"no stage {unknown[0]}; this graph has {list(self.nodes)}")
        out = set(names)
        for earlier in reversed(self.nodes):  # parents come first, so every child was met before
            if earlier in out:
                out.update(self.nodes[earlier].parents)
        return out


def _names(names: str | Sequence[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def decisive(path: str, section: Any) -> Any:
    """The part of a section that decides what comes out of whoever reads it."""
    if path != "judge" or not isinstance(section, Mapping) or "_target_" not in section:
        return section
    kind: Any = target(section, "judge")
    return kind.decisive(section) if hasattr(kind, "decisive") else section


def _brief(result: Mapping[str, Any]) -> str:
    parts = [
        f"{key}={value:.3g}" if isinstance(value, float) else f"{key}={value}"
        for key, value in result.items()
        if isinstance(value, (int, float, str)) and not isinstance(value, bool)
    ]
    return ", ".join(parts[:6])
