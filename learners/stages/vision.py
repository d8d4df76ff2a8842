"""Stage: teach a simulator where objects go and to continue videos, from true frames at first and from its
own later.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipSpec, ClipStore
from envs.simulators.base import Simulator
from envs.simulators.dit.latent_world import LatentWorld
from learners.training.fit import FitConfig, fit, step_generator
from learners.training.lora import low_rank

_GLANCES = 128  # first pictures of different episodes, at which a simulator looks before it learns


@dataclass(frozen=True)
class VisionConfig:
    """Options of the vision stage.

    Args:
        alone: share of the steps that train on single chunks; the rest unrolls.
        unroll: chunks predicted from own predictions after that; the batch shrinks so that a step costs the
            same.
        strides: frame strides to draw from, uniformly.
        fresh: share of each batch drawn from the newest data set, so that what the policy now does is seen
            often; 0 draws by size.
        lora: rank of the adapters that learn instead of all weights (latent worlds only); 0 trains all
            weights.
    """

    alone: float = 0.6
    unroll: int = 4
    strides: tuple[int, ...] = (1,)
    fresh: float = 0.0
    lora: int = 0


def train_vision(
    simulator: Simulator,
    store: ClipStore,
    episodes: Tensor,
    config: VisionConfig,
    options: FitConfig,
    folder: Path,
    newest: Tensor | None = None,
) -> dict[str, float]:
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

    some = store.start[
        episodes[
            torch.randperm(len(episodes), generator=torch.Generator().manual_seed(options.seed))[:_GLANCES]
        ]
    ]
    simulator.glance(store.frames(some), store.arrays["c2w"][some])
    if not config.lora:
        return fit("vision", simulator, batch, simulator.loss, options, folder)
    if not isinstance(simulator, LatentWorld):
        raise ValueError(
            f"vision lora={config.lora} adapts transformers; simulator.engine=dit and gesim have one"
        )
    simulator.requires_grad_(False)
    with low_rank(simulator.net, config.lora):
        stats = fit("vision", simulator, batch, simulator.loss, options, folder)
    simulator.requires_grad_(True)
    return stats


def train_sight(
    simulator: Simulator, store: ClipStore, episodes: Tensor, options: FitConfig, folder: Path
) -> dict[str, float]:
    """Train what finds the simulator's objects in first pictures, in place; does nothing where no episode
    knows its objects' places.
    """
    places = simulator.places
    if not _placed(simulator, store, episodes):
        return {}

    def loss(data: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        return places.sight.loss(data, places.of(data["objects"]), generator)

    stats = fit(
        "sight",
        places.sight,
        lambda _, generator: store.shots(episodes, options.part, generator),
        loss,
        options,
        folder,
    )
    places.taught.fill_(True)
    return stats


def train_contact(
    simulator: Simulator, store: ClipStore, episodes: Tensor, kept: Tensor, options: FitConfig, folder: Path
) -> dict[str, float]:
    """Train what moves the simulator's objects, in place, and fit its doubt to the `kept` episodes; does
    nothing where no episode knows its objects' places.
    """
    places, chunk = simulator.places, simulator.shape.chunk
    if not _placed(simulator, store, episodes):
        return {}

    def whole(motion: TensorDict) -> Tensor:
        return places.of(torch.cat((motion["now", "objects"][:, None], motion["future", "objects"]), 1))

    def loss(data: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        return places.contact.loss(whole(data), data)

    stats = fit(
        "contact",
        places.contact,
        lambda _, generator: store.motions(episodes, options.part, chunk, generator),
        loss,
        options,
        folder,
    )
    if len(kept):
        motion = store.motions(kept, 4096, chunk, step_generator(options.seed, options.steps)).to(
            places.taught.device
        )
        places.contact.calibrate(whole(motion), motion)
    return {**stats, "spread": float(places.contact.spread)}


def _placed(simulator: Simulator, store: ClipStore, episodes: Tensor) -> bool:
    """Whether any episode knows where any object stands that the simulator follows."""
    return bool(
        torch.isfinite(simulator.places.of(store.arrays["objects"][store.start[episodes]])[..., :3]).any()
    )
