"""Recorded episodes as rollouts, and what critics learn from them."""

from __future__ import annotations

from functools import partial

import torch

from actors.policies.chunk_gaussian import ChunkGaussianHead
from actors.policies.vla import ChunkPolicy
from envs.episodes.clips import ClipStore
from envs.specs import Rewards
from learners.rl.dataset_rollout import dataset_rollout
from learners.rl.ppo import PPO, PPOConfig


def _policy() -> ChunkPolicy:
    torch.manual_seed(0)
    policy = ChunkPolicy(3, partial(ChunkGaussianHead, chunk=4), width=32, points=4)
    policy.freeze_perception()
    return policy


def test_recorded_rewards_add_up_to_progress_and_success(store: ClipStore) -> None:
    episodes = torch.arange(len(store))
    rollout = dataset_rollout(_policy().perception, store, episodes, Rewards(), 4)
    assert rollout["valid"].sum(1).tolist() == [-(-(int(length) - 1) // 4) for length in store.length]
    total = (rollout["next", "reward"].squeeze(-1) * rollout["valid"]).sum(1)
    last = store.start + store.length - 1
    progress = store.arrays["progress"].float()
    assert torch.allclose(
        total, progress[last] - progress[store.start] + store.arrays["success"][last].float(), atol=1e-5
    )
    assert (rollout["valid"] & rollout["next", "done"].squeeze(-1)).sum(1).tolist() == [1] * len(store)
    assert torch.equal(
        (rollout["next", "terminated"].squeeze(-1) & rollout["valid"]).any(1),
        store.arrays["success"][last].bool(),
    )


def test_an_acquainted_critic_explains_returns(store: ClipStore) -> None:
    policy = _policy()
    rollout = dataset_rollout(policy.perception, store, torch.arange(len(store)), Rewards(), 4)
    said = []
    for passes in (1, 40):
        torch.manual_seed(0)
        said.append(PPO(policy, PPOConfig(warmup_passes=passes)).warm_up(rollout, 0, minibatch=16))
    assert said[1] > max(0.5, said[0])
