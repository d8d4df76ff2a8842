"""Stage: teach the state decoder to read joint states off the frozen simulator's features."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from envs.episodes.clips import ClipSpec, ClipStore
from envs.precision import mixed_precision
from envs.simulators.base import Simulator
from envs.simulators.state_base import StateDecoder
from envs.simulators.state_flow import StateExpert
from learners.fit import FitConfig, fit, step_generator
from learners.lora import low_rank

# Clips that a simulator is shown, so many at once, for a decoder that need look only once; a short training needs fewer.
_GLIMPSES, _AT_ONCE, _PER_STEP = 6000, 50, 6


def train_state(decoder: StateDecoder, simulator: Simulator, store: ClipStore, episodes: Tensor, options: FitConfig, folder: Path, lora: int = 0) -> dict[str, float]:
    """Train `decoder` in place; the simulator only looks on. With `lora` only adapters of that rank learn, of a StateExpert.

    The U-Net's head follows arms to a hundredth of a radian only after thousands of steps, in which the U-Net would look
    at each clip many times over; so what a steady decoder reads is looked at once.
    """
    shape = simulator.shape
    spec = ClipSpec(shape.memory, shape.chunk)
    simulator.eval().requires_grad_(False)

    def seen(clip: TensorDict, generator: torch.Generator) -> TensorDict:
        features = decoder.look(simulator, simulator.asked(clip, 0, generator=generator))
        return TensorDict({"features": features, "future": clip["future"].select("commands", "states", "valid"), "history": clip["history"]}, clip.shape)

    if decoder.steady:
        device, drawn = next(simulator.parameters()).device, step_generator(options.seed, options.steps)
        with mixed_precision(device, options.bf16):
            count = -(-min(_GLIMPSES, _PER_STEP * options.steps) // _AT_ONCE)
            looks = tqdm(range(count), desc="state: looking", unit="batch", dynamic_ncols=True, leave=False)
            glimpses = [seen(store.sample(episodes, _AT_ONCE, spec, drawn).to(device), drawn).cpu() for _ in looks]
        known = torch.cat(glimpses)

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        if decoder.steady:
            return known[torch.randint(len(known), (options.part,), generator=generator)]
        return store.sample(episodes, options.part, spec, generator)

    def loss(clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        shown = clip if decoder.steady else seen(clip, generator)
        future, history = shown["future"], shown["history"]
        value = decoder.loss(shown["features"], future["commands"], history["commands"], history["states"], future["states"], future["valid"].float(), generator)
        return value, {}

    if lora and not isinstance(decoder, StateExpert):
        raise ValueError(f"state lora={lora} adapts transformers; simulator.engine=dit and gesim have one")
    with low_rank(decoder.net if isinstance(decoder, StateExpert) else decoder, lora):
        stats = fit("state", decoder, batch, loss, options, folder)
    simulator.requires_grad_(True)
    return stats
