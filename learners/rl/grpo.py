"""GRPO on chunks (Shao et al. 2024): maximise E[min(r A, clip(r, 1-e_low, 1+e_high) A)] - b KL(policy ||
start policy).

A is an episode's return against the others of its group, which began from the same frame; there is no critic.
Groups whose episodes all scored alike teach nothing and are dropped (Yu et al. 2025, DAPO), as are higher
clips theirs.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import kl_divergence
from torchrl.objectives import ClipPPOLoss

from actors.policies.contract import action_key, distribution, input_keys, trained_part, with_text
from envs.ranges import Count, Fraction, NonNegative, Positive
from envs.specs import LOG_PROB, WorldSpec
from envs.targets import options
from learners.rl.algorithm import clip_bounds, first_episode, sound, transitions


@dataclass(frozen=True)
class GRPOConfig:
    """Options of GRPO.

    Args:
        group: episodes per start frame.
        normalise: divide by the group's standard deviation; without, advantages keep the reward's unit (Liu
            et al. 2025).
        clip_low, clip_high: bounds below and above one of the likelihood ratio of a chunk of `clip_numbers`
            numbers, see clip_bounds.
        clip_numbers: None: of chunks as they are.
        kl: weight of the KL to the policy that RL started from.
        entropy: weight of the entropy bonus.
        shaped: credit each chunk with the reward that is still to come instead of the whole episode's.
    """

    group: Count
    normalise: bool
    clip_low: Fraction
    clip_high: Positive
    clip_numbers: Count | None
    kl: NonNegative
    entropy: NonNegative
    shaped: bool


class GRPO:
    """See the module's docstring; an Algorithm of learners.rl.algorithm.

    Args:
        policy: any policy (actors/policies/contract.py).
        spec: of the world that it acts in.
        settings: see GRPOConfig.
    """

    config_type = GRPOConfig  # by which its section is checked before anything is built
    name = "grpo"
    supports_delayed_reward = True
    bootstraps = False

    def __init__(self, policy: TensorDictModuleBase, spec: WorldSpec, **settings: Any):
        self.config = config = options(GRPOConfig, settings, "algorithm")
        self.policy = trained_part(policy)
        self.reference = copy.deepcopy(self.policy).requires_grad_(False) if config.kl else None
        self.objective = ClipPPOLoss(
            self.policy,
            None,
            clip_epsilon=clip_bounds(config.clip_low, config.clip_high, config.clip_numbers, spec),
            entropy_bonus=config.entropy > 0,
            entropy_coeff=config.entropy,
            functional=False,
        )
        self.objective.set_keys(action=action_key(self.policy), sample_log_prob=LOG_PROB)
        self.group_size = config.group

    def modules(self) -> nn.Module:
        """The policy."""
        return self.policy

    def groups(self, lr: float) -> list[dict[str, Any]]:
        """One group."""
        return [{"params": list(self.policy.parameters()), "lr": lr}]

    def seeds(self, starts: int, envs: int, generator: torch.Generator) -> list[int]:
        """Groups of equal starts.

        Raises:
            ValueError: if rl.envs is not a multiple of algorithm.group.
        """
        if envs % self.config.group:
            raise ValueError(f"rl.envs={envs} must be a multiple of algorithm.group={self.config.group}")
        order = torch.randint(starts, (envs // self.config.group,), generator=generator)
        return order.repeat_interleave(self.config.group).tolist()

    def prepare(self, batch: TensorDict) -> tuple[TensorDict, dict[str, float]]:
        """Group-relative advantages of the first episode of every slot; what a slot does after that belongs
        to no group.
        """
        done = batch["next", "done"].squeeze(-1)
        mine = first_episode(done) & sound(batch)
        reward = batch["next", "reward"].squeeze(-1) * mine
        size = self.config.group
        togo = reward.flip(1).cumsum(1).flip(1)
        score = togo if self.config.shaped else togo[:, :1].expand_as(togo)
        groups = score.unflatten(0, (-1, size))  # [G, size, T]
        # A whole episode's return is compared with those of all, also of the ones that have ended by now.
        alive = mine if self.config.shaped else mine.any(1, keepdim=True).expand_as(mine)
        there = alive.unflatten(0, (-1, size)).float()
        count = there.sum(1, keepdim=True).clamp(min=1)
        mean = (groups * there).sum(1, keepdim=True) / count
        spread = (((groups - mean).square() * there).sum(1, keepdim=True) / count).sqrt()
        advantage = (groups - mean) / (spread + 1e-2) if self.config.normalise else groups - mean
        total, lived = reward.sum(1).unflatten(0, (-1, size)), mine.any(1).unflatten(0, (-1, size))
        highest = total.masked_fill(~lived, -torch.inf).amax(1)
        alike = highest - total.masked_fill(~lived, torch.inf).amin(1) < 1e-4  # so is a group of none
        keep = (
            mine & (~alike).repeat_interleave(size)[:, None] & (there.sum(1) > 1).repeat_interleave(size, 0)
        )
        if not keep.any():
            # nothing to learn from, and advantages are zero: the update is a no-op that alarms report
            keep = mine
        keys = dict.fromkeys([*input_keys(self.policy), action_key(self.policy)])
        data = transitions(batch, keep, keys, advantage=advantage.flatten(0, 1).unsqueeze(-1))
        return data, {
            "groups_dropped": float(alike.float().mean()),
            "advantage_std": float(data["advantage"].std(unbiased=False)) if len(data) else 0.0,
        }

    def loss(self, minibatch: TensorDict) -> tuple[Tensor, dict[str, float]]:
        """The clipped objective, the KL to the start policy and the entropy bonus."""
        out = self.objective(with_text(minibatch, self.policy))
        total = out["loss_objective"]
        figures = {"kl": float(out["kl_approx"]), "clip_fraction": float(out["clip_fraction"])}
        if "loss_entropy" in out.keys():
            total = total + out["loss_entropy"]
            figures["entropy"] = float(out["entropy"])
        if self.reference is not None:
            now = distribution(self.policy, minibatch)
            with torch.no_grad():
                start = distribution(self.reference, minibatch)
            distance = kl_divergence(now, start).mean()
            total = total + self.config.kl * distance
            figures["kl_start"] = float(distance.detach())
        return total, figures
