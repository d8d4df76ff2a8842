"""Where random numbers come from: every generator and seed is a function of what it is for.

The same (seed, step) gives the same numbers in any process, batch slot or repetition, which is what placement
independence and exact resumption rest on. No other module makes a generator. Torch is imported by whoever
asks for one of its generators, so that physics workers do without.
"""

from __future__ import annotations

from enum import IntEnum
from hashlib import blake2b
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch

_MASK = 0x7FFF_FFFF_FFFF
_SPACE = 10_000_000  # episode seeds of one experiment


# -- episodes in physics
class Purpose(IntEnum):
    """Where the episode seeds of a purpose begin within an experiment's; those of different purposes never
    meet.
    """

    COLLECT = 0
    DEPLOY = 4_000_000
    PRACTICE = 6_000_000  # RL in physics
    STARTS = 8_000_000  # first frames, from which only imagination goes on
    EVALUATE = 9_000_000
    TRIAL = 9_500_000  # of each round's policy, which decide whether it is kept


def episode_seeds(seed: int, purpose: Purpose, count: int, offset: int = 0) -> list[int]:
    """`count` episode seeds for a purpose of experiment `seed`.

    Evaluation seeds are the same in every experiment, so that runs can be compared.
    """
    base = int(purpose) if purpose is Purpose.EVALUATE else int(purpose) + _SPACE * (1 + seed)
    return list(range(base + offset, base + offset + count))


class Stream(IntEnum):
    """What is drawn of an episode in physics; each has numbers of its own, so one can change alone."""

    START = 0  # where a task's things lie
    BEHAVIOUR = 1  # what a scripted expert's noise does
    SCENE = 3
    LAYOUT = 7  # of a scene
    REQUEST = 11  # words and goals


def episode_rng(seed: int, stream: Stream) -> np.random.Generator:
    """The numbers of one stream of the episode with this seed."""
    return np.random.default_rng([seed, int(stream)])


# -- imagined episodes and their policies
class Noise(IntEnum):
    """What is drawn of a chunk of an imagined episode; each has numbers of its own."""

    VIDEO = 0
    STATE = 1  # of a robot
    GOLDEN = 2  # trajectory of a text world


def noise_generator(seed: int, chunk_index: int, drawn: Noise = Noise.VIDEO) -> torch.Generator:
    """The generator of one kind of randomness of one chunk of one imagined episode, whatever batch it is in.

    It is seeded with a hash: torch's generators on a CPU keep 32 bits of a seed, so whatever is added to one
    is another episode's.
    """
    told = f"{int(drawn)} {int(seed)} {int(chunk_index)}".encode()
    return _generator(int.from_bytes(blake2b(told, digest_size=4).digest(), "big"))


def sampling_seed(seed: int, iteration: int, shard: int) -> int:
    """Seed of a policy's exploration in one job of an RL iteration."""
    return seed * 7_919 + iteration + shard * 1_000_000_007


def iteration_generator(seed: int, iteration: int) -> torch.Generator:
    """The generator by which the episode seeds of an RL iteration are drawn."""
    return _generator((seed * 1_000_003 + iteration) & _MASK)


def episode_stream(seed: int) -> torch.Generator:
    """The generator from which an environment draws episode seeds once it was given no more."""
    return _generator(seed)


def vote_generator(vote: int) -> torch.Generator:
    """The generator by which a judge's vote is sampled; equal questions get equal answers."""
    return _generator(vote)


# -- learning
def step_generator(seed: int, step: int, part: int = 0) -> torch.Generator:
    """The generator of microbatch `part` of training step `step`."""
    return _generator((seed * 1_000_003 + step + part * 7_368_787_000_003) & _MASK)


class Shared(IntEnum):
    """What is drawn once for all microbatches of a training step; each has numbers of its own."""

    DEPTH = 1  # of the chunk in its clip that is learned from
    STEPS = 2  # of a student, the one that it learns at


def shared_generator(seed: int, step: int, drawn: Shared) -> torch.Generator:
    """The generator of what all microbatches of a training step share: how often networks are run. Workers
    gather weights together, so one that ran them more often would wait for the others for ever.
    """
    return step_generator(seed, step, -int(drawn))


def update_seed(seed: int, iteration: int) -> int:
    """Seed of an RL iteration's minibatches, whatever collecting has used up."""
    return seed * 2_000_003 + iteration


def order_generator(seed: int) -> torch.Generator:
    """The generator of an order: of minibatches, or of which episodes, moments or sources come first."""
    return _generator(seed)


# -- the rest
def resampling_generator(seed: int) -> torch.Generator:
    """The generator of a bootstrap's draws."""
    return _generator(seed)


def constant_generator(seed: int) -> torch.Generator:
    """The generator of numbers that belong to an architecture or a toy and never change."""
    return _generator(seed)


def seed_process(seed: int) -> None:
    """Seed torch's global numbers, on all devices: initial weights and a policy's samples come from them."""
    import torch

    torch.manual_seed(seed)


def _generator(seed: int) -> torch.Generator:
    import torch

    return torch.Generator().manual_seed(seed)
