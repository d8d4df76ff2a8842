"""A policy whose actions are disturbed: what becomes of its value says how far a world can be trusted outside
of what it was trained on (as in WPE, "Evaluating robot policies in a world model").
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from envs.specs import CHUNK


class GaussianNoise(TensorDictModuleBase):
    """Any policy with white Gaussian noise on every number of its chunks.

    Args:
        policy: acts; see contract.py.
        spread: float32 [A], the unit of each number, such as its standard deviation in recordings.
        level: standard deviation of the noise in those units.
    """

    def __init__(self, policy: TensorDictModuleBase, spread: Tensor, level: float):
        super().__init__()
        self.policy, self.level = policy, level
        self.in_keys, self.out_keys = list(policy.in_keys), [CHUNK]
        self.register_buffer("spread", spread)
        self.spread: Tensor

    def forward(self, observed: TensorDictBase) -> TensorDictBase:
        """Writes the disturbed chunk float32 [B, K, A]; the draws are torch's own."""
        output = self.policy(observed)
        chunk = output[CHUNK]
        output[CHUNK] = chunk + self.level * self.spread.to(chunk.device) * torch.randn_like(chunk)
        return output
