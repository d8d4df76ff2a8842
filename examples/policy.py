"""Your own policy: a multilayer perceptron on the main camera's coarse picture, state and words.

worldloop run experiment=smoke 'hydra.searchpath=[file://examples/configs]' policy=coarse
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Independent, Normal

from envs.encoders.language import TextEncoder
from envs.specs import CHUNK, IMAGE, INSTRUCTION_UTF8, LOG_PROB, STATE, WorldSpec

_CELLS = 8  # rows and columns of the coarse picture


class ChunkNormal(Independent):
    """Independent normals over a whole chunk [B, K, A]: one log-probability [B] per decision."""

    def __init__(self, loc: Tensor, scale: Tensor):
        super().__init__(Normal(loc, scale), 2)


class Trunk(nn.Module):
    """From observations to mean and spread of the chunk."""

    def __init__(self, spec: WorldSpec, width: int, std: float):
        super().__init__()
        self.view, self.shape = spec.embodiment.main_view, (spec.chunk, spec.action_dim)
        self.words = TextEncoder(16)
        size = 3 * _CELLS**2 + spec.state_dim + 16
        self.layers = nn.Sequential(
            nn.LazyLinear(width), nn.SiLU(), nn.Linear(width, spec.chunk * spec.action_dim)
        )
        self.layers(torch.zeros(1, size))  # lazily made weights must exist before they can be loaded
        self.log_std = nn.Parameter(torch.full(self.shape, std).log())

    def forward(self, image: Tensor, state: Tensor, text: Tensor) -> tuple[Tensor, Tensor]:
        """uint8 [B, V, 3, H, W], float [B, S], uint8 [B, bytes] -> two times float [B, K, A]."""
        coarse = F.adaptive_avg_pool2d(image[..., self.view, :, :, :].float() / 255, _CELLS).flatten(-3)
        loc = self.layers(torch.cat((coarse, state, self.words(text)), -1)).unflatten(-1, self.shape)
        return loc, self.log_std.exp().expand_as(loc)


class CoarsePolicy(ProbabilisticTensorDictSequential):
    """A TorchRL policy like any other.

    Args:
        spec: what the world shows of which robot; every size comes from it.
        width: of the hidden layer.
        std: initial exploration, in the action's own units.
    """

    def __init__(self, spec: WorldSpec, width: int, std: float):
        keys = [("policy", "loc"), ("policy", "scale")]
        trunk = TensorDictModule(
            Trunk(spec, width, std), in_keys=[IMAGE, STATE, INSTRUCTION_UTF8], out_keys=keys
        )
        sampler = ProbabilisticTensorDictModule(
            in_keys={"loc": keys[0], "scale": keys[1]},
            out_keys=[CHUNK],
            distribution_class=ChunkNormal,
            return_log_prob=True,
            log_prob_key=LOG_PROB,
        )
        super().__init__(trunk, sampler)
