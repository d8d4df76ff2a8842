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
from envs.simulators.state_experts.base import StateDecoder
from envs.simulators.state_experts.flow import StateExpert
from learners.training.fit import FitConfig, fit, step_generator
from learners.training.lora import low_rank

# Clips that a simulator is shown, so many at once, each to be learned from so many times; what it says of
# them must fit into so many bytes.
_GLIMPSES, _AT_ONCE, _VISITS, _KEPT = 6000, 50, 16, 2 * 2**30


def train_state(
    decoder: StateDecoder,
    simulator: Simulator,
    store: ClipStore,
    episodes: Tensor,
    options: FitConfig,
    folder: Path,
    lora: int = 0,
) -> dict[str, float]:
    """Train `decoder` in place; the simulator only looks on. With `lora` only adapters of that rank learn, of
    a StateExpert.

    Arms are followed to a hundredth of a radian only after thousands of steps, in which a simulator would
    look at each
    clip many times over. So it looks once, and what it says is kept; one that says too much to be kept (of
    gigabytes a
    clip) looks anew at every step.
    """
    shape = simulator.shape
    spec = ClipSpec(shape.memory, shape.chunk)
    device, drawn = next(simulator.parameters()).device, step_generator(options.seed, options.steps)
    simulator.eval().requires_grad_(False)

    def seen(clip: TensorDict, generator: torch.Generator) -> TensorDict:
        shown = decoder.look(simulator, simulator.build_inputs(clip, 0, generator=generator))
        return TensorDict(
            {
                "shown": shown,
                "future": clip["future"].select("commands", "states", "valid"),
                "history": clip["history"],
            },
            clip.shape,
        )

    def looked(count: int) -> TensorDict:
        with mixed_precision(device, options.bf16):
            return seen(store.sample(episodes, count, spec, drawn).to(device), drawn).cpu()

    known = looked(1)
    count = min(_GLIMPSES, options.steps * options.batch // _VISITS, _KEPT // known["shown"].nbytes)
    keep = count >= options.part
    if keep:
        known = torch.cat(
            [
                looked(_AT_ONCE)
                for _ in tqdm(
                    range(-(-count // _AT_ONCE)),
                    desc="state: looking",
                    unit="batch",
                    dynamic_ncols=True,
                    leave=False,
                )
            ]
        )

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        if keep:
            return known[torch.randint(len(known), (options.part,), generator=generator)]
        return store.sample(episodes, options.part, spec, generator)

    def loss(clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        shown = clip if keep else seen(clip, generator)
        future, history = shown["future"], shown["history"]
        features = decoder.read(shown["shown"])
        value = decoder.loss(
            features,
            future["commands"],
            history["commands"],
            history["states"],
            future["states"],
            future["valid"].float(),
            generator,
        )
        return value, {}

    if lora and not isinstance(decoder, StateExpert):
        raise ValueError(f"state lora={lora} adapts transformers; simulator.engine=dit and gesim have one")
    with low_rank(decoder.net if isinstance(decoder, StateExpert) else decoder, lora):
        stats = fit("state", decoder, batch, loss, options, folder)
    simulator.requires_grad_(True)
    return stats
