"""Key frames of recorded episodes: where a gripper opens or closes, or an arm that moved comes to rest.

So James and Davison (2022, Q-attention) find the moments that a manipulation consists of, in commands alone;
nothing is known of objects or tasks.
"""

from __future__ import annotations

import torch
from torch import Tensor

from envs.embodiment import Arm
from envs.episodes.store import EpisodeStore

_CLOSING = 0.25  # share of a gripper's recorded range by which it moves within a frame, if it is told to
_REST = 0.1  # share of an arm's usual speed, a high quantile of it, below which it rests
_USUAL = 0.9


def key_frames(store: EpisodeStore, episodes: Tensor) -> Tensor:
    """Which rows of a store are key frames, bool [N]; only rows of the given episodes can be.

    A first frame is none: nothing has changed there yet. Where nobody knows which numbers are an arm's, all
    together are taken for one.
    """
    commands, key = store.arrays["commands"], torch.zeros(len(store.arrays["commands"]), dtype=torch.bool)
    rows = store.rows(episodes)
    first = torch.isin(rows, store.start[episodes])
    earlier = torch.where(first, rows, rows - 1)
    robot = store.spec.embodiment
    moves = commands[rows] if robot.delta else commands[rows] - commands[earlier]
    found = torch.zeros(len(rows), dtype=torch.bool)
    for arm in robot.arms or (Arm("all", tuple(range(robot.action_dim))),):
        found |= _switches(arm, commands, rows, earlier) | _rests(moves[:, list(arm.numbers)], first)
    key[rows] = found & ~first
    return key


def key_points(store: EpisodeStore, episode: Tensor, frame: Tensor) -> Tensor:
    """Which decision points, at `frame` [P] of `episode` [P], come just before what matters: the episode's
    beginning, and those in whose chunk a key frame lies. bool [P].
    """
    count = torch.cat([torch.zeros(1, dtype=torch.int64), key_frames(store, episode.unique()).cumsum(0)])
    now, last = store.start[episode] + frame, store.start[episode] + store.length[episode] - 1
    ahead = torch.minimum(now + store.spec.chunk, last)
    return (frame == 0) | (count[ahead + 1] > count[now + 1])


def _switches(arm: Arm, commands: Tensor, rows: Tensor, earlier: Tensor) -> Tensor:
    if arm.gripper is None:
        return torch.zeros(len(rows), dtype=torch.bool)
    told = commands[:, arm.gripper]
    span = told[rows].max() - told[rows].min()
    return (told[rows] - told[earlier]).abs() > (_CLOSING * span).clamp(min=1e-6)


def _rests(moves: Tensor, first: Tensor) -> Tensor:
    """Rows [N] of one arm's moves [N, D] at which it comes to rest; `first` marks episodes' beginnings."""
    speed = (moves / moves.std(0).clamp(min=1e-6)).norm(dim=1)
    usual = speed.sort().values[int(_USUAL * (len(speed) - 1))]
    resting = speed < _REST * usual
    return resting & ~resting.roll(1) & ~first
