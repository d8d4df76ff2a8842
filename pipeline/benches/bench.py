"""worldloop bench: performance as ratios within one run, on the machine at hand."""

from __future__ import annotations

import importlib

from envs.targets import ConfigError
from pipeline.cli.words import without_given
from pipeline.config import load_config

# The smallest world on which the figures of few steps mean anything: minutes of one core.
DISTIL = (
    *("experiment=smoke", "simulator=dit_small", "name=distil", "task.horizon=64", "task.size=[48,48]"),
    *("simulator.denoising.steps=15", "distill.steps=4", "tokenizer_fit={steps: 300, batch: 16, lr: 2e-3}"),
    "simulator_fit.first={single_chunk_fraction: 0.9, fit: {steps: 500, batch: 8, lr: 2e-3}}",
    "state_fit.first.fit={steps: 300, batch: 16, lr: 3e-3}",
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
    "gesim": ("pipeline.benches.gesim", ()),
    "distil": ("pipeline.benches.distil", DISTIL),
    "overfit": ("pipeline.benches.training", ("simulator=dit_small", "task=lerobot")),
    "pretrained": ("pipeline.benches.training", ("experiment=smoke", "simulator=dit_small")),
}


def run_bench(words: list[str]) -> None:
    """`worldloop bench NAME [overrides]`.

    Raises:
        ConfigError: for an unknown name.
    """
    if not words or words[0] not in BENCHES:
        raise ConfigError(f"say which: worldloop bench {'|'.join(BENCHES)}")
    module, base = BENCHES[words[0]]
    cfg = load_config([*without_given(base, words[1:]), *words[1:]])
    getattr(importlib.import_module(module), words[0])(cfg)
