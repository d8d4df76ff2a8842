"""worldloop finetune: a simulator's vision and state expert trained on any LeRobot data sets, from released
or earlier weights.

Two stages of the same kind as the loop's: reused when finished, resumed when interrupted.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from actors.factory import (
    ConfigError,
    build_simulator,
    build_state_decoder,
    open_clips,
    options,
    prepare_process,
)
from envs.episodes.clips import ClipStore
from learners.stages.state import train_state
from learners.stages.vision import VisionConfig, train_vision
from pipeline.artefact import save_weights
from pipeline.graph import Graph, Stage
from pipeline.stages.given import fit_options

Cfg = Mapping[str, Any]


def _data(cfg: Cfg) -> ClipStore:
    folders = cfg["finetune"]["data"]
    if not folders:
        raise ConfigError(
            "finetune.data names no data sets; finetune.data=[folder] (worldloop convert makes them of foreign recordings)"
        )
    store = open_clips(cfg, [Path(folder) for folder in folders])
    task = cfg["task"]
    if (len(store.views), store.size) != (len(task["views"]), tuple(task["size"])):
        raise ConfigError(
            f"finetune.data holds views {list(store.views)} of {store.size}; set task.views and task.size to them, or convert with size={list(task['size'])}"
        )
    return store


def train_finetuned_vision(cfg: Cfg, folder: Path, found: Mapping[str, Path]) -> dict[str, Any]:
    """The simulator, all of it or its adapters."""
    store, section = _data(cfg), dict(cfg["finetune"]["vision"])
    fit_section, weights = section.pop("fit"), cfg["finetune"]["weights"]
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, Path(weights) if weights else None)
    stats = train_vision(
        simulator,
        store,
        torch.arange(len(store)),
        options(VisionConfig, section, "finetune.vision"),
        fit_options(cfg, fit_section, "finetune.vision.fit"),
        folder,
    )
    save_weights(simulator, folder)
    return stats


def train_finetuned_state(cfg: Cfg, folder: Path, found: Mapping[str, Path]) -> dict[str, Any]:
    """The state expert on that simulator, whose trunk stays as it is."""
    store, section = _data(cfg), dict(cfg["finetune"]["state"])
    fit_section = section.pop("fit")
    prepare_process(cfg["seed"])
    simulator = build_simulator(cfg, found["vision"] / "weights.safetensors")
    decoder = build_state_decoder(cfg, simulator)
    if not decoder.normalised:
        decoder.normalise(store.arrays["states"])
    stats = train_state(
        decoder,
        simulator,
        store,
        torch.arange(len(store)),
        fit_options(cfg, fit_section, "finetune.state.fit"),
        folder,
        section["lora"],
    )
    save_weights(decoder, folder)
    return stats


def build_finetune(cfg: Cfg, root: Path) -> Graph:
    """The two stages; keyed by what they learn from and how."""
    graph = Graph(root / "finetune")
    learned = {
        "task": cfg["task"],
        "seed": cfg["seed"],
        "simulator": cfg["simulator"],
        "microbatches": cfg["microbatches"],
        "data": list(cfg["finetune"]["data"]),
        "weights": cfg["finetune"]["weights"],
    }
    graph.add(
        Stage(
            "vision",
            (),
            {**learned, "vision": cfg["finetune"]["vision"]},
            lambda folder, found: train_finetuned_vision(cfg, folder, found),
        )
    )
    graph.add(
        Stage(
            "state",
            ("vision",),
            {**learned, "state": cfg["finetune"]["state"]},
            lambda folder, found: train_finetuned_state(cfg, folder, found),
        )
    )
    return graph
