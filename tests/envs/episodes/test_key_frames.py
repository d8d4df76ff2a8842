"""Key frames are found in commands: grippers that switch, arms that come to rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from envs.episodes.key_frames import key_frames, key_points
from envs.initial_states import decision_points
from tests.embodiments import ARM_DELTAS, BIMANUAL_POSES

Stores = Callable[[Embodiment], ClipStore]


def told(store: ClipStore, moving: torch.Tensor, open_until: int) -> None:
    """Every episode of the store is told to move its last arm as `moving` says, frame by frame, and to close
    that arm's gripper at frame `open_until`.
    """
    robot, commands = store.spec.embodiment, torch.zeros_like(store.arrays["commands"])
    arm = robot.arms[-1]
    for begin, length in zip(store.start.tolist(), store.length.tolist(), strict=True):
        speed = torch.tensor([float(moving[t % len(moving)]) for t in range(length)])
        commands[begin : begin + length, list(arm.numbers)] = (speed if robot.delta else speed.cumsum(0))[
            :, None
        ]
        assert arm.gripper is not None
        commands[begin + open_until : begin + length, arm.gripper] = 1.0
    store.arrays["commands"] = commands


@pytest.mark.parametrize("robot", [BIMANUAL_POSES, ARM_DELTAS], ids=lambda robot: robot.robot)
def test_switches_and_rests_are_found(tiny_store: Stores, robot: Embodiment) -> None:
    store = tiny_store(robot)
    least = int(store.length.min())
    assert least >= 7
    # moves, rests at frame 4, moves again
    told(store, torch.tensor([1.0, 1, 1, 1, 0, 0, *[1] * 100]), open_until=6)
    chosen = torch.tensor([3, 1])
    rows = key_frames(store, chosen).nonzero().flatten()
    wanted = [int(store.start[n]) + t for n in sorted(chosen.tolist()) for t in (4, 6)]
    assert rows.tolist() == sorted(wanted)


def test_where_nobody_knows_the_arms_all_numbers_are_taken_for_one(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    told(store, torch.tensor([1.0, 1, 1, 1, 0, 0, *[1] * 100]), open_until=200)
    spec = store.spec
    store.spec = replace(spec, embodiment=replace(spec.embodiment, arms=()))
    try:
        rows = key_frames(store, torch.tensor([1])).nonzero().flatten()
    finally:
        store.spec = spec
    assert rows.tolist() == [int(store.start[1]) + 4]


def test_decisions_before_key_frames_are_chosen(tiny_store: Stores) -> None:
    store = tiny_store(ARM_DELTAS)
    told(store, torch.ones(100), open_until=6)
    episode, frame = decision_points(store, torch.arange(4))
    chosen = key_points(store, episode, frame)
    # frame 6 lies in the chunk that begins at the last multiple of a chunk's length before it
    before = (6 - 1) // store.spec.chunk * store.spec.chunk
    assert frame[chosen].unique().tolist() == sorted({0, before})
    assert int(chosen.sum()) == 4 * len({0, before})
