"""What simulators learn from: any chunk of a clip, after their own predictions of those before it."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from envs.simulators.base import Simulator
from envs.simulators.inputs import own_frames
from envs.specs import WorldSpec
from tests.embodiments import ARM_DELTAS, world_spec
from tests.envs.simulators.clips import clip


class Counting(Simulator):
    """Draws chunks of 1, 2, 3, ... and counts them."""

    def __init__(self, spec: WorldSpec):
        super().__init__(spec, 3)
        self.passes = 0

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        self.passes += 1
        frames = torch.full_like(inputs["memory", "frames"][:, :1], self.passes)
        return frames.expand(-1, self.spec.chunk, -1, -1, -1, -1), torch.zeros(len(inputs), 1)


@pytest.mark.parametrize(
    ("depth", "valid", "chosen", "passes"),
    [(0.0, 3, 0, 0), (0.4, 3, 1, 1), (0.99, 3, 2, 2), (0.99, 1, 0, 2), (0.6, 2, 1, 1), (0.99, 0, 0, 2)],
)
def test_passes_depend_on_the_depth_and_not_on_where_episodes_end(
    depth: float, valid: int, chosen: int, passes: int
) -> None:
    simulator = Counting(world_spec(ARM_DELTAS, chunk=4))
    clips = clip(simulator.spec, 2, 3, chunks=3)
    clips["depth"][:] = depth
    clips["future", "valid"][:, valid * 4 :] = False
    number, inputs = own_frames(simulator, clips, torch.Generator().manual_seed(0))
    assert (number, simulator.passes) == (chosen, passes)
    remembered = clips["memory"][:, chosen]
    own = (remembered["index"] - clips["begin"][:, None] - 1).div(4, rounding_mode="floor") + 1
    frames = inputs["memory", "frames"].flatten(2).float().mean(-1)
    true = remembered["frames"].flatten(2).float().mean(-1)
    assert torch.equal(frames, torch.where(own > 0, own.float(), true)) and own.max() == chosen
