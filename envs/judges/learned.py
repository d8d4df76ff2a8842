"""The learned judge: each frame gets a success probability and a progress, from pixels and words alone.

The episode's first frame is shown beside each frame, because it says where things were before something moved
or hid them (GE-Sim 2.0 judges video so, with a large vision-language model).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.encoders.images import MultiViewEncoder, to_signed
from envs.encoders.language import TextEncoder
from envs.judges.fitted import FrameJudge
from envs.ranges import Count, Discount, Natural, Share
from envs.specs import WorldSpec

_TEXT = 32  # numbers that an instruction is encoded as


class LearnedJudge(FrameJudge):
    """Convolutional frame judge with a success and a progress head.

    Args:
        spec: what frames show; any number of views of any size.
        cameras: which it looks through: "all", "main", or names.
        hold, margin, discount: see FittedJudge.
        width: channels of the encoder at half resolution.
        points: soft key-points of the encoder.
        hidden: width of the last layers.
        instruction_keypoints: key-points per view that look for what the instruction says.
    """

    def __init__(
        self,
        spec: WorldSpec,
        hold: Count,
        margin: Share,
        discount: Discount,
        width: Count,
        points: Count,
        hidden: Count,
        cameras: str | Sequence[str],
        instruction_keypoints: Natural,
    ):
        super().__init__(hold, margin, discount)
        self.spec = spec
        self.encoder = MultiViewEncoder(
            spec,
            points,
            width,
            pictures=2,
            cameras=cameras,
            instruction_keypoints=instruction_keypoints,
            cond_dim=_TEXT,
        )
        self.instruction_keypoints = instruction_keypoints
        self.words = TextEncoder(_TEXT)
        self.head = nn.Sequential(
            nn.Linear(self.encoder.out_features + _TEXT, hidden),
            nn.SiLU(),
            nn.Linear(hidden, hidden),
            nn.SiLU(),
            nn.Linear(hidden, 2),
        )

    def forward(self, data: TensorDict) -> Tensor:
        """See FittedJudge; pictures may be uint8, or float in -1..1."""
        frames, first = data["frames"], data["first"]
        bytes_alone = frames.dtype == first.dtype == torch.uint8  # the encoder converts what it looks at
        both = (frames, first) if bytes_alone else (to_signed(frames), to_signed(first))
        words = self.words(data["text"])
        seen = self.encoder(torch.cat(both, 2), words if self.instruction_keypoints else None)
        logits: Tensor = self.head(torch.cat((seen, words), -1))
        return logits.float()
