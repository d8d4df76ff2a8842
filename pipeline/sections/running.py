"""Sections of how it is run: where, tracked by what, disturbed how; and keys that stand by themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, MinLen

from envs.ranges import Count, Natural, NonNegative, Positive, Seed
from pipeline.sections.kinds import Name


@dataclass(frozen=True)
class ChaosSection:
    """Section chaos."""

    events: Natural
    patience: Positive
    seconds: NonNegative
    every: Positive
    learner_every: Positive
    actors: Count


@dataclass(frozen=True)
class TrackSection:
    """Section track."""

    wandb: Literal["offline", "online", "disabled"]
    project: Name


@dataclass(frozen=True)
class LocalSection:
    """Section launch, everything in one process."""

    backend: Literal["local"]
    device: Annotated[str, MinLen(1)]
    compile: Literal["blocks", "graphs"] | None
    workers: Natural


@dataclass(frozen=True)
class RaySection:
    """Section launch, on Ray."""

    backend: Literal["ray"]
    device: Annotated[str, MinLen(1)]
    compile: Literal["blocks", "graphs"] | None
    workers: Natural
    address: Name
    cpus: Natural
    object_store_mb: Annotated[int, Ge(80)]
    actors: Count
    learners: Count
    strategy: Literal["collocated", "disaggregated", "hybrid"]
    place: Mapping[str, Mapping[Literal["num_cpus", "num_gpus"], NonNegative]]
    judge_service: bool
    service: Mapping[str, Any]
    patience: Mapping[str, Any]


@dataclass(frozen=True)
class Top:
    """Keys that stand by themselves."""

    name: Name
    seed: Seed
    threads: Count
    runs: Name
    cameras: Literal["all", "main"] | Annotated[Sequence[str], MinLen(1)]
    starts: Literal["all", "inner", "outer"]
    microbatches: Count
