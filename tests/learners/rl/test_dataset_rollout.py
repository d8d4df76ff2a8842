"""Recorded episodes as rollouts, and what critics learn from them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from envs.embodiment import Embodiment
from envs.episodes.clips import ClipStore
from envs.specs import IMAGE, Rewards
from envs.targets import build
from learners.rl.dataset_rollout import dataset_rollout
from tests.embodiments import ARM_DELTAS, ARM_JOINTS
from tests.sections import section

Stores = Callable[[Embodiment], ClipStore]


def _policy(store: ClipStore, name: str = "chunk_gaussian", **changes: Any) -> Any:
    torch.manual_seed(0)
    return build(section(f"policy/{name}", "absolute", **changes), "policy", spec=store.spec)


@pytest.mark.parametrize("robot", [ARM_DELTAS, ARM_JOINTS], ids=lambda robot: robot.robot)
def test_recorded_rewards_add_up_to_progress_and_success(tiny_store: Stores, robot: Embodiment) -> None:
    store = tiny_store(robot)
    chunk = store.spec.chunk
    episodes = store.arrays["labelled"].nonzero().flatten()
    rollout = dataset_rollout(_policy(store), store, episodes, Rewards(2.0, 1.0), 0.9)
    assert rollout["valid"].sum(1).tolist() == [
        -(-(int(length) - 1) // chunk) for length in store.length[episodes]
    ]
    total = (rollout["next", "reward"].squeeze(-1) * rollout["valid"]).sum(1)
    last = store.start[episodes] + store.length[episodes] - 1
    won = store.arrays["success"][last] > 0.5
    assert bool(won.any()) and not bool(won.all())
    assert bool((total[~won] == 0).all())
    assert bool((total[won] > 1).all()) and bool((total[won] <= 3).all())
    ends = (rollout["valid"] & rollout["next", "done"].squeeze(-1)).sum(1)
    assert ends.tolist() == [1] * len(episodes)
    told = (rollout["next", "terminated"].squeeze(-1) & rollout["valid"]).any(1)
    assert torch.equal(told, won)


@pytest.mark.parametrize("name", ["chunk_gaussian", "tiny_vla"])
def test_a_warmed_up_critic_explains_returns(tiny_store: Stores, name: str) -> None:
    store = tiny_store(ARM_DELTAS)
    policy = _policy(store, name)
    rollout = dataset_rollout(
        policy, store, store.arrays["labelled"].nonzero().flatten(), Rewards(1.0, 1.0), 0.9
    )
    assert (IMAGE in rollout.keys(True, True)) == (name == "tiny_vla")  # features stand for pictures
    explained = []
    for passes in (1, 30):
        torch.manual_seed(0)
        ppo = build(
            section("algorithm/ppo", warmup_passes=passes), "algorithm", policy=policy, spec=store.spec
        )
        explained.append(ppo.warm_up(rollout, 0, minibatch=16)[1])
    assert explained[1] > max(0.5, explained[0])
