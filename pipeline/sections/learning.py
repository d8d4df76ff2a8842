"""Sections of the loop: the task, the imagined world, and what learns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from annotated_types import Gt, Le, Lt, MinLen

from envs.ranges import Count, Discount, Natural, NonNegative, Positive, Share
from pipeline.sections.kinds import Choice, Fit, Name, Side


@dataclass(frozen=True)
class TaskSection:
    """Section task: a suite (physics), or recordings (data).

    `variants` are options of the suite, by a name of their own, under which policies and experts are tried as
    well: other scenes, other words. `envs` bounds how many episodes are laid out side by side, each in a
    suite of its own, wherever the suite is played; None leaves that to whoever plays.
    """

    suite: Choice | None
    name: Name | Annotated[Sequence[Name], MinLen(1)]
    size: tuple[Side, Side]
    chunk: Count
    horizon: Count
    mode: Literal["relative", "absolute"]
    data: Sequence[str] = ()
    envs: Count | None = None
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
class ExploreSection:
    """Section explore."""

    levels: Sequence[tuple[Positive, Annotated[float, Gt(0), Le(1)]]]
    episodes: Count
    keep: Share


@dataclass(frozen=True)
class WorthSection:
    """Section worth."""

    moments: Natural


@dataclass(frozen=True)
class RoundsSection:
    """Section rounds. Those of an experiment have 20 * 100,000 episode seeds for their deployments; `explore`
    has the first (envs/rng.py).
    """

    count: Annotated[Count, Lt(20)]
    deploy: Annotated[tuple[Count, ...], MinLen(1)]
    trial: Count
    splits: Mapping[Literal["held_out", "calibration"], Share]
    iterations: Annotated[tuple[Count, ...], MinLen(1)]
    clone: Natural


@dataclass(frozen=True)
class ExtraStartsSection:
    """Section extra_starts."""

    variants: Sequence[Name]
    episodes: Count
    data: Sequence[str]
    share: Annotated[float, Gt(0), Lt(1)]


@dataclass(frozen=True)
class CloneSection:
    """Section clone."""

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
class EqualTimeSection:
    """Section equal_time."""

    seconds: NonNegative
    tokenizer: Annotated[float, Gt(0), Lt(1)]
    state: Annotated[float, Gt(0), Lt(1)]
    refresh: Annotated[float, Gt(0), Le(1)]
    measured: Count


@dataclass(frozen=True)
class StateFitSection:
    """Sections state_fit.first, state_fit.refresh and finetune.state."""

    lora: Natural
    clips: Count
    fit: Fit


@dataclass(frozen=True)
class FinetuneSection:
    """Section finetune."""

    data: Sequence[str]
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
