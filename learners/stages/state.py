"""Stage: teach the state expert to read the robot's states off the frozen simulator's features."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from envs.episodes.clips import ClipStore
from envs.precision import mixed_precision
from envs.rng import step_generator
from envs.simulators.base import Simulator
from envs.simulators.inputs import build_inputs
from envs.simulators.state_experts.base import StateDecoder
from learners.stages.simulator import units
from learners.training.fit import FitConfig, fit
from learners.training.lora import low_rank

# Clips whose features are computed once and kept: as few as still let each be learned from so many times, so
# many in one pass, and as many as fit into so many bytes.
_VISITS, _AT_ONCE, _KEPT = 16, 50, 2 * 2**30
# Bytes of a batch up to which the training thread picks its rows itself (.03 ms for .3 MB; see ahead.py).
_AT_HAND = 2**20


def clips_kept(options: FitConfig, clip_bytes: int, most: int) -> int:
    """How many clips' features training computes once and keeps, a batch of them or more; 0 where a batch
    does not fit, and features are computed anew at every step.

    Args:
        clip_bytes: of a clip's features.
        most: clips, however many a batch has.
    """
    fitting = _KEPT // max(1, clip_bytes)
    if fitting < options.part:
        return 0
    return min(fitting, most, max(options.part, options.steps * options.batch // _VISITS))


@dataclass(frozen=True)
class StatePace:
    """What training a state expert costs.

    Args:
        sample_seconds: of a step, for each sample of its batch; features that are computed anew included.
        clip_seconds: of a clip whose features are kept; 0 if none are.
        clip_bytes: of a clip's features.
    """

    sample_seconds: float
    clip_seconds: float
    clip_bytes: int

    @classmethod
    def of(cls, options: FitConfig, stats: Mapping[str, float]) -> StatePace:
        """As a training showed that train_state reports so."""
        samples, clips = options.steps * options.batch, stats["features_clips"]
        return cls(
            (stats["data_seconds"] + stats["compute_seconds"]) / samples,
            stats["features_seconds"] / clips if clips else 0.0,
            int(stats["features_bytes"]),
        )

    def within(self, seconds: float, options: FitConfig, most: int) -> tuple[int, int]:
        """Steps that take so many seconds, one at least, and the most clips whose features are kept: `most`,
        or as many as half of the time is enough for, since a slow simulator would leave no time to learn in.
        """
        if self.clip_seconds:
            most = max(1, min(most, int(seconds / 2 / self.clip_seconds)))
        # with _VISITS to each clip, and no limits
        freely = seconds / (options.batch * (self.sample_seconds + self.clip_seconds / _VISITS))
        clips = clips_kept(replace(options, steps=max(1, int(freely))), self.clip_bytes, most)
        left = seconds - clips * self.clip_seconds
        return max(1, int(left / (options.batch * self.sample_seconds))), most


def train_state(
    decoder: StateDecoder,
    simulator: Simulator,
    store: ClipStore,
    episodes: Tensor,
    options: FitConfig,
    folder: Path,
    lora: int = 0,
    fresh: bool = True,
    clips: int = 6000,
) -> dict[str, float]:
    """Train `decoder` in place; the simulator stays as it is.

    Joints are followed to a hundredth of a radian only after thousands of steps, in which a simulator would
    see each clip many times over. So its features are computed once and kept; of a simulator whose features
    are gigabytes a clip they are computed anew at every step.

    Args:
        lora: rank of the adapters that learn instead of all weights (transformers only); 0 trains all
            weights.
        fresh: whether it has not been trained before; it then takes its units from these episodes first,
            unless they came with released weights.
        clips: most whose features are kept.

    Returns:
        What `fit` does, and features_seconds, what was spent before on features that are kept;
        features_clips, of how many clips (see clips_kept), and features_bytes, of each.

    Raises:
        ValueError: if lora is asked of a decoder without projections to adapt.
    """
    if fresh and not decoder.normalised:
        decoder.normalise(*units(store, episodes, store.spec.chunk))
    shown = _Features(decoder, simulator, store, episodes, options.bf16)
    wanted = {name: parameter.requires_grad for name, parameter in simulator.named_parameters()}
    simulator.eval().requires_grad_(False)
    drawn = step_generator(options.seed, options.steps)
    one = shown.sample(1, drawn)
    began = time.perf_counter()
    count = clips_kept(options, one["shown"].nbytes, clips)
    kept = _Kept(shown.many(count, drawn), options.part) if count else None
    ahead = time.perf_counter() - began

    def sample(step: int, generator: torch.Generator) -> TensorDict:
        return store.sample(episodes, options.part, shown.spec, generator)

    def loss(clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Any]]:
        data = clip if kept is not None else shown.of(clip, generator)
        features = decoder.read(data["shown"])
        return decoder.loss(features, data["history"], data["future"], generator), {}

    with low_rank(decoder, lora):
        stats = fit("state", decoder, kept or sample, loss, options, folder)
    for name, parameter in simulator.named_parameters():
        parameter.requires_grad_(wanted[name])
    features = {"seconds": ahead, "clips": float(count), "bytes": float(one["shown"].nbytes)}
    return {**stats, **{f"features_{key}": value for key, value in features.items()}}


class _Kept:
    """Random rows of what is kept, as `fit` asks for them.

    Args:
        clips: [N] of them, in main memory.
        count: of a batch.
    """

    def __init__(self, clips: TensorDict, count: int):
        self.clips, self.count = clips, count
        self.at_hand = count * clips.bytes() <= _AT_HAND * len(clips)

    def __call__(self, step: int, generator: torch.Generator) -> TensorDict:
        """A batch [count]."""
        pick = torch.randint(len(self.clips), (self.count,), generator=generator)
        return self.clips.apply(lambda rows: rows.index_select(0, pick), batch_size=[self.count])


class _Features:
    """Training clips with the features that a frozen simulator gives of them.

    Args:
        bf16: whether the simulator computes in bfloat16 where the device does.
    """

    def __init__(
        self, decoder: StateDecoder, simulator: Simulator, store: ClipStore, episodes: Tensor, bf16: bool
    ):
        self.decoder, self.simulator, self.store, self.episodes = decoder, simulator, store, episodes
        self.bf16 = bf16
        self.spec = simulator.clip_spec(history=decoder.memory_frames)

    def of(self, clip: TensorDict, generator: torch.Generator) -> TensorDict:
        """shown [B, ...] (see StateDecoder.look), history and future of a clip [B] on the device."""
        inputs = build_inputs(self.simulator.spec, clip, 0, generator=generator)
        return TensorDict(
            {
                "shown": self.decoder.look(self.simulator, inputs),
                "future": clip["future"].select("commands", "states", "valid"),
                "history": clip["history"],
            },
            clip.shape,
        )

    def sample(self, count: int, generator: torch.Generator) -> TensorDict:
        """`of` random clips [count], in main memory."""
        device = self.simulator.device
        with torch.no_grad(), mixed_precision(device, self.bf16):
            clip = self.store.sample(self.episodes, count, self.spec, generator)
            return self.of(clip.to(device), generator).cpu()

    def many(self, count: int, generator: torch.Generator) -> TensorDict:
        """`sample` of `count` clips."""
        sizes = [min(_AT_ONCE, count - done) for done in range(0, count, _AT_ONCE)]
        batches = tqdm(
            sizes,
            desc="state: features",
            unit="batch",
            dynamic_ncols=True,
            leave=False,
        )
        return torch.cat([self.sample(size, generator) for size in batches])
