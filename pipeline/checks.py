"""Everything that can be seen to be wrong with a config before any work, found at once.

Names, types and ranges come from pipeline/sections and from the classes that sections become; what no
single option can tell stands in `_together`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields
from typing import Any

from actors.serving.sessions import ServeConfig
from envs.conditioning import PoseMapStyle
from envs.simulators.base import WORLD_OPTIONS
from envs.specs import Rewards
from envs.targets import (
    ConfigError,
    nearest,
    options,
    section_faults,
    target,
    unknown_names,
    value_faults,
)
from learners.rl.algorithm import RLConfig
from learners.stages.distill.method import Method
from learners.stages.simulator import SimulatorFitConfig
from learners.training.fit import FitConfig
from pipeline.acting import acting
from pipeline.sections import learning, measuring, running
from pipeline.stages.given import imagined_chunks

Cfg = Mapping[str, Any]

_SECTIONS = {
    "task": learning.TaskSection,
    "collect": learning.CollectSection,
    "imitation": learning.ImitationSection,
    "explore": learning.ExploreSection,
    "worth": learning.WorthSection,
    "rounds": learning.RoundsSection,
    "extra_starts": learning.ExtraStartsSection,
    "clone": learning.CloneSection,
    "judge_fit.first": learning.JudgeFitSection,
    "judge_fit.refresh": learning.JudgeFitSection,
    "text_world_fit": learning.TextWorldFitSection,
    "equal_time": learning.EqualTimeSection,
    "state_fit.first": learning.StateFitSection,
    "state_fit.refresh": learning.StateFitSection,
    "finetune": learning.FinetuneSection,
    "distill": learning.DistillSection,
    "chaos": running.ChaosSection,
    "evaluate": measuring.EvaluateSection,
    "controls": measuring.ControlsSection,
    "measure": measuring.MeasureSection,
    "study": measuring.StudySection,
    "imagined": measuring.ImaginedSection,
    "policy_value": measuring.PolicyValueSection,
    "fidelity": measuring.FidelitySection,
    "fidelity.long": measuring.LongSection,
    "ewmbench": measuring.EwmbenchSection,
    "ewmbench.detector": measuring.DetectorSection,
    "ewmbench.prompts": measuring.PromptsSection,
    "sweep": measuring.SweepSection,
    "track": running.TrackSection,
    "serve": ServeConfig,
    "judge.rewards": Rewards,
    "simulator.pose_map_style": PoseMapStyle,
}
_FITS = (
    *("imitation.perception", "imitation.fit", "clone.perception", "clone.fit", "tokenizer_fit"),
    *(f"{stage}.{phase}.fit" for stage in ("state_fit", "judge_fit") for phase in ("first", "refresh")),
    *(f"text_world_fit.{part}" for part in ("tokenizer", "first", "refresh")),
    *("finetune.state.fit", "ewmbench.detector.fit"),
)
_SIMULATOR_FITS = (
    *(f"{stage}.{phase}" for stage in ("simulator_fit", "distill") for phase in ("first", "refresh")),
    "finetune.simulator",
)
_TARGETS = {
    "simulator": WORLD_OPTIONS,
    "judge": ("rewards",),
    "distill.method": (),
    "policy": (),
    "algorithm": (),
    "task.suite": (),
    "fidelity.frames_extractor": (),
    "fidelity.clips_extractor": (),
    "ewmbench.patches": (),
    "ewmbench.frames": (),
    "ewmbench.texts": (),
}
_TOP = {key.partition(".")[0] for key in (*_SECTIONS, *_FITS, *_SIMULATOR_FITS, *_TARGETS, "rl", "launch")}


def faults(cfg: Cfg) -> list[str]:
    """A sentence for each thing that is wrong, naming the key, its value and what is allowed; [] if nothing
    is.
    """
    out = list(_alone(cfg))
    return out or list(_together(cfg))


def _alone(cfg: Cfg) -> Iterator[str]:
    """What is wrong with each option by itself."""
    known = {field.name for field in fields(running.Top)} | _TOP
    yield from (f"{key} is not a key{nearest(key, known)}" for key in cfg if key not in known)
    yield from (f"{key} is missing from the config" for key in sorted(known - cfg.keys()))
    odd = [key for key in sorted(_TOP & cfg.keys()) if not isinstance(cfg[key], Mapping)]
    yield from (f"{key}={cfg[key]!r} should be a section" for key in odd)
    if odd or known - cfg.keys():
        return
    yield from value_faults(running.Top, cfg, "")
    if not re.fullmatch(r"\w[\w.-]*", str(cfg["name"])):
        yield f"name={cfg['name']!r} should be of letters, digits, '_', '-' and '.': it names a folder"
    for key, kind in _SECTIONS.items():
        yield from _of(kind, _at(cfg, key), key)
    for key in _FITS:
        yield from _of(FitConfig, _at(cfg, key), key)
    for key in _SIMULATOR_FITS:
        section = _at(cfg, key)
        within = section if isinstance(section, Mapping) else {}
        clips = {name: value for name, value in within.items() if name != "fit"}
        yield from _of(SimulatorFitConfig, clips if within else section, key)
        yield from _of(FitConfig, within.get("fit"), f"{key}.fit")
    yield from _of(RLConfig, cfg["rl"], "rl", given=("iterations", "microbatches", "seed"))
    yield from _launch(cfg["launch"])
    for key, around in _TARGETS.items():
        section = _at(cfg, key)
        if isinstance(section, Mapping):
            yield from section_faults(section, key, around)
    suite, variants = cfg["task"].get("suite"), cfg["task"].get("variants", {})
    if isinstance(suite, Mapping) and isinstance(variants, Mapping):
        for name, changes in variants.items():
            if isinstance(changes, Mapping):
                yield from section_faults({**suite, **changes}, f"task.variants.{name}")
    yield from _study(cfg["study"])
    others = _at(cfg, "policy_value.others")
    for name, section in others.items() if isinstance(others, Mapping) else ():
        if isinstance(section, Mapping):
            yield from section_faults(section, f"policy_value.others.{name}", ("weights",))
    world = {name: value for name, value in cfg["simulator"].items() if name in WORLD_OPTIONS}
    yield from _of(learning.WorldSection, world, "simulator")


def _of(kind: type[Any], section: Any, key: str, given: tuple[str, ...] = ()) -> Iterator[str]:
    """What is wrong with names and values of a section; what is `given` later may be missing."""
    if not isinstance(section, Mapping):
        yield f"{key}={section!r} should be a section with {sorted(field.name for field in fields(kind))}"
        return
    yield from unknown_names(kind, section, f"section {key}", key)
    needed = [
        field.name
        for field in fields(kind)
        if field.default is field.default_factory is MISSING and field.name not in given
    ]
    yield from (f"{key}.{name} is missing" for name in needed if name not in section)
    yield from value_faults(kind, section, key)


def _study(section: Any) -> Iterator[str]:
    """What is wrong with single rows and columns of a study."""
    rows, columns = (
        section.get(key) if isinstance(section, Mapping) else None for key in ("methods", "measures")
    )
    for name, row in rows.items() if isinstance(rows, Mapping) else ():
        yield from _of(measuring.RowSection, row, f"study.methods.{name}")
        if isinstance(row, Mapping) and isinstance(row.get("policy"), Mapping):
            yield from section_faults(row["policy"], f"study.methods.{name}.policy")
    for name, column in columns.items() if isinstance(columns, Mapping) else ():
        if isinstance(column, Mapping):
            yield from section_faults(column, f"study.measures.{name}")


def _launch(launch: Cfg) -> Iterator[str]:
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", str(launch.get("device"))):
        yield f"launch.device={launch.get('device')!r} should be auto, cpu, cuda or cuda:<number>"
    if launch.get("backend") != "ray":
        yield from _of(running.LocalSection, launch, "launch")
        return
    # Ray takes seconds to import, which runs in one process need not spend.
    from actors.fleets.fleet import Patience
    from actors.serving.judge_service import ServiceConfig

    yield from _of(running.RaySection, launch, "launch")
    yield from _of(ServiceConfig, launch.get("service"), "launch.service")
    yield from _of(Patience, launch.get("patience"), "launch.patience")


def _together(cfg: Cfg) -> Iterator[str]:
    """What options contradict each other; each by itself is as it should be."""
    task, rounds, rl, launch = cfg["task"], cfg["rounds"], cfg["rl"], cfg["launch"]
    if task["horizon"] % task["chunk"]:
        yield f"task.horizon={task['horizon']} must be a multiple of task.chunk={task['chunk']}"
    if not task.get("suite") and not task.get("data"):
        yield (
            "task has neither a suite (physics) nor data (recordings): task.data=[folder of a LeRobot data"
            " set], or another task"
        )
    variants = task.get("variants", {})
    for name in cfg["extra_starts"]["variants"]:
        if name not in variants:
            yield (
                f"extra_starts.variants holds {name!r}, no key of task.variants{nearest(name, variants)}; say"
                " extra_starts.variants=[] for starts of the task alone"
            )
    study = cfg["study"]
    known = {"rows": "methods", "columns": "measures", "places": "across", "only": "rows", "against": "rows"}
    for key, among in known.items():
        for name in study[key]:
            if name not in study[among]:
                yield f"study.{key} holds {name!r}, which study.{among} has not{nearest(name, study[among])}"
    if abs(sum(cfg["collect"]["mix"].values()) - 1) > 1e-6:
        yield f"collect.mix={cfg['collect']['mix']} must add up to 1"
    low, high = cfg["collect"]["noise_level"]
    if low > high:
        yield f"collect.noise_level={[low, high]} must be a range, from low to high"
    if sum(rounds["splits"].values()) >= 1:
        yield f"rounds.splits={rounds['splits']} must add up to less than 1; the rest is for learning"
    equal = cfg["equal_time"]
    if equal["tokenizer"] + equal["state"] >= 1:
        yield (
            f"equal_time.tokenizer={equal['tokenizer']} and equal_time.state={equal['state']} must add up to"
            " less than 1; the rest is the simulator's"
        )
    if rl["envs"] % rl["shards"]:
        yield f"rl.envs={rl['envs']} must be a multiple of rl.shards={rl['shards']}"
    elif rl["envs"] // rl["shards"] % cfg["algorithm"].get("group", 1):
        yield (
            f"rl.envs / rl.shards = {rl['envs'] // rl['shards']} must be a multiple of"
            f" algorithm.group={cfg['algorithm']['group']}, or groups would be torn apart"
        )
    if rl["evaluate_every"] and not task.get("suite"):
        yield f"rl.evaluate_every={rl['evaluate_every']} needs physics, which this task has not; set it to 0"
    judge, world = target(cfg["judge"], "judge"), target(cfg["simulator"], "simulator")
    if getattr(judge, "asks_world", False) and not getattr(world, "says_done", True):
        yield (
            f"judge={cfg['judge']['_target_']} goes by what the simulator says of a task's end, and"
            f" {world.__name__} says nothing; choose simulator=tokens, or judge=golden_goal"
        )
    yield from _learning(cfg)
    yield from _distilling(cfg["distill"])
    try:
        acting(cfg)
    except ConfigError as error:
        yield str(error)
    parts, learners = cfg["microbatches"], launch.get("learners", 1)
    if parts % learners:
        yield (
            f"microbatches={parts} must be a multiple of launch.learners={learners}; say"
            f" microbatches={learners}"
        )
    if rl["minibatch"] % parts:
        yield f"rl.minibatch={rl['minibatch']} must be a multiple of microbatches={parts}"
    for key in (*_FITS, *(f"{key}.fit" for key in _SIMULATOR_FITS)):
        section = _at(cfg, key)
        if section is not None:
            try:
                options(FitConfig, {**section, "microbatches": parts}, key)
            except ConfigError as error:
                yield str(error)


def _learning(cfg: Cfg) -> Iterator[str]:
    """What of an algorithm, its loop and rewards does not go together; stages would find it hours later."""
    rl, task, kind = cfg["rl"], cfg["task"], target(cfg["algorithm"], "algorithm")
    name = getattr(kind, "name", kind.__name__)
    if rl["rewards_later"] and not getattr(kind, "supports_delayed_reward", False):
        yield (
            f"rl.rewards_later=true, but algorithm={name} learns from every step as it was rewarded; use grpo"
            " or filtered_bc"
        )
    if rl["schedule"] == "async" and rl["queue"] < rl["shards"]:
        yield f"rl.queue={rl['queue']} must hold at least the rl.shards={rl['shards']} jobs of one iteration"
    short = imagined_chunks(cfg) * task["chunk"] < task["horizon"]
    if short and not getattr(kind, "bootstraps", False) and not cfg["judge"]["rewards"]["progress"]:
        yield (
            f"rl.horizon={rl['horizon']} cuts episodes short, and neither a critic (algorithm={name}) nor"
            " judge.rewards.progress=0 says what the rest is worth; set rl.horizon=null"
        )


def _distilling(section: Cfg) -> Iterator[str]:
    """Students of which nothing could come, as their method says."""
    said = getattr(target(section["method"], "distill.method"), "faults", Method.faults)
    for phase in ("first", "refresh") if section["steps"] else ():
        yield from said(section["method"], section[phase]["fit"], f"distill.{phase}.fit")


def _at(cfg: Cfg, path: str) -> Any:
    """The value at a dotted path, None if it is not there."""
    value: Any = cfg
    for part in path.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value
