"""Stage: teach a simulator to continue videos, from recorded frames at first and from its own later."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
from annotated_types import MinLen
from tensordict import TensorDict
from torch import Tensor
from tqdm import tqdm

from envs.episodes.clips import ClipStore
from envs.episodes.episode import EpisodeError
from envs.ranges import Count, Natural, Share
from envs.rng import Shared, shared_generator, step_generator
from envs.simulators.base import Simulator
from learners.training.fit import FitConfig, fit
from learners.training.lora import low_rank
from learners.training.parallel import leads

_FIRST_FRAMES = 512  # of different episodes, by which a simulator learns how its cameras usually see


@dataclass(frozen=True)
class SimulatorFitConfig:
    """Which clips a simulator learns from.

    Args:
        single_chunk_fraction: share of the steps, the first ones, that train on single chunks; the rest
            unrolls.
        unroll: chunks predicted from own predictions after that; the batch shrinks so that a step costs the
            same.
        strides: frame strides, of which a batch has equal shares, as far as it can; networks are told.
        recent_fraction: share of each batch drawn from the newest data, so that what the policy now does is
            seen often; 0 draws by size.
        lora: rank of the adapters that learn instead of all weights (transformers only); 0 trains all
            weights.
    """

    single_chunk_fraction: Share
    unroll: Count
    strides: Annotated[tuple[Count, ...], MinLen(1)]
    recent_fraction: Share
    lora: Natural


def train_simulator(
    simulator: Simulator,
    store: ClipStore,
    episodes: Tensor,
    config: SimulatorFitConfig,
    options: FitConfig,
    folder: Path,
    newest: Tensor | None = None,
    fresh: bool = True,
    look: Callable[[int], None] | None = None,
) -> dict[str, Any]:
    """Train `simulator` in place on the given episodes of a store.

    Args:
        newest: episodes that `recent_fraction` speaks of.
        fresh: whether it has not been trained before; it then takes its units from these episodes first.
        look: as in `fit`.

    Returns:
        What `fit` does, and if its loss takes something from the weights (Simulator.lost_in_training), that
        as the alarm, which is also printed before anything is learned.

    Raises:
        EpisodeError: if no recorded picture follows another, so that there is nothing to continue.
        ValueError: if lora is asked of a simulator without projections to adapt.
    """
    rows = store.rows(episodes)
    if len(rows) and not bool(
        (store.arrays["present"][rows] & (rows > store.start[owners(store, rows)])).any()
    ):
        raise EpisodeError(
            f"none of the {len(episodes)} episodes has a picture after its first frame, so a simulator has"
            " nothing to learn from them (GE-Sim 2.0's bundles are such: they say where a rollout begins)"
        )
    if fresh:
        simulator.normalise(*units(store, episodes, 1 if simulator.per_frame_moves else store.spec.chunk))
        order = torch.randperm(len(episodes), generator=step_generator(options.seed, options.steps))
        simulator.fit_camera_statistics(store.frames(store.start[episodes[order[:_FIRST_FRAMES]]]))

    lost = simulator.lost_in_training
    if lost and leads():
        tqdm.write(f"simulator: {lost}")
    batch = ClipBatches(simulator, store, episodes, config, options, newest)
    with low_rank(simulator, config.lora):
        stats = fit("simulator", simulator, batch, simulator.loss, options, folder, look=look)
    return {**stats, **({"alarm": lost} if lost else {})}


@dataclass(frozen=True)
class ClipBatches:
    """The training clips of each step, as SimulatorFitConfig asks for them.

    Args:
        simulator: what they are for.
        store, episodes: where they are drawn from.
        config, options: which clips, and how many.
        newest: episodes that `recent_fraction` speaks of.
    """

    simulator: Simulator
    store: ClipStore
    episodes: Tensor
    config: SimulatorFitConfig
    options: FitConfig
    newest: Tensor | None = None

    def __call__(self, step: int, generator: torch.Generator) -> TensorDict:
        """The clips [B] of one microbatch of a step: what ClipStore.clips says, and depth float32 [], how far
        into their chunks they are learned from, 0 to below 1: the same for all microbatches of the step.
        """
        config = self.config
        chunks = 1 if step < config.single_chunk_fraction * self.options.steps else config.unroll
        count = max(1, self.options.part // chunks)
        newest = self.newest if self.newest is not None and len(self.newest) else None
        recent = 0 if newest is None else round(count * config.recent_fraction)
        first = int(torch.randint(len(config.strides), (1,), generator=generator))
        parts = list(self._sampled(self.episodes, count - recent, chunks, first, generator))
        if newest is not None:
            parts += self._sampled(newest, recent, chunks, first + count - recent, generator)
        clips: TensorDict = torch.cat(parts) if len(parts) > 1 else parts[0]
        drawn = shared_generator(self.options.seed, step, Shared.DEPTH)
        clips["depth"] = torch.rand(1, generator=drawn).expand(clips.shape)
        return clips

    def _sampled(
        self, episodes: Tensor, count: int, chunks: int, first: int, generator: torch.Generator
    ) -> Iterator[TensorDict]:
        """`count` clips of some episodes, of one stride after the other, beginning with the `first`-th."""
        most = len(self.config.strides)
        for number, stride in enumerate(self.config.strides):
            share = len(range((number - first) % most, count, most))
            if share:
                spec = self.simulator.clip_spec(chunks, stride)
                yield self.store.sample(episodes, share, spec, generator)


def units(store: ClipStore, episodes: Tensor, most: int) -> tuple[Tensor, Tensor, Tensor]:
    """What simulators and state experts take their units from: commands, moves and states of all frames.

    Args:
        most: frames that a move spans at most, each number of them as often.

    Returns:
        commands float32 [N, A]; moves [N, A], by how much absolute commands differ from those of 1 to `most`
        frames before (zeros of actions that are changes themselves); states [N, S].
    """
    rows = store.rows(episodes)
    commands = store.arrays["commands"]
    if store.spec.embodiment.delta:
        moves = torch.zeros_like(commands[rows])
    else:
        ahead = 1 + torch.arange(len(rows)) % most
        moves = commands[torch.minimum(rows + ahead, last_rows(store, rows))] - commands[rows]
    return commands[rows], moves, store.arrays["states"][rows]


def last_rows(store: ClipStore, rows: Tensor) -> Tensor:
    """The last row of the episode that each row belongs to, int64 like rows."""
    owner = owners(store, rows)
    return store.start[owner] + store.length[owner] - 1


def owners(store: ClipStore, rows: Tensor) -> Tensor:
    """The episode that each row belongs to, int64 like rows."""
    return torch.searchsorted(store.start, rows, right=True) - 1
