"""The forward path's first half: the robot's state decoded from the simulator's features, for the policy to
see.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.envs import Transform

from envs.simulators.state_experts.base import StateDecoder
from envs.specs import FEATURES, STATE


class StateExpertTransform(Transform):
    """Writes the decoded state of the last frame, and keeps all of the chunk's in the session.

    Args:
        decoder: trained on the simulator whose features it reads.
    """

    def __init__(self, decoder: StateDecoder):
        super().__init__(in_keys=[FEATURES], out_keys=[STATE])
        self.decoder = decoder

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        world = self.parent.base_env
        with torch.no_grad():
            states = self.decoder.follow(world.session, world.chunk, next_tensordict[FEATURES])
        next_tensordict[STATE] = states[:, -1]
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset  # the first state is real
