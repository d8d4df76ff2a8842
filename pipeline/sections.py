"""What every section of configs/ may hold: names, types and ranges.

Sections that describe an object (`_target_`) are checked against what its class says at its options; those
that become a dataclass elsewhere, against that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Lt, MinLen, MultipleOf

from envs.ranges import Count, Discount, Natural, NonNegative, Positive, Seed, Share

Side = Annotated[int, Ge(16), MultipleOf(16)]
Name = Annotated[str, MinLen(1)]
Fit = Mapping[str, Any]  # learners.training.fit.FitConfig; checked by itself
Choice = Mapping[str, Any]  # `_target_` and its options; checked by itself


@dataclass(frozen=True)
class TaskSection:
    """Section task: a suite (physics), or recordings (data).

    `variants` are options of the suite, by a name of their own, under which policies and experts are tried as
    well: other scenes, other words.
    """

    suite: Choice | None
    name: Name | Annotated[Sequence[Name], MinLen(1)]
    size: tuple[Side, Side]
    chunk: Count
    horizon: Count
    mode: Literal["relative", "absolute"]
    data: Sequence[str] | str = ()
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class WorldSection:
    """What a section simulator says of the world around an engine."""

    pose_map: Literal["auto"] | bool
    ray_map: Literal["auto"] | bool
    pose_map_style: Mapping[str, Any]
    kinematics: Mapping[str, Any] | None
    shared_noise: bool
    bf16: bool
    state_expert: Choice


@dataclass(frozen=True)
class Splits:
    """Episodes of each split of what is collected."""

    train: Count
    held_out: Count
    calibration: Count


@dataclass(frozen=True)
class CollectSection:
    """Section collect."""

    episodes: Splits
    shard: Count
    mix: Mapping[Literal["expert", "noisy", "random"], Share]
    noise_level: tuple[Share, Share]


@dataclass(frozen=True)
class ImitationSection:
    """Section imitation."""

    demos: Count
    sources: Annotated[Sequence[str], MinLen(1)]
    perception: Fit
    discount: Discount
    fit: Fit


@dataclass(frozen=True)
class RoundsSection:
    """Section rounds."""

    count: Count
    deploy: Annotated[tuple[Count, ...], MinLen(1)]
    splits: Mapping[Literal["held_out", "calibration"], Share]
    iterations: Annotated[tuple[Count, ...], MinLen(1)]
    clone: Natural


@dataclass(frozen=True)
class ExtraStartsSection:
    """Section extra_starts."""

    variants: Sequence[Name]
    episodes: Count
    data: Sequence[str] | str
    share: Annotated[float, Gt(0), Lt(1)]


@dataclass(frozen=True)
class CloneSection:
    """Section clone."""

    imagined: Natural
    perception: Fit
    fit: Fit


@dataclass(frozen=True)
class JudgeFitSection:
    """Sections judge_fit.first and judge_fit.refresh."""

    imagined: Natural
    fit: Fit


@dataclass(frozen=True)
class TextWorldFitSection:
    """Section text_world_fit."""

    stride: Count
    tokenizer: Fit
    first: Fit
    refresh: Fit


@dataclass(frozen=True)
class StateFitSection:
    """Sections state_fit.first, state_fit.refresh and finetune.state."""

    lora: Natural
    fit: Fit


@dataclass(frozen=True)
class FinetuneSection:
    """Section finetune."""

    data: Sequence[str] | str
    weights: str | None
    simulator: Mapping[str, Any]
    state: StateFitSection


@dataclass(frozen=True)
class DistillSection:
    """Section distill."""

    steps: Natural
    method: Choice
    first: Mapping[str, Any]
    refresh: Mapping[str, Any]


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
class EvaluateSection:
    """Section evaluate."""

    episodes: Count
    envs: Count
    imagined: Count


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
    grid: Mapping[Name, Annotated[Sequence[Any], MinLen(1)]] | None


@dataclass(frozen=True)
class SweepSection:
    """Section sweep."""

    episode: Natural
    levels: Annotated[Sequence[float], MinLen(1)]
    chunks: Count
    pictures: Annotated[int, Ge(2)]


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
    workers: Natural


@dataclass(frozen=True)
class RaySection:
    """Section launch, on Ray."""

    backend: Literal["ray"]
    device: Annotated[str, MinLen(1)]
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
    microbatches: Count
