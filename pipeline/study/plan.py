"""The plan of a study: its rows, each a config and a way to a policy or a world, and what is measured of
them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from actors.world_config import check_world
from envs.targets import ConfigError, build, options
from pipeline.cli.words import root_of, without_given
from pipeline.config import load_config
from pipeline.loop import has_physics
from pipeline.sections.measuring import RowSection
from pipeline.study.columns import Column, Measured
from pipeline.study.methods import Made, Method

Cfg = Mapping[str, Any]


@dataclass(frozen=True)
class Row:
    """One way to a policy or a world, in one place with one seed.

    Args:
        name, title: in the config, and in the table.
        place: of study.across; "" where there is none.
        cfg: resolved.
        made: what it is about, and its graph.
        nodes: the stages behind each column, by the column's name.
        note: what must be known to compare it with other rows; "" for nothing.
    """

    name: str
    title: str
    place: str
    cfg: Cfg
    made: Made
    nodes: Mapping[str, Sequence[str]]
    note: str

    @property
    def seed(self) -> int:
        """Of everything but the evaluation, whose seeds are the same for all rows."""
        return int(self.cfg["seed"])

    @property
    def key(self) -> tuple[str, str]:
        """What seeds have in common: name and place."""
        return self.name, self.place

    def finished(self, column: str) -> bool:
        """Whether a column has been measured."""
        return all(self.made.graph.finished(node) for node in self.nodes[column])


@dataclass(frozen=True)
class Study:
    """Rows and columns.

    Args:
        cfg: of the study, resolved.
        root: its folder.
        rows: in the order in which they are run: seed by seed, place by place.
        columns: by name.
        only: names of the rows that are run now; the others are shown as they stand.
        against: names of the rows with which all others are compared.
    """

    cfg: Cfg
    root: Path
    rows: Sequence[Row]
    columns: Mapping[str, Column]
    only: Sequence[str]
    against: Sequence[str]

    def read(self, row: Row, column: str) -> Measured | None:
        """What a column found of a row, None if it was not run."""
        if not row.finished(column):
            return None
        folders = [row.made.graph.folder(node) for node in row.nodes[column]]
        return self.columns[column].read(row.cfg, folders)

    def missing(self) -> list[tuple[Row, str]]:
        """Rows and columns that are still to be run, in their order."""
        return [
            (row, column)
            for row in self.rows
            for column in self.columns
            if row.name in self.only and not row.finished(column)
        ]

    def seconds_left(self) -> tuple[float, int]:
        """Seconds that the missing cells will take, by what stages of the same kind took in this study, and
        how many stages are of a kind that is not known yet.
        """
        known: dict[str, list[float]] = {}
        for row in self.rows:
            graph = row.made.graph
            for name in graph.nodes:
                if graph.finished(name):
                    known.setdefault(_kind(name), []).append(graph.manifest(name)["seconds"])
        waiting = {
            graph.folder(name): _kind(name)
            for graph, nodes in ((row.made.graph, row.nodes[column]) for row, column in self.missing())
            for name in graph.needs(nodes)
            if not graph.finished(name)
        }
        guesses = [sum(known[kind]) / len(known[kind]) for kind in waiting.values() if kind in known]
        return sum(guesses), len(waiting) - len(guesses)


def plan_study(words: Sequence[str]) -> Study:
    """The study of a config.

    Args:
        words: overrides of the command line.

    Raises:
        ConfigError: naming the key of the study that cannot work, or the row whose config cannot.
    """
    if given := [word for word in words if word.split("=")[0] == "seed"]:
        raise ConfigError(f"{given[0]}: a study has several; say study.seeds=[{given[0].partition('=')[2]}]")
    cfg = load_config(words)
    section = cfg["study"]
    if not has_physics(cfg):
        raise ConfigError("a study measures in physics, which this task has not (task.suite is empty)")
    columns = {
        name: build(section["measures"][name], f"study.measures.{name}") for name in section["columns"]
    }
    sections = {
        name: options(RowSection, section["methods"][name], f"study.methods.{name}")
        for name in section["rows"]
    }
    places = {name: section["across"][name] for name in section["places"]} or {"": ()}
    configs = {
        (name, place): _config_of(name, place, [*without_given(changes, row.changes), *row.changes], words)
        for place, changes in places.items()
        for name, row in sections.items()
    }
    rows = [
        _row(name, row, place, {**configs[name, place], "seed": seed}, columns)
        for number, seed in enumerate(section["seeds"])
        for place in places
        for name, row in sections.items()
        if not row.seeds or number < row.seeds
    ]
    return Study(cfg, root_of(cfg), rows, columns, section["only"] or section["rows"], section["against"])


def _config_of(name: str, place: str, changes: Sequence[str], words: Sequence[str]) -> Cfg:
    """The resolved config of a row in a place.

    Raises:
        ConfigError: naming the row, if its changes cannot work.
    """
    try:
        cfg = load_config([*without_given(words, changes), *changes])
        check_world(cfg)
    except ConfigError as error:
        there = f" in study.across.{place}" if place else ""
        raise ConfigError(f"study.methods.{name}.changes={list(changes)}{there}: {error}") from error
    return cfg


def _row(name: str, section: RowSection, place: str, cfg: Cfg, columns: Mapping[str, Column]) -> Row:
    method = build(section.policy, f"study.methods.{name}.policy")
    if not isinstance(method, Method):
        raise ConfigError(
            f"study.methods.{name}.policy._target_ makes a {type(method).__name__}, which is no"
            " pipeline.study.methods.Method"
        )
    made = method.make(cfg, root_of(cfg))
    nodes = {}
    for key, column in columns.items():
        try:
            nodes[key] = column.add(cfg, made)
        except ConfigError as error:
            raise ConfigError(f"study.measures.{key} in the row {name}: {error}") from error
    title = f"{section.title}, {place}" if place else section.title
    return Row(name, title, place, cfg, made, nodes, method.note(cfg))


def _kind(name: str) -> str:
    """What stages of several rounds have in common: simulator of simulator-2."""
    return "-".join(part for part in name.split("-") if not part.isdigit())
