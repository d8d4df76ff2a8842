"""Sections of what measures: evaluations, studies, values of policies, fidelity, EWMBench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from annotated_types import Ge, MinLen, MultipleOf

from envs.ranges import Count, Natural, NonNegative, Positive, Seed, Share
from pipeline.sections.kinds import Choice, Fit, Name


@dataclass(frozen=True)
class EvaluateSection:
    """Section evaluate."""

    episodes: Count
    envs: Count
    imagined: Count


@dataclass(frozen=True)
class ControlsSection:
    """Section controls."""

    only: Sequence[
        Literal["without_rl", "without_imagined", "rl_equal_episodes", "rl_equal_steps", "filtered_bc"]
    ]


@dataclass(frozen=True)
class MeasureSection:
    """Section measure."""

    videos: Natural
    worst: Natural
    starts: Count
    speed_chunks: Count


@dataclass(frozen=True)
class StudySection:
    """Section study."""

    rows: Annotated[Sequence[Name], MinLen(1)]
    columns: Annotated[Sequence[Name], MinLen(1)]
    seeds: Annotated[Sequence[Seed], MinLen(1)]
    places: Sequence[Name]
    across: Mapping[Name, Sequence[Name]]
    against: Sequence[Name]
    only: Sequence[Name]
    minutes: NonNegative | None
    methods: Mapping[str, Mapping[str, Any]]
    measures: Mapping[str, Choice]


@dataclass(frozen=True)
class RowSection:
    """A section of study.methods."""

    title: Name
    changes: Sequence[Name]
    seeds: Natural
    policy: Choice


@dataclass(frozen=True)
class ImaginedSection:
    """Section imagined."""

    simulator: Name | None
    state: Name | None
    judge: Name | None
    data: Sequence[str]


@dataclass(frozen=True)
class PolicyValueSection:
    """Section policy_value."""

    policies: Sequence[Name]
    others: Mapping[Name, Choice] | None
    noise: Sequence[Positive]
    experts: Sequence[Share]
    judged: Literal["chunks", "whole"]
    starts: Annotated[int, Ge(2)]
    repeats: Count
    stochastic: bool


@dataclass(frozen=True)
class LongSection:
    """Section fidelity.long."""

    frames: Natural
    episodes: Count
    noise_level: Share


@dataclass(frozen=True)
class FidelitySection:
    """Section fidelity."""

    episodes: Count
    masks: Name | None
    clip: Annotated[int, Ge(2)]
    frames_extractor: Choice
    clips_extractor: Choice
    long: Mapping[str, Any]
    end_effectors: bool
    strides: Annotated[tuple[Count, ...], MinLen(1)]
    grid: Mapping[Name, Annotated[Sequence[Any], MinLen(1)]] | None


@dataclass(frozen=True)
class EwmbenchSection:
    """Section ewmbench."""

    episodes: Count
    voxel: Positive
    samples: Count
    cameras: str | Sequence[Name]
    strict_parity: bool
    patches: Choice
    frames: Choice
    texts: Choice
    detector: Mapping[str, Any]
    prompts: Mapping[str, Any]
    videos: Natural


@dataclass(frozen=True)
class DetectorSection:
    """Section ewmbench.detector."""

    weights: Name | None
    width: Annotated[int, Ge(8), MultipleOf(8)]
    side: Annotated[int, Ge(16)]
    fit: Fit


@dataclass(frozen=True)
class PromptsSection:
    """Section ewmbench.prompts."""

    caption: Name
    steps: Name
    logic: Name
    errors: Name


@dataclass(frozen=True)
class SweepSection:
    """Section sweep."""

    episode: Natural
    levels: Annotated[Sequence[float], MinLen(1)]
    chunks: Count
    pictures: Annotated[int, Ge(2)]
