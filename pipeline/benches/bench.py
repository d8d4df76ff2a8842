"""worldloop bench: performance as ratios within one run, on the machine at hand."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from envs.targets import ConfigError, target
from pipeline.cli.words import without_given
from pipeline.config import load_config, read_config

# Where a third of the episodes fail, a judge can be wrong both ways, and there are long rollouts.
JUDGED = (
    *("judge_fit.first.fit.steps=300", "collect.episodes.held_out=48"),
    "collect.mix={expert: 0.3, noisy: 0.2, random: 0.5}",
)
# The smallest world on which the figures of few steps mean anything: minutes of one core.
DISTIL = (
    *("experiment=smoke", "simulator=dit_small", "name=distil", "task.horizon=64", "task.size=[32,32]"),
    *("task.suite.cameras=[head]", "distill.steps=4"),
    "tokenizer_fit={steps: 250, batch: 16, lr: 3e-3}",
    "simulator_fit.first={single_chunk_fraction: 0.9, fit: {steps: 400, batch: 16, lr: 3e-3}}",
    *("distill.first.fit.steps=500", "state_fit.first.fit={steps: 120, batch: 16, lr: 4e-3}"),
    "judge_fit.first.imagined=0",  # one judge for all, which has seen the video of none
    *JUDGED,
)
STRIDES = (
    *("experiment=smoke", "simulator=unet_small", "simulator.width=16", "name=strides", "task.horizon=48"),
    *("task.size=[32,32]", "task.suite.cameras=[head]"),
    "simulator_fit.first={single_chunk_fraction: 0.9, strides: [1,2,4], fit: {steps: 400, batch: 12}}",
    *JUDGED,
)

# Where each benchmark is, and what it takes for granted unless the command line says otherwise.
BENCHES: dict[str, tuple[str, tuple[str, ...]]] = {
    "conditioning": ("pipeline.benches.conditioning", ()),
    "collection": ("pipeline.benches.worlds", ()),
    "experts": ("pipeline.benches.experts", ("evaluate.episodes=100",)),
    "world": ("pipeline.benches.worlds", ()),
    "actors": ("pipeline.benches.actors", ("launch=ray",)),
    "learning": ("pipeline.benches.learning", ()),
    "serving": ("pipeline.benches.serving", ("experiment=smoke",)),
    "gesim": ("pipeline.benches.gesim.chunk", ()),
    "compiled": ("pipeline.benches.compiled", ("experiment=quickstart_dit",)),
    "distil": ("pipeline.benches.distil", DISTIL),
    "size": ("pipeline.benches.size", ()),
    "strides": ("pipeline.benches.strides", STRIDES),
    "overfit": ("pipeline.benches.training", ("simulator=dit_small", "task=lerobot")),
    "pretrained": ("pipeline.benches.training", ("experiment=smoke", "simulator=dit_small")),
}
# Undistilled steps a chunk of the simulator that a benchmark begins with, unless the command line says more.
STEPS = {"distil": 15}
# Options of benchmarks that are no part of a config, and what they are unless the command line says more.
OWN: dict[str, dict[str, float]] = {"serving": {"seconds": 180.0}}


def run_bench(words: list[str]) -> None:
    """`worldloop bench NAME [overrides]`.

    Raises:
        ConfigError: for an unknown name, or an option of its own that is no number above 0.
    """
    if not words or words[0] not in BENCHES:
        raise ConfigError(f"say which: worldloop bench {'|'.join(BENCHES)}")
    name = words[0]
    own, rest = dict(OWN.get(name, {})), []
    for word in words[1:]:
        key, _, value = word.partition("=")
        if key not in own:
            rest.append(word)
            continue
        try:
            own[key] = float(value)
        except ValueError:
            own[key] = 0.0
        if not 0 < own[key] < math.inf:
            raise ConfigError(f"{word}: say a number above 0")
    cfg = config_of(name, rest)
    getattr(importlib.import_module(BENCHES[name][0]), name)(cfg, **own)


def config_of(name: str, words: Sequence[str]) -> dict[str, Any]:
    """The config of a benchmark under the overrides of a command line.

    Raises:
        ConfigError: see load_config; or if a simulator that should denoise in steps does not.
    """
    given = [*fitting(without_given(BENCHES[name][1], words), words), *words]
    return load_config([*stepped(given, STEPS[name]), *given] if name in STEPS else given)


def fitting(base: Sequence[str], words: Sequence[str]) -> list[str]:
    """Those overrides of `base` that fit the choices of the words: what it says of a task's own parts, or of
    keys that another choice lacks, is of its own choice alone.
    """
    chosen = {word.partition("=")[0] for word in words if "." not in word.partition("=")[0]}
    paths = {word: word.partition("=")[0].split(".") for word in base}
    if not any(len(path) > 1 and path[0] in chosen for path in paths.values()):
        return list(base)
    choices = [word for word, path in paths.items() if len(path) == 1]
    found = read_config([*choices, *(word for word in words if word.partition("=")[0] in chosen)])
    return [
        word
        for word, path in paths.items()
        if path[0] not in chosen or len(path) == 1 or (len(path) == 2 and path[1] in found[path[0]])
    ]


def stepped(words: Sequence[str], steps: int) -> list[str]:
    """Overrides by which the simulator that `words` choose takes so many undistilled steps a chunk; the
    engine knows which keys say so.

    Raises:
        ConfigError: if it does not denoise in steps.
    """
    section = read_config(words)["simulator"]
    try:
        made = target(section, "simulator").stepped_section(section, steps)  # type: ignore[attr-defined]
    except ValueError as error:
        raise ConfigError(str(error)) from error
    return list(_changes(section, made, "simulator"))


def _changes(old: Mapping[str, Any], new: Mapping[str, Any], path: str) -> Iterator[str]:
    """Overrides that make a section of another."""
    for key, value in new.items():
        if isinstance(value, Mapping) and isinstance(old.get(key), Mapping):
            yield from _changes(old[key], value, f"{path}.{key}")
        elif value != old.get(key):
            yield f"{path}.{key}={json.dumps(value)}"
