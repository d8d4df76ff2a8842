"""Filtered behaviour cloning: minimise -E[log p(chunk | observation)] over the policy's own successful
episodes.

The simplest learner from success, and the one GE-Sim 2.0 reports; no ratios, no advantages, no group.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from actors.policies.contract import (
    action_key,
    distribution,
    input_keys,
    trained_part,
    with_fixed_spread,
)
from envs.specs import SUCCESS, WorldSpec
from learners.rl.algorithm import first_episode, sound, transitions


class FilteredBC:
    """See the module's docstring; an Algorithm of learners.rl.algorithm. It has no options of its own: rl.lr
    and rl.epochs say how hard it pulls.

    Args:
        policy: any policy (actors/policies/contract.py).
        spec: of the world that it acts in.
    """

    name = "filtered_bc"
    supports_delayed_reward = True
    bootstraps = False
    group_size = 1

    def __init__(self, policy: TensorDictModuleBase, spec: WorldSpec):
        self.policy = trained_part(policy)

    def modules(self) -> nn.Module:
        """The policy."""
        return self.policy

    def groups(self, lr: float) -> list[dict[str, Any]]:
        """One group."""
        return [{"params": list(self.policy.parameters()), "lr": lr}]

    def seeds(self, starts: int, envs: int, generator: torch.Generator) -> list[int]:
        """Random starts."""
        return torch.randint(starts, (envs,), generator=generator).tolist()

    def prepare(self, batch: TensorDict) -> tuple[TensorDict, dict[str, float]]:
        """The steps of this iteration's successful episodes."""
        mine = first_episode(batch["next", "done"].squeeze(-1)) & sound(batch)
        won = (batch["next", SUCCESS].squeeze(-1) & mine).any(1)
        keys = dict.fromkeys([*input_keys(self.policy), action_key(self.policy)])
        return transitions(batch, mine & won[:, None], keys), {"episodes_kept": float(won.sum())}

    def loss(self, minibatch: TensorDict) -> tuple[Tensor, dict[str, float]]:
        """Negative log-likelihood with the exploration spread held fixed, so that only means move."""
        dist = with_fixed_spread(distribution(self.policy, minibatch))
        return -dist.log_prob(minibatch[action_key(self.policy)]).mean(), {}
