"""PPO on chunks (Schulman et al. 2017): maximise E[min(r A, clip(r, 1-e, 1+e) A)] + c H, where A is GAE over
chunks.

One decision is one chunk, so advantages say which chunk of an episode was good. The critic (critic.py) reads
what the policy's encoder made of a rollout while it acted; it costs next to nothing and cannot disturb the
policy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from actors.policies.contract import action_key, device_of, input_keys, trained_part, with_text
from envs.ranges import Count, Discount, Fraction, Natural, NonNegative, Positive, Share
from envs.rng import order_generator
from envs.specs import LOG_PROB, STATE, WorldSpec
from envs.targets import options
from learners.rl.algorithm import clip_bounds, sound, transitions
from learners.rl.critic import build_critic


@dataclass(frozen=True)
class PPOConfig:
    """Options of PPO.

    Args:
        gamma, lam: discount per chunk and GAE's lambda.
        clip: clipping of the likelihood ratio of a chunk of `clip_numbers` numbers, see clip_bounds.
        clip_numbers: None: of chunks as they are.
        entropy: weight of the entropy bonus.
        critic: weight of the value loss.
        critic_width, critic_lr: hidden size and learning rate of the value network.
        warmup_passes: passes of the critic over recorded episodes before the first iteration, see
            PPO.warm_up.
    """

    gamma: Discount
    lam: Share
    clip: Fraction
    clip_numbers: Count | None
    entropy: NonNegative
    critic: NonNegative
    critic_width: Count
    critic_lr: Positive
    warmup_passes: Natural


class PPO:
    """See the module's docstring; an Algorithm of learners.rl.algorithm.

    Args:
        policy: any policy (actors/policies/contract.py).
        spec: of the world that it acts in.
        settings: see PPOConfig.
    """

    config_type = PPOConfig  # by which its section is checked before anything is built
    name = "ppo"
    supports_delayed_reward = False
    bootstraps = True
    group_size = 1

    def __init__(self, policy: TensorDictModuleBase, spec: WorldSpec, **settings: Any):
        self.config = config = options(PPOConfig, settings, "algorithm")
        self.policy = trained_part(policy)
        self.critic = build_critic(policy, spec, config.critic_width).to(device_of(policy))
        self.credit(config.lam)
        self.objective = ClipPPOLoss(
            self.policy,
            self.critic,
            clip_epsilon=clip_bounds(config.clip, config.clip, config.clip_numbers, spec),
            entropy_bonus=config.entropy > 0,
            entropy_coeff=config.entropy,
            critic_coeff=config.critic,
            normalize_advantage=True,
            functional=False,
        )
        self.objective.set_keys(action=action_key(self.policy), sample_log_prob=LOG_PROB)
        # The loss registers both as functional parameters; optimising the originals needs them in one place.
        self._all = nn.ModuleList([self.policy, self.critic])

    def credit(self, lam: float) -> None:
        """Share out returns among decisions by this lambda of GAE from now on."""
        self.gae = GAE(gamma=self.config.gamma, lmbda=lam, value_network=None, average_gae=False)

    def modules(self) -> nn.Module:
        """Policy and critic."""
        return self._all

    def groups(self, lr: float) -> list[dict[str, Any]]:
        """The critic begins from nothing and learns faster than the policy may."""
        return [
            {"params": list(self.policy.parameters()), "lr": lr},
            {"params": list(self.critic.parameters()), "lr": self.config.critic_lr},
        ]

    def seeds(self, starts: int, envs: int, generator: torch.Generator) -> list[int]:
        """Random starts without repetition where there are enough; early endings go on with further ones."""
        rounds = [torch.randperm(starts, generator=generator) for _ in range(1 + 3 * envs // max(1, starts))]
        return torch.cat(rounds)[: 3 * envs].tolist()

    def prepare(self, batch: TensorDict) -> tuple[TensorDict, dict[str, float]]:
        """Advantages of all steps of the rollout, unfinished last episodes included: the critic stands in for
        their rest.
        """
        self.value(batch)
        value, target = batch["state_value"], batch["value_target"]
        extra = {"advantage": batch["advantage"], "value_target": target, "state_value": value}
        keys = dict.fromkeys([*input_keys(self.policy), *self.critic.in_keys, action_key(self.policy)])
        data = transitions(batch, sound(batch), keys, **extra)
        return data, {
            "explained_variance": _explained(value, target),
            "advantage_std": float(batch["advantage"].std()),
        }

    @torch.no_grad()
    def value(self, batch: TensorDict) -> None:
        """Write values, advantages and value targets [B, T, 1] into a rollout [B, T]."""
        self.critic.module.take_units(batch[STATE])
        for part in (batch, batch["next"]):
            part["state_value"] = self.critic(part.select(*self.critic.in_keys))["state_value"]
        self.gae(batch)

    def warm_up(self, rollout: TensorDict, seed: int, minibatch: int = 256) -> tuple[TensorDict, float]:
        """Let the critic learn from a rollout [N, T] of learners.rl.recorded.rollout.

        A critic that begins from nothing spoils the first iterations.

        Returns:
            The rollout on the critic's device, with advantage, value_target and state_value [N, T, 1], and
            the share of the targets' variance that the critic explains before the last pass.
        """
        rollout = rollout.to(device_of(self.critic))
        optimiser = torch.optim.Adam(self.critic.parameters(), lr=self.config.critic_lr)
        shuffle = order_generator(seed)
        valid, explained = rollout["valid"].flatten(), 0.0
        for _ in range(self.config.warmup_passes):
            self.value(rollout)
            data = rollout.flatten(0, 1)[valid]
            explained = _explained(data["state_value"], data["value_target"])
            targets = data["value_target"].clone()
            for pick in torch.randperm(len(data), generator=shuffle).split(minibatch):
                optimiser.zero_grad(set_to_none=True)
                value = self.critic(data[pick].select(*self.critic.in_keys))["state_value"]
                F.smooth_l1_loss(value, targets[pick]).backward()
                optimiser.step()
        self.value(rollout)
        return rollout, explained

    def loss(self, minibatch: TensorDict) -> tuple[Tensor, dict[str, float]]:
        """The clipped objective, the value loss and the entropy bonus."""
        out = self.objective(with_text(minibatch, self.policy))
        total = out["loss_objective"] + out["loss_critic"]
        figures = {
            "kl": float(out["kl_approx"]),
            "clip_fraction": float(out["clip_fraction"]),
            "critic_loss": float(out["loss_critic"].detach()),
        }
        if "loss_entropy" in out.keys():
            total = total + out["loss_entropy"]
            figures["entropy"] = float(out["entropy"])
        return total, figures


def _explained(value: Tensor, target: Tensor) -> float:
    """Share of the targets' variance that values explain; negative where they are worse than the mean."""
    return float((1 - (target - value).var() / target.var().clamp(min=1e-8)).clamp(min=-10.0))
