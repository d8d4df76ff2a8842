"""Your own simulator: the last frame, moved as one by what the actions say.

worldloop run experiment=smoke 'hydra.searchpath=[file://examples/configs]' simulator=shifting
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import Tensor, nn

from envs.conditioning import ActionVector
from envs.simulators.base import Simulator, to_bytes
from envs.simulators.inputs import build_inputs
from envs.specs import WorldSpec


class ShiftingWorld(Simulator):
    """Every view is shifted as a whole and brightened; a hundred weights, enough to see the contract.

    Args:
        spec: what it shows.
        memory_frames: sparse memory frames.
    """

    def __init__(self, spec: WorldSpec, memory_frames: int):
        super().__init__(spec, memory_frames)
        self.vector = ActionVector(spec.embodiment)
        self.head = nn.Linear(spec.chunk * self.vector.size, spec.chunk * spec.views * 3)
        nn.init.normal_(self.head.weight, std=1e-2)
        self.feature_shape = (spec.chunk * self.vector.size,)

    def normalise(self, commands: Tensor, moves: Tensor, states: Tensor) -> None:
        """See Simulator."""
        self.vector.normalise(commands, moves)

    def predict(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """See Simulator."""
        frames, features = self._draw(inputs)
        return to_bytes(frames), features

    def _draw(self, inputs: TensorDict) -> tuple[Tensor, Tensor]:
        """Frames float [B, K, V, 3, H, W] in about 0..1, and features."""
        actions = self.vector(inputs["future", "commands"], inputs["now", "command"]).flatten(1)
        moves = self.head(actions).unflatten(1, (self.spec.chunk, self.spec.views, 3))
        last = inputs["memory", "frames"][:, -1:].expand(-1, self.spec.chunk, -1, -1, -1, -1).float() / 255
        flat, shift = last.flatten(0, 2), moves.flatten(0, 2)
        theta = torch.eye(2, 3, device=flat.device).repeat(len(flat), 1, 1)
        theta[:, :, 2] = shift[:, :2]
        grid = F.affine_grid(theta, list(flat.shape), align_corners=False)
        drawn = (
            F.grid_sample(flat, grid, padding_mode="border", align_corners=False)
            + shift[:, 2, None, None, None]
        )
        return drawn.view_as(last), actions

    def loss(self, clip: TensorDict, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean squared error of the clip's first chunk."""
        drawn, _ = self._draw(build_inputs(self.spec, clip, 0))
        truth, valid = (clip["future", name][:, : self.spec.chunk] for name in ("frames", "valid"))
        gap = (drawn - truth.float() / 255).square().mean((2, 3, 4, 5)) * valid
        return gap.sum() / valid.sum().clamp(min=1), {}
