"""Your own algorithm: REINFORCE with the batch's mean return as its baseline.

worldloop run experiment=smoke 'hydra.searchpath=[file://examples/configs]' algorithm=reinforce
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from actors.policies.contract import action_key, distribution, input_keys, trained_part
from envs.specs import WorldSpec
from learners.rl.algorithm import first_episode, sound, transitions


class Reinforce:
    """Maximise E[(R - mean R) log p(chunk)] over whole first episodes (Williams 1992).

    Args:
        policy: any policy (actors/policies/contract.py).
        spec: of the world that it acts in.
        entropy: weight of an entropy bonus.
    """

    name = "reinforce"
    supports_delayed_reward = True
    bootstraps = False
    group_size = 1

    def __init__(self, policy: TensorDictModuleBase, spec: WorldSpec, entropy: float):
        self.policy, self.entropy = trained_part(policy), entropy

    def modules(self) -> nn.Module:
        """All that is trained."""
        return self.policy

    def groups(self, lr: float) -> list[dict[str, Any]]:
        """Parameter groups for the optimiser."""
        return [{"params": list(self.policy.parameters()), "lr": lr}]

    def seeds(self, starts: int, envs: int, generator: torch.Generator) -> list[int]:
        """Random initial states."""
        return torch.randint(starts, (envs,), generator=generator).tolist()

    def prepare(self, batch: TensorDict) -> tuple[TensorDict, dict[str, float]]:
        """Steps of first episodes with their reward to come, relative to the batch."""
        mine = first_episode(batch["next", "done"].squeeze(-1)) & sound(batch)
        reward = batch["next", "reward"].squeeze(-1) * mine
        to_go = reward.flip(1).cumsum(1).flip(1)
        count = mine.sum(0, keepdim=True).clamp(min=1)
        advantage = to_go - (to_go * mine).sum(0, keepdim=True) / count
        keys = dict.fromkeys([*input_keys(self.policy), action_key(self.policy)])
        return transitions(batch, mine, keys, advantage=advantage.unsqueeze(-1)), {}

    def loss(self, minibatch: TensorDict) -> tuple[Tensor, dict[str, float]]:
        """Negative of the weighted log-likelihood and the entropy bonus."""
        dist = distribution(self.policy, minibatch)
        gain = (dist.log_prob(minibatch[action_key(self.policy)]) * minibatch["advantage"].squeeze(-1)).mean()
        if not self.entropy:
            return -gain, {}
        entropy = dist.entropy().mean()
        return -gain - self.entropy * entropy, {"entropy": float(entropy.detach())}
