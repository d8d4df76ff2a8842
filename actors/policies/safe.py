"""What stands between any policy and a world: text and devices on the way in, only sound numbers on the way
out.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from actors.policies.contract import VISUAL_FEATURES, action_key, distribution, input_keys, inputs_for
from envs.specs import CHUNK, COMMAND, INVALID_ACTION, LOG_PROB, ActionMode, WorldSpec, at_rest, to_chunk
from envs.targets import ConfigError


def check_scores(found: Tensor, count: int) -> None:
    """See that log-probabilities are those of whole chunks, [B].

    Raises:
        ConfigError: naming the fix.
    """
    if tuple(found.shape) != (count,):
        raise ConfigError(
            f"the policy says log-probabilities {list(found.shape)} of {count} chunks, but each chunk has"
            f" one, [{count}]; wrap its distribution in torch.distributions.Independent"
        )


class SafePolicyWrapper(TensorDictModuleBase):
    """Any policy as worlds may use it.

    Observations go to the policy's device and what it writes comes back to the world's; a policy that asks
    for "language_instruction" is given text. Where it explores and writes no log-probability, `get_dist` says
    it. Chunks that are NaN or infinite never reach a world: the robot rests instead, and INVALID_ACTION says
    so.

    Args:
        policy: acts; see contract.py.
        spec: what the world takes.
        mode: how the numbers of a chunk are meant.
    """

    def __init__(self, policy: TensorDictModuleBase, spec: WorldSpec, mode: ActionMode):
        super().__init__()
        self.policy, self.spec, self.mode = policy, spec, mode
        self.in_keys = list(dict.fromkeys([*input_keys(policy), COMMAND]))
        self.scored = LOG_PROB not in policy.out_keys and hasattr(policy, "get_dist")
        self.out_keys = [*policy.out_keys, *([LOG_PROB] if self.scored else []), INVALID_ACTION]

    def forward(self, observed: TensorDictBase) -> TensorDictBase:
        """Writes what the policy writes, and INVALID_ACTION bool [B, 1].

        Raises:
            ConfigError: if the policy's chunks are of another size than the world takes, or it says other
                log-probabilities than theirs.
        """
        # Features that lie there are those of the decision before.
        seen = observed.exclude(VISUAL_FEATURES)
        output = self.policy(inputs_for(seen, self.policy))
        for key in self.policy.out_keys:
            value = output.get(key, None)
            if value is not None:
                observed[key] = value.to(observed[COMMAND].device)
        chunk = observed[CHUNK]
        if tuple(chunk.shape[1:]) != (self.spec.chunk, self.spec.action_dim):
            raise ConfigError(
                f"the policy says chunks {list(chunk.shape[1:])}, but {self.spec.embodiment.robot} takes"
                f" [{self.spec.chunk}, {self.spec.action_dim}]; build it for this robot and task.chunk"
            )
        scored = self.scored and exploration_type() is ExplorationType.RANDOM
        if scored:
            known = distribution(self.policy, inputs_for(seen, self.policy))
            observed[LOG_PROB] = known.log_prob(output[action_key(self.policy)]).to(chunk.device)
        if LOG_PROB in self.out_keys and LOG_PROB in observed.keys(True, True):
            check_scores(observed[LOG_PROB], len(chunk))
        bad = ~chunk.isfinite().flatten(1).all(1)
        if scored or LOG_PROB in self.policy.out_keys:
            bad |= ~observed[LOG_PROB].isfinite()
        if bad.any():
            observed[CHUNK] = torch.where(bad[:, None, None], self._rest(observed[COMMAND]), chunk)
            for key in (LOG_PROB, VISUAL_FEATURES):
                if key in self.policy.out_keys or (scored and key == LOG_PROB):
                    value = observed[key]
                    observed[key] = torch.where(bad.view(-1, *[1] * (value.ndim - 1)), 0.0, value)
        observed[INVALID_ACTION] = bad.unsqueeze(-1)
        return observed

    def _rest(self, command: Tensor) -> Tensor:
        """The chunk [B, K, A] by which a robot stays as it is: its command in force, or no change."""
        held = command.unsqueeze(1).expand(-1, self.spec.chunk, -1)
        return to_chunk(at_rest(held, self.spec.embodiment), command, self.mode)
