"""Where the episodes of an iteration begin, and whether those that begin alike meet the same noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tensordict import TensorDict

from envs.specs import EPISODE


@dataclass(frozen=True)
class Starts:
    """What episodes may begin with.

    Args:
        pool: numbers of start frames in imagination, some more often than others; in physics, seeds.
        count: of start frames that the imagined world has, if every episode shall meet noise of its own:
            seeds that differ by a multiple of it begin alike and differ in noise (WorldEnv). 0 where those
            that begin alike shall meet the same noise, and in physics, where the seed says all.
    """

    pool: Sequence[int]
    count: int = 0

    def seeds(self, drawn: Sequence[int], iteration: int) -> list[int]:
        """Episode seeds of an iteration that begins at positions `drawn` of the pool."""
        earlier = iteration * len(drawn)
        begun = [self.pool[position % len(self.pool)] for position in drawn]
        return [start + self.count * (earlier + number) for number, start in enumerate(begun)]

    def check_groups(self, batch: TensorDict, size: int) -> None:
        """See that the first episodes of every `size` slots of a rollout [B, T] began alike."""
        seeds = batch[EPISODE][:, 0, 0]
        begun = (seeds % self.count if self.count else seeds).unflatten(0, (-1, size))
        assert bool((begun == begun[:, :1]).all()), "a group holds different starts"


def weighed(pool: Sequence[int], worth: Sequence[float]) -> list[int]:
    """Numbers of start frames, each as often as makes its share of them all grow with its worth, in steps of
    an eighth of the largest; as they are where all are worth the same.
    """
    most = max(worth, default=0.0)
    if most == min(worth, default=0.0):
        return list(pool)
    return [start for start, value in zip(pool, worth, strict=True) for _ in range(round(8 * value / most))]
