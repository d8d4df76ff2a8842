"""PPO on chunks (Schulman et al. 2017): maximise E[min(r A, clip(r, 1-e, 1+e) A)] + c H, where A is GAE over
chunks.

One decision is one chunk, so advantages say which chunk of an episode was good. The critic is a small network
on what
the policy's perception made of a rollout while it acted; it costs next to nothing and cannot disturb the
policy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from actors.policies.vla import VISUAL_FEATURES, ChunkPolicy
from envs.specs import CHUNK, LOG_PROB, STATE, STATE_DIM
from learners.rl.algorithm import sound, transitions


@dataclass(frozen=True)
class PPOConfig:
    """Options of PPO.

    Args:
        gamma, lam: discount per chunk and GAE's lambda.
        clip: clipping of the likelihood ratio.
        entropy: weight of the entropy bonus.
        critic: weight of the value loss.
        critic_width, critic_lr: hidden size and learning rate of the value network.
        warmup_passes: passes of the critic over recorded episodes before the first iteration, see
            PPO.warm_up.
    """

    gamma: float = 0.97
    lam: float = 0.9
    clip: float = 0.2
    entropy: float = 0.0
    critic: float = 1.0
    critic_width: int = 256
    critic_lr: float = 1e-3
    warmup_passes: int = 6


class Value(nn.Module):
    """V(observation) from perception's features [..., S] and the joint state [..., 16] -> [..., 1]."""

    def __init__(self, seen: int, width: int):
        super().__init__()
        self.layers = nn.Sequential(
            nn.LayerNorm(seen + STATE_DIM),
            nn.Linear(seen + STATE_DIM, width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, 1),
        )

    def forward(self, seen: Tensor, state: Tensor) -> Tensor:
        return self.layers(torch.cat((seen.detach(), state), -1))


class PPO:
    """See the module's docstring; an Algorithm of learners.rl.loop."""

    name = "ppo"
    supports_delayed_reward = False
    bootstraps = True
    group_size = 1

    def __init__(self, policy: ChunkPolicy, config: PPOConfig):
        self.policy, self.config = policy.trained, config
        value = Value(policy.perception.out_features, config.critic_width)
        self.critic = TensorDictModule(value, in_keys=[VISUAL_FEATURES, STATE], out_keys=["state_value"])
        self.gae = GAE(gamma=config.gamma, lmbda=config.lam, value_network=self.critic, average_gae=False)
        self.objective = ClipPPOLoss(
            self.policy,
            self.critic,
            clip_epsilon=config.clip,
            entropy_bonus=config.entropy > 0,
            entropy_coeff=config.entropy,
            critic_coeff=config.critic,
            normalize_advantage=True,
            functional=False,
        )
        self.objective.set_keys(action=CHUNK, sample_log_prob=LOG_PROB)
        # The loss registers both as functional parameters; optimising the originals needs them in one place.
        self._all = nn.ModuleList([self.policy, self.critic])

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
        with torch.no_grad():
            self.gae(batch)
        value, target = batch["state_value"], batch["value_target"]
        extra = {"advantage": batch["advantage"], "value_target": target, "state_value": value}
        data = transitions(batch, sound(batch), {*self.policy.in_keys, VISUAL_FEATURES, STATE}, **extra)
        return data, {
            "explained_variance": _explained(value, target),
            "advantage_std": float(batch["advantage"].std()),
        }

    def warm_up(self, rollout: TensorDict, seed: int, minibatch: int = 256) -> float:
        """Let the critic learn from a rollout [N, T] of learners.rl.dataset_rollout; a critic that begins
        from nothing spoils the first iterations.

        Returns:
            The share of the targets' variance that it explains before the last pass.
        """
        optimiser = torch.optim.Adam(self.critic.parameters(), lr=self.config.critic_lr)
        shuffle = torch.Generator().manual_seed(seed)
        valid, explained = rollout["valid"].flatten(), 0.0
        for _ in range(self.config.warmup_passes):
            with torch.no_grad():
                self.gae(rollout)
            data = rollout.flatten(0, 1)[valid]
            explained = _explained(data["state_value"], data["value_target"])
            targets = data["value_target"].clone()
            for pick in torch.randperm(len(data), generator=shuffle).split(minibatch):
                optimiser.zero_grad(set_to_none=True)
                said = self.critic(data[pick].select(VISUAL_FEATURES, STATE))["state_value"]
                F.smooth_l1_loss(said, targets[pick]).backward()
                optimiser.step()
        return explained

    def loss(self, minibatch: TensorDict) -> tuple[Tensor, dict[str, float]]:
        """The clipped objective, the value loss and the entropy bonus."""
        out = self.objective(minibatch)
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
