"""Where random numbers come from: every generator and seed is a function of what it is for.

The same (seed, step) gives the same numbers in any process, batch slot or repetition, which is what placement
independence and exact resumption rest on.
"""

from __future__ import annotations

import torch

_MASK = 0x7FFF_FFFF_FFFF


def noise_generator(seed: int, chunk_index: int) -> torch.Generator:
    """The generator of all randomness of one chunk of one imagined episode, whatever batch it is in."""
    return torch.Generator().manual_seed((int(seed) * 1_000_003 + int(chunk_index)) & _MASK)


def step_generator(seed: int, step: int, part: int = 0) -> torch.Generator:
    """The generator of microbatch `part` of training step `step`."""
    return torch.Generator().manual_seed((seed * 1_000_003 + step + part * 7_368_787_000_003) & _MASK)


def iteration_generator(seed: int, iteration: int) -> torch.Generator:
    """The generator by which the episode seeds of an RL iteration are drawn."""
    return torch.Generator().manual_seed((seed * 1_000_003 + iteration) & _MASK)


def update_seed(seed: int, iteration: int) -> int:
    """Seed of an RL iteration's minibatches, whatever collecting has used up."""
    return seed * 2_000_003 + iteration


def sampling_seed(seed: int, iteration: int, shard: int) -> int:
    """Seed of a policy's exploration in one job of an RL iteration."""
    return seed * 7_919 + iteration + shard * 1_000_000_007
