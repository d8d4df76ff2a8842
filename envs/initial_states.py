"""Where imagined episodes begin: at the first frames of recorded ones, or anywhere inside them.

A simulator errs more with every chunk that it builds on its own. Short episodes that begin inside recorded
ones (Janner et al. 2019, "When to trust your model") meet every stage of the task while they err little; what
lies beyond their end is the critic's to say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.episodes.clips import ClipStore
from envs.targets import ConfigError


@dataclass
class InitialStates:
    """Recorded moments from which imagined episodes go on.

    Args:
        first: TensorDict [N] as Simulator.reset takes it; N moments at which nothing has happened yet.
        instructions: N texts.
    """

    first: TensorDict
    instructions: list[str]

    @classmethod
    def of(cls, store: ClipStore, episodes: Tensor | None = None) -> InitialStates:
        """The first frames of the given episodes of a store, of all by default."""
        chosen = torch.arange(len(store)) if episodes is None else episodes
        return cls(store.first(chosen), [store.instructions[n] for n in chosen.tolist()])

    def __len__(self) -> int:
        return len(self.instructions)

    @property
    def shown(self) -> tuple[int, ...]:
        """Shape of the pictures, (V, 3, H, W)."""
        return tuple(self.first["frames"].shape[1:])

    @property
    def longest(self) -> int:
        """Most recorded frames that precede an imagined one."""
        return 1

    def past(self, which: Tensor, capacity: int = 1) -> tuple[TensorDict, Tensor]:
        """What was recorded up to moments [B], as Simulator.resume takes it: rows [B, P] and lengths [B].

        Args:
            capacity: rows that the session will need; those who read many frames keep room for them.
        """
        return self.first[which].unsqueeze(1), torch.ones_like(which)


class DecisionPoints(InitialStates):
    """Every moment of recorded episodes at which a policy would decide, with all that came before it.

    Args:
        store: that holds the episodes; pictures stay on disk until they are asked for.
        episodes: int64 [E].
        first: int64 [F], episodes of which the first frames alone stand after those moments.
    """

    def __init__(self, store: ClipStore, episodes: Tensor, first: Tensor | None = None):
        self.store = store
        more = torch.zeros(0, dtype=torch.int64) if first is None else first
        episode, frame = decision_points(store, episodes)
        self.episode = torch.cat((episode, more))
        self.frame = torch.cat((frame, torch.zeros_like(more)))
        self.instructions = [store.instructions[n] for n in self.episode.tolist()]

    @property
    def shown(self) -> tuple[int, ...]:
        """See InitialStates.shown."""
        return (self.store.spec.views, 3, *self.store.spec.size)

    @property
    def longest(self) -> int:
        """See InitialStates.longest."""
        return int(self.frame.max()) + 1

    def past(self, which: Tensor, capacity: int = 1) -> tuple[TensorDict, Tensor]:
        """See InitialStates.past; pictures beyond a moment hold anything."""
        now = self.frame[which]
        return self.store.until(self.episode[which], now, capacity), now + 1


def shared_out(inside: Sequence[int], extra: Sequence[int], share: float) -> list[int]:
    """Numbers of starts, the `inside` ones and then the `extra` ones, each as often as makes the extra ones
    about `share` of them all.
    """
    odds = share / (1 - share) * len(inside) / len(extra)
    often, rare = max(1, round(1 / odds)), max(1, round(odds))
    return list(inside) * often + list(extra) * rare


def decision_points(store: ClipStore, episodes: Tensor) -> tuple[Tensor, Tensor]:
    """Episode and frame, each int64 [N], of all chunks of `episodes` that were begun where there is a
    picture.

    Raises:
        ConfigError: if there are none.
    """
    counts = (store.length[episodes] - 2).clamp(min=0) // store.spec.chunk + 1
    before = counts.cumsum(0) - counts
    within = torch.arange(int(counts.sum())) - torch.repeat_interleave(before, counts)
    episode, frame = torch.repeat_interleave(episodes, counts), within * store.spec.chunk
    seen = store.arrays["present"][store.start[episode] + frame]
    if not seen.any():
        raise ConfigError(
            "no recorded episode is left to begin imagined ones in; deploy or collect more, or set"
            " rl.starts=first"
        )
    return episode[seen], frame[seen]
