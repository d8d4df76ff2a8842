"""A reward from a network of its own that sees a picture and nothing else, as DiWA has it (RoboScape-R
compares its own reward with such a "proxy").

It is not told what the task is, nor how the episode began, so it can only know the task and the scenes that
it was fitted to.
"""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDict
from torch import Tensor, nn

from envs.encoders.images import to_signed
from envs.judges.fitted import FrameJudge
from envs.ranges import Count, Discount, Share
from envs.specs import WorldSpec

_GRID = 4  # rows and columns to which the features of a view are averaged


class ProxyJudge(FrameJudge):
    """A plain convolutional network on each view, and a perceptron on all of them.

    Args:
        spec: what frames show; any number of views of any size.
        hold, margin, discount: see FittedJudge.
        width: channels at half resolution; they double with every halving.
        halvings: of the resolution.
        hidden: width of the perceptron.
        cameras: which it looks through: "all", "main", or names.
    """

    reads_instruction = False

    def __init__(
        self,
        spec: WorldSpec,
        hold: Count,
        margin: Share,
        discount: Discount,
        width: Count,
        halvings: Count,
        hidden: Count,
        cameras: str | Sequence[str],
    ):
        super().__init__(hold, margin, discount)
        self.chosen = list(spec.embodiment.views_of(cameras))
        layers: list[nn.Module] = []
        channels = 3
        for level in range(halvings):
            wider = width * 2**level
            layers += [nn.Conv2d(channels, wider, 3, stride=2, padding=1), nn.SiLU()]
            channels = wider
        self.trunk = nn.Sequential(*layers, nn.AdaptiveAvgPool2d(_GRID), nn.Flatten())
        self.head = nn.Sequential(
            nn.Linear(len(self.chosen) * channels * _GRID**2, hidden), nn.SiLU(), nn.Linear(hidden, 2)
        )

    def forward(self, data: TensorDict) -> Tensor:
        """See FittedJudge; pictures may be uint8, or float in -1..1."""
        views = to_signed(data["frames"][:, self.chosen])
        seen = self.trunk(views.flatten(0, 1)).unflatten(0, views.shape[:2]).flatten(1)
        logits: Tensor = self.head(seen)
        return logits.float()
