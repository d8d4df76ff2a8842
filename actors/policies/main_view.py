"""TorchRL's own vision-language-action policies in worlds of any robot: they see the main view."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data.vla import UniformActionTokenizer

from envs.ranges import Count
from envs.specs import CHUNK, IMAGE, INSTRUCTION, STATE, WorldSpec
from envs.targets import build


class MainViewPolicy(TensorDictModuleBase):
    """A token policy of torchrl.modules.vla behind the contract of policies (contract.py).

    The class itself stays as TorchRL wrote it; it is shown [B, 3, H, W] of the main view, and says action
    tokens, on which it is scored, together with the chunk that they stand for.

    Args:
        spec: what the world shows of which robot.
        policy: config section of the policy: `_target_` and its options; action_dim, chunk_size, vocab_size
            and action_tokenizer are filled in.
        bins: tokens per number of an action; they span -1..1 until `normalise` finds another range.
    """

    def __init__(self, spec: WorldSpec, policy: Mapping[str, Any], bins: Count):
        super().__init__()
        self.view = spec.embodiment.main_view
        self.policy = build(
            policy,
            "policy.policy",
            action_dim=spec.action_dim,
            chunk_size=spec.chunk,
            vocab_size=bins,
            action_tokenizer=UniformActionTokenizer(bins, low=-1.0, high=1.0, action_dim=spec.action_dim),
        )
        self.in_keys, self.out_keys = list(self.policy.in_keys), list(self.policy.out_keys)
        shown = TensorDict({IMAGE: torch.zeros(1, spec.views, 3, *spec.size, dtype=torch.uint8)}, [1])
        shown[STATE], shown[INSTRUCTION] = torch.zeros(1, spec.state_dim), ""
        with torch.no_grad():
            output = self(shown)  # layers that take their size from the first input take it here
        if CHUNK not in output.keys(True, True):
            raise ValueError("policy.policy must say chunks beside tokens; set its output_mode to both")

    def forward(self, observed: TensorDictBase) -> TensorDictBase:
        """Writes tokens int64 [B, K, A], chunk float32 [B, K, A] and log-probability [B]."""
        output = self.policy(self._main_view(observed))
        for key in self.out_keys:
            observed[key] = output[key]
        return observed

    def get_dist(self, observed: TensorDictBase) -> torch.distributions.Distribution:
        """The distribution over tokens [B, K, A]."""
        return self.policy.get_dist(self._main_view(observed))  # type: ignore[no-any-return]

    @torch.no_grad()
    def normalise(self, chunks: Tensor, states: Tensor, commands: Tensor) -> None:
        """Let tokens span demonstrated chunks [N, K, A] and a tenth more on either side."""
        rows = chunks.flatten(0, 1)
        low, high = rows.amin(0), rows.amax(0)
        margin = 0.1 * (high - low) + 1e-6
        tokenizer = self.policy.action_tokenizer
        tokenizer.low.copy_(low - margin)
        tokenizer.high.copy_(high + margin)

    def imitation_loss(self, observed: TensorDictBase, chunks: Tensor) -> Tensor:
        """Negative log-likelihood per number, in nats, of the tokens of chunks [B, K, A]."""
        tokens = self.policy.action_tokenizer.encode(chunks)
        return -self.get_dist(observed).log_prob(tokens).mean() / chunks[0].numel()

    def _main_view(self, observed: TensorDictBase) -> TensorDictBase:
        out = observed.select(*self.in_keys).copy()
        out[IMAGE] = observed[IMAGE].select(-4, self.view)
        return out
