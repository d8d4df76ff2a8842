"""What clips that show one frame in so many say of the commands in between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from envs.embodiment import Arm, Embodiment
from envs.episodes import LeRobotWriter
from envs.episodes.clip_spec import ClipSpec
from envs.episodes.clips import ClipStore
from tests.embodiments import ARM_DELTAS, ARM_JOINTS, world_spec
from tests.moving_square import SIZE, moving_square


def test_stride_skips_frames(store: ClipStore) -> None:
    clip = store.clips(torch.tensor([3]), torch.tensor([5]), ClipSpec(4, 2, 1, stride=3))
    ahead = store.start[3] + torch.tensor([8, 11])
    assert torch.equal(clip["future", "commands"][0], store.arrays["commands"][ahead])
    assert int(clip["begin"]) == 1  # one stride of past: frames 2 and 5


def test_changes_are_summed_over_the_frames_that_a_stride_skips(
    tiny_store: Callable[[Embodiment], ClipStore],
) -> None:
    store = tiny_store(ARM_DELTAS)
    clip = store.clips(torch.tensor([3]), torch.tensor([2]), ClipSpec(2, 2, 1, stride=3))
    commands = store.arrays["commands"][store.start[3] :]
    grippers = list(ARM_DELTAS.grippers)
    for shown, row in zip(clip["future", "commands"][0], (5, 8), strict=True):
        summed = commands[row - 2 : row + 1].sum(0)
        summed[grippers] = commands[row][grippers]
        assert torch.allclose(shown, summed)
    now = commands[:3].sum(0)  # nothing was commanded before the first frame
    now[grippers] = commands[2][grippers]
    assert torch.allclose(clip["now", "command"][0], now) and clip["stride"].tolist() == [3]


def test_velocities_are_the_mean_of_the_frames_that_a_stride_skips(tmp_path: Path) -> None:
    names = ("x.vel", *ARM_JOINTS.action_names[1:])
    arms = (Arm("arm", tuple(range(1, 6)), 6),)
    robot = replace(ARM_JOINTS, action_names=names, arms=arms).at(SIZE)
    spec = world_spec(robot, SIZE)
    LeRobotWriter(tmp_path, robot).write([moving_square(robot, seed) for seed in range(2)])
    store = ClipStore([tmp_path], spec)
    clip = store.clips(torch.tensor([1]), torch.tensor([2]), ClipSpec(2, 2, 1, stride=4))
    commands = store.arrays["commands"][store.start[1] :]
    for shown, row in zip(clip["future", "commands"][0], (6, 10), strict=True):
        assert torch.allclose(shown[0], commands[row - 3 : row + 1, 0].mean())
        assert torch.equal(shown[1:], commands[row][1:])  # positions are those in force
    # of another episode's frames nothing is known
    assert torch.allclose(clip["now", "command"][0, 0], commands[:3, 0].mean())
