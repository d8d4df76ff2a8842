"""The done head of RoboScape-R's worlds: whether the task is done in a frame, by means over its places."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from envs.simulators.row_linear import RowLinear
from envs.specs import WorldSpec
from envs.targets import ConfigError


def done_head(width: int) -> nn.Sequential:
    """Logit [..., 1] of a frame's features [..., width]."""
    return nn.Sequential(nn.LayerNorm(width), RowLinear(width, width), nn.SiLU(), RowLinear(width, 1))


class ChunkDone(nn.Module):
    """Probability [N, K] that the task is done in each frame of a chunk, by its features [N, D].

    Args:
        spec: what is shown.
        feature_shape: of a chunk's features, (D,): the means over the places of each frame, and of each view
            of the last one (TokensSimulator).

    Raises:
        ConfigError: if features are not of that form.
    """

    def __init__(self, spec: WorldSpec, feature_shape: Sequence[int]):
        super().__init__()
        self.chunk = spec.chunk
        self.width, rest = divmod(feature_shape[-1], spec.chunk + spec.views)
        if len(feature_shape) != 1 or rest or not self.width:
            raise ConfigError(
                f"features {list(feature_shape)} are not those of simulator=tokens, whose own word counts"
                " under judge=golden_goal_action; choose that simulator, or judge=golden_goal"
            )
        self.head = done_head(self.width)

    def forward(self, features: Tensor) -> Tensor:
        frames = features[:, : self.chunk * self.width].unflatten(1, (self.chunk, self.width))
        return self.head(frames).float().sigmoid().squeeze(-1)
