"""What physics has told, learned from beside imagined decisions: it holds RL to what is true where the
simulator errs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from actors.policies.contract import action_key, device_of, distribution, inputs_for, trained_part
from envs.episodes.clips import ClipStore
from envs.rng import order_generator, seed_process
from envs.specs import CHUNK, IMAGE, LOG_PROB, ActionMode
from envs.targets import ConfigError
from learners.rl.algorithm import Anchor
from learners.stages.imitation import chunks_ahead
from learners.stages.observed import observe

_AT_ONCE = 256  # frames per pass
# Nats below the least likely of so many samples of the policy. The more numbers a chunk has, the further
# apart its own samples lie, and some of them may be its mode.
_UNLIKELY = 8.0
_SAMPLES = 16
_AT_MODE = 0.125  # nats below the mode's likelihood; half a standard deviation


class RecordedDecisions:
    """Decisions that policies took in physics with their advantages, as transitions of an iteration.

    Likelihood ratios are to the policy that RL begins with, over all of its iterations: clipping then lets
    each decision move the policy so far and no further. Ratios to the policy of each iteration would let
    the same bad decision push it away again and again. An older policy's decisions are taken as this one's
    own, as far as it might well say them: from one round to the next policies change little.

    Args:
        policy: in training, as RL begins with it.
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
        self.at = (rollout["valid"] & rollout["whole"]).flatten().nonzero().squeeze(-1)
        self.known = rollout.exclude("next", "valid", "whole").flatten(0, 1)[self.at].cpu()
        self.known[CHUNK] = chunks_ahead(store, self.known["row"], mode)
        if not len(self.known):
            return
        likely, sayable = zip(*(self._likely(some) for some in self.known.split(_AT_ONCE)), strict=True)
        self.known[LOG_PROB] = torch.cat(likely)
        self.known, self.at = self.known[torch.cat(sayable)], self.at[torch.cat(sayable)]

    def __len__(self) -> int:
        return len(self.known)

    @torch.no_grad()
    def likelihood(self) -> torch.Tensor:
        """Log-probability float32 [N] of all of them under the policy as it is now."""
        return torch.cat(
            [
                self._said(some).log_prob(some[CHUNK].to(device_of(self.policy))).cpu()
                for some in self.known.split(_AT_ONCE)
            ]
        )

    @torch.no_grad()
    def drawn(self) -> torch.Tensor:
        """Which of them lie off the policy's mode, bool [N]. Those at it say nothing of what else would have
        been better, and the likelihood of another policy is no ratio of densities there, for policies take
        their mode more often than their density says.
        """
        parts = []
        for some in self.known.split(_AT_ONCE):
            said = self._said(some)
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                mode = self.policy(inputs_for(self._seen(some), self.policy))[CHUNK]
            likely = said.log_prob(some[CHUNK].to(mode.device))
            parts.append((likely < said.log_prob(mode) - _AT_MODE).cpu())
        return torch.cat(parts)

    def _said(self, some: TensorDict) -> Any:
        return distribution(self.policy, inputs_for(self._seen(some), self.policy))

    @torch.no_grad()
    def _likely(self, some: TensorDict) -> tuple[torch.Tensor, torch.Tensor]:
        """How likely the policy finds the chunks of decisions [N]: float32 [N]; and whether it might well say
        them, bool [N].
        """
        device = device_of(self.policy)
        said = self._said(some)
        likely = said.log_prob(some[CHUNK].to(device))
        # What may be said is told by the same draws each time, so that a resumed run tells the same.
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            seed_process(0)
            least = torch.stack([said.log_prob(said.sample()) for _ in range(_SAMPLES)]).amin(0)
        return likely.cpu(), (likely > least - _UNLIKELY).cpu()

    def _seen(self, some: TensorDict) -> TensorDict:
        """Decisions [N] with what the policy reads: no pictures if it was left its features alone."""
        seen = observe(self.store, some["row"], pictures=IMAGE in self.policy.in_keys)
        return seen.update(some)

    @torch.no_grad()
    def own_chunks(self, count: int, seed: int) -> TensorDict:
        """Transitions [count] of these decisions, each as often as it takes, whose chunks the policy draws
        itself as it is now: by them is told how far updates have moved it, as by imagined ones.

        Args:
            seed: of which and of what it draws.
        """
        order = order_generator(seed)
        rounds = [
            torch.randperm(len(self.known), generator=order) for _ in range(-(-count // len(self.known)))
        ]
        seen, device = self.taken(torch.cat(rounds)[:count]), device_of(self.policy)
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            seed_process(seed)
            parts = [self._drawn_at(some) for some in seen.split(_AT_ONCE)]
        chunks, likely = zip(*parts, strict=True)
        return seen.update({CHUNK: torch.cat(chunks), LOG_PROB: torch.cat(likely)})

    def _drawn_at(self, seen: TensorDict) -> tuple[torch.Tensor, torch.Tensor]:
        said = distribution(self.policy, inputs_for(seen, self.policy))
        chunks = said.sample()
        return chunks, said.log_prob(chunks)

    def revalue(self, rollout: TensorDict) -> None:
        """Take advantages and values anew from the rollout that they were made of."""
        for key in ("advantage", "value_target", "state_value"):
            self.known[key] = rollout[key].flatten(0, 1)[self.at].cpu()

    def sample(self, count: int, like: TensorDict, generator: torch.Generator) -> TensorDict:
        """Random ones, `count` at most; see taken."""
        return self.taken(torch.randperm(len(self.known), generator=generator)[:count], like)

    def taken(self, which: torch.Tensor, like: TensorDict | None = None) -> TensorDict:
        """These of them, int64 [N], on the policy's device; with the keys of the transitions `like` alone, if
        those are given.
        """
        seen = self._seen(self.known[which])
        return (seen if like is None else seen.select(*like.keys(True, True))).to(device_of(self.policy))


@dataclass(frozen=True)
class TrueExperience:
    """What an iteration learns from beside its rollout.

    Args:
        anchor: cloning of what has worked, see RLConfig.anchor.
        decisions: see RLConfig.recorded.
        alone: as many decisions does an iteration make its updates of where nothing is imagined, for it would
            weigh nothing; 0 where iterations have rollouts.
    """

    anchor: Anchor | None = None
    decisions: RecordedDecisions | None = None
    alone: int = 0
