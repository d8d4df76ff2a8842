"""What physics has told, learned from beside imagined decisions: it holds RL to what is true where the
simulator errs.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase

from actors.policies.contract import action_key, device_of, distribution, inputs_for, trained_part
from envs.episodes.clips import ClipStore
from envs.specs import CHUNK, IMAGE, LOG_PROB, ActionMode
from envs.targets import ConfigError
from learners.rl.algorithm import Anchor
from learners.stages.imitation import chunks_ahead
from learners.stages.observed import observe

_AT_ONCE = 256  # frames per pass
_UNLIKELY = 8.0  # nats below what is usual
_SAMPLES = 8  # of a policy, that tell what is usual; not every distribution knows its entropy


class RecordedDecisions:
    """Decisions that a policy took in physics with their advantages, as transitions of an iteration.

    Likelihood ratios are to the policy that the iteration begins with, so that they are bounded as those of
    fresh rollouts are; it is a few iterations away from the one that took the decisions.

    Args:
        policy: in training.
        rollout: of dataset_rollout, [N, T], with advantage, value_target and state_value [N, T, 1].
        mode: how the numbers of the policy's chunks are meant.

    Raises:
        ConfigError: if the policy is scored on action tokens, which no recording holds.

    Chunks are those that were carried out. Some the robot's limits have cut short of what the policy said; it
    would hardly ever say those, and they are left out.
    """

    def __init__(self, policy: TensorDictModuleBase, store: ClipStore, rollout: TensorDict, mode: ActionMode):
        if action_key(policy) != CHUNK:
            raise ConfigError(f"{type(policy).__name__} is scored on action tokens, and recordings hold none")
        self.policy, self.store = trained_part(policy), store
        pick = (rollout["valid"] & rollout["whole"]).flatten()
        self.known = rollout.exclude("next", "valid", "whole").flatten(0, 1)[pick].cpu()
        self.known[CHUNK] = chunks_ahead(store, self.known["row"], mode)
        usual = torch.cat([self._usual(part) for part in self.known.split(_AT_ONCE)])
        self.known = self.known[usual]

    def __len__(self) -> int:
        return len(self.known)

    @torch.no_grad()
    def _usual(self, some: TensorDict) -> torch.Tensor:
        """Whether the policy might well have said the chunks of decisions [N]: bool [N]."""
        seen = distribution(self.policy, inputs_for(self._seen(some), self.policy))
        expected = torch.stack([seen.log_prob(seen.sample()) for _ in range(_SAMPLES)]).mean(0)
        return (seen.log_prob(some[CHUNK].to(expected.device)) > expected - _UNLIKELY).cpu()

    def _seen(self, some: TensorDict) -> TensorDict:
        """Decisions [N] with what the policy reads: no pictures if it was left its features alone."""
        seen = observe(self.store, some["row"], pictures=IMAGE in self.policy.in_keys)
        return seen.update(some)

    @torch.no_grad()
    def sample(self, count: int, like: TensorDict, generator: torch.Generator) -> TensorDict:
        """Random ones, with the keys and on the device of the transitions `like`."""
        some = self.known[torch.randperm(len(self.known), generator=generator)[:count]]
        seen = self._seen(some)
        device = device_of(self.policy)
        likely = [
            distribution(self.policy, inputs_for(part, self.policy)).log_prob(part[CHUNK].to(device)).cpu()
            for part in seen.split(_AT_ONCE)
        ]
        seen[LOG_PROB] = torch.cat(likely)
        return seen.select(*like.keys(True, True)).to(device)


@dataclass(frozen=True)
class TrueExperience:
    """What an iteration learns from beside its rollout.

    Args:
        anchor: cloning of what has worked, see RLConfig.anchor.
        decisions: see RLConfig.recorded.
    """

    anchor: Anchor | None = None
    decisions: RecordedDecisions | None = None
