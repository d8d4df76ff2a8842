"""Stage: teach a simulator where objects go and to continue videos, from true frames at first and from its own later."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipSpec, ClipStore
from envs.simulators.base import Simulator
from envs.simulators.latent_world import LatentWorld
from learners.fit import FitConfig, fit, step_generator
from learners.lora import low_rank


@dataclass(frozen=True)
class VisionConfig:
    """Options of the vision stage.

    Args:
        alone: share of the steps that train on single chunks; the rest unrolls.
        unroll: chunks predicted from own predictions after that; the batch shrinks so that a step costs the same.
        strides: frame strides to draw from, uniformly.
        fresh: share of each batch drawn from the newest data set, so that what the policy now does is seen often; 0 draws by size.
        lora: rank of the adapters that learn instead of all weights (latent worlds only); 0 trains all weights.
    """

    alone: float = 0.6
    unroll: int = 4
    strides: tuple[int, ...] = (1,)
    fresh: float = 0.0
    lora: int = 0


def train_vision(simulator: Simulator, store: ClipStore, episodes: Tensor, config: VisionConfig, options: FitConfig, folder: Path, newest: Tensor | None = None) -> dict[str, float]:
    """Train `simulator` in place on the given episodes of a store; `newest` are those that `fresh` speaks of."""
    shape = simulator.shape

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        chunks = 1 if step < config.alone * options.steps else config.unroll
        stride = config.strides[int(torch.randint(len(config.strides), (1,), generator=generator))]
        spec = ClipSpec(shape.memory, shape.chunk, chunks, stride)
        count = max(1, options.part // chunks)
        recent = round(count * config.fresh) if newest is not None and len(newest) else 0
        parts = [store.sample(episodes, count - recent, spec, generator)]
        if recent and newest is not None:
            parts.append(store.sample(newest, recent, spec, generator))
        return torch.cat(parts) if len(parts) > 1 else parts[0]

    if not config.lora:
        return fit("vision", simulator, batch, simulator.loss, options, folder)
    if not isinstance(simulator, LatentWorld):
        raise ValueError(f"vision lora={config.lora} adapts transformers; simulator.engine=dit and gesim have one")
    simulator.requires_grad_(False)
    with low_rank(simulator.net, config.lora):
        stats = fit("vision", simulator, batch, simulator.loss, options, folder)
    simulator.requires_grad_(True)
    return stats


def train_places(simulator: Simulator, store: ClipStore, episodes: Tensor, kept: Tensor, options: FitConfig, folder: Path) -> dict[str, float]:
    """Train `simulator.places` in place and fit its doubt to the `kept` episodes; does nothing where no episode knows its objects' places.

    Motions are few numbers, so a step sees `options.batch` of them, and few pictures beside them, which are soon learned.
    """
    places = simulator.places
    known = torch.isfinite(store.arrays["objects"][store.start[episodes]][:, : places.objects]).any()
    if not known:
        return {}

    def batch(step: int, generator: torch.Generator) -> TensorDict:
        shown = store.shots(episodes, max(1, options.part // 32), generator)
        motion = store.motions(episodes, options.part, simulator.shape.chunk, generator)
        return TensorDict({"shown": shown, "motion": motion}, [])

    def loss(data: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        return places.loss(data["shown"], data["motion"])

    stats = fit("places", places, batch, loss, options, folder)
    places.taught.fill_(True)
    if len(kept):
        places.calibrate(store.motions(kept, 4096, simulator.shape.chunk, step_generator(options.seed, options.steps)))
    return {**stats, "spread": float(places.spread)}
