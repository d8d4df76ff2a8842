"""Value networks of PPO: on what the policy's encoder made of a rollout, or on the pictures themselves."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn

from actors.policies.contract import VISUAL_FEATURES, writes_features
from actors.policies.proprioception import Proprioception
from envs.embodiment import Embodiment
from envs.encoders.images import MultiViewEncoder
from envs.encoders.language import TextEncoder
from envs.specs import IMAGE, INSTRUCTION_UTF8, STATE, WorldSpec

_POINTS, _WIDTH, _TEXT = 16, 16, 32  # of the encoder of a critic that has to see for itself


class Value(nn.Module):
    """V(observation) from what was seen and the robot's state in units of its own spread: beside joints in
    degrees pictures would not count, and positions in metres not beside pictures.

    Args:
        features: of what is seen.
        robot: whose state.
        width: hidden size.
    """

    knows_units: Tensor

    def __init__(self, features: int, robot: Embodiment, width: int):
        super().__init__()
        self.posture = Proprioception(robot, command=False)
        self.register_buffer("knows_units", torch.tensor(False))
        self.norm = nn.LayerNorm(features)
        self.layers = nn.Sequential(
            nn.Linear(features + self.posture.size, width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, 1),
        )

    @torch.no_grad()
    def take_units(self, states: Tensor) -> None:
        """Take units from the first states [..., S] that there are; later ones change nothing."""
        if not self.knows_units:
            self.posture.normalise(states.reshape(-1, states.shape[-1]))
            self.knows_units.fill_(True)

    def value(self, seen: Tensor, state: Tensor) -> Tensor:
        """float32 [..., 1] from features [..., F] and states [..., S]."""
        out: Tensor = self.layers(torch.cat((self.norm(seen), self.posture(state)), -1))
        return out


class FeatureValue(Value):
    """Of visual features [..., F] and the robot's state [..., S].

    Gradients do not reach the features, so the critic cannot disturb the policy.
    """

    def forward(self, seen: Tensor, state: Tensor) -> Tensor:
        return self.value(seen.detach(), state)


class PictureValue(Value):
    """Of pictures uint8 [..., V, 3, H, W], instruction's bytes and state [..., S]."""

    def __init__(self, spec: WorldSpec, width: int):
        views = MultiViewEncoder(spec, _POINTS, _WIDTH)
        super().__init__(views.out_features + _TEXT, spec.embodiment, width)
        self.views = views
        self.text = TextEncoder(_TEXT)

    def forward(self, image: Tensor, text: Tensor, state: Tensor) -> Tensor:
        seen = self.views(image.reshape(-1, *image.shape[-4:])).unflatten(0, image.shape[:-4])
        return self.value(torch.cat((seen, self.text(text)), -1), state)


def build_critic(policy: TensorDictModuleBase, spec: WorldSpec, width: int) -> TensorDictModule:
    """The value network that fits a policy: it writes "state_value" [..., 1]."""
    if writes_features(policy):
        network: Value = FeatureValue(policy.visual_dim, spec.embodiment, width)
        return TensorDictModule(network, in_keys=[VISUAL_FEATURES, STATE], out_keys=["state_value"])
    network = PictureValue(spec, width)
    return TensorDictModule(network, in_keys=[IMAGE, INSTRUCTION_UTF8, STATE], out_keys=["state_value"])
