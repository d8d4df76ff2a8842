"""Which episode seeds serve which purpose in physics; those of different purposes never meet."""

from __future__ import annotations

from enum import IntEnum

_SPACE = 10_000_000  # seeds of one experiment


class Purpose(IntEnum):
    """Where a purpose's seeds begin, within an experiment's space."""

    COLLECT = 0
    DEPLOY = 4_000_000
    PRACTICE = 6_000_000  # RL in physics
    EVALUATE = 9_000_000


def episode_seeds(seed: int, purpose: Purpose, count: int, offset: int = 0) -> list[int]:
    """`count` episode seeds for a purpose of experiment `seed`.

    Evaluation seeds are the same in every experiment, so that runs can be compared.
    """
    base = int(purpose) if purpose is Purpose.EVALUATE else int(purpose) + _SPACE * (1 + seed)
    return list(range(base + offset, base + offset + count))
