"""Stage: teach the state decoder to read joint states off the frozen simulator's features."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipSpec, ClipStore
from envs.simulators.base import Simulator
from envs.simulators.state_base import StateDecoder
from envs.simulators.state_flow import StateExpert
from learners.fit import FitConfig, fit
from learners.lora import low_rank


def train_state(decoder: StateDecoder, simulator: Simulator, store: ClipStore, episodes: Tensor, options: FitConfig, folder: Path, lora: int = 0) -> dict[str, float]:
    """Train `decoder` in place; the simulator only looks on. With `lora` only adapters of that rank learn, of a StateExpert."""
    shape = simulator.shape
    simulator.eval().requires_grad_(False)

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        return store.sample(episodes, options.part, ClipSpec(shape.memory, shape.chunk), generator)

    def loss(clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        features = decoder.look(simulator, simulator.asked(clip, 0, generator=generator))
        future, history = clip["future"], clip["history"]
        value = decoder.loss(features, future["commands"], history["commands"], history["states"], future["states"], future["valid"].float(), generator)
        return value, {}

    if lora and not isinstance(decoder, StateExpert):
        raise ValueError(f"state lora={lora} adapts transformers; simulator.engine=dit and gesim have one")
    with low_rank(decoder.net if isinstance(decoder, StateExpert) else decoder, lora):
        stats = fit("state", decoder, batch, loss, options, folder)
    simulator.requires_grad_(True)
    return stats
