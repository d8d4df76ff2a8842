"""Value networks of PPO: on what the policy's encoder made of a rollout, or on the pictures themselves."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn

from actors.policies.contract import VISUAL_FEATURES, writes_features
from envs.encoders.images import MultiViewEncoder
from envs.encoders.language import TextEncoder
from envs.specs import IMAGE, INSTRUCTION_UTF8, STATE, WorldSpec

_POINTS, _WIDTH, _TEXT = 16, 16, 32  # of the encoder of a critic that has to see for itself


class FeatureValue(nn.Module):
    """V(observation) from visual features [..., F] and the robot's state [..., S] -> [..., 1].

    Gradients do not reach the features, so the critic cannot disturb the policy.
    """

    def __init__(self, features: int, states: int, width: int):
        super().__init__()
        self.layers = _layers(features + states, width)

    def forward(self, seen: Tensor, state: Tensor) -> Tensor:
        return self.layers(torch.cat((seen.detach(), state), -1))


class PictureValue(nn.Module):
    """V(observation) from pictures uint8 [..., V, 3, H, W], instruction's bytes and state -> [..., 1]."""

    def __init__(self, spec: WorldSpec, width: int):
        super().__init__()
        self.views = MultiViewEncoder(spec, _POINTS, _WIDTH)
        self.text = TextEncoder(_TEXT)
        self.layers = _layers(self.views.out_features + _TEXT + spec.state_dim, width)

    def forward(self, image: Tensor, text: Tensor, state: Tensor) -> Tensor:
        seen = self.views(image.reshape(-1, *image.shape[-4:]))
        known = torch.cat((seen.unflatten(0, image.shape[:-4]), self.text(text), state), -1)
        return self.layers(known)


def build_critic(policy: TensorDictModuleBase, spec: WorldSpec, width: int) -> TensorDictModule:
    """The value network that fits a policy: it writes "state_value" [..., 1]."""
    if writes_features(policy):
        network: nn.Module = FeatureValue(policy.visual_dim, spec.state_dim, width)
        return TensorDictModule(network, in_keys=[VISUAL_FEATURES, STATE], out_keys=["state_value"])
    network = PictureValue(spec, width)
    return TensorDictModule(network, in_keys=[IMAGE, INSTRUCTION_UTF8, STATE], out_keys=["state_value"])


def _layers(size: int, width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.LayerNorm(size),
        nn.Linear(size, width),
        nn.SiLU(),
        nn.Linear(width, width),
        nn.SiLU(),
        nn.Linear(width, 1),
    )
