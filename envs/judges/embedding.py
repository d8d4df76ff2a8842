"""A reward head on the simulator's own features, as iVideoGPT has it (RoboScape-R compares its own reward
with such an "embedding" reward).

It looks at no pixel: what the simulator made of the past and the chunk's actions is all that it is told of
the video, so it is fitted to one simulator, and video has to come with that simulator's features.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from envs.encoders.language import TextEncoder
from envs.judges.base import Judgement, features_of_all
from envs.judges.fitted import FittedJudge
from envs.ranges import Count, Discount, Share
from envs.simulators.features import pooled_size
from envs.specs import WorldSpec, text_to_bytes


class EmbeddingJudge(FittedJudge):
    """Success and progress of every frame of a chunk, from the chunk's pooled features and the instruction.

    Args:
        spec: what frames show.
        feature_shape: of the simulator's features of a chunk.
        hold, margin, discount: see FittedJudge.
        text: size of the encoded instruction.
        hidden: width of the hidden layer.
    """

    reads_features = True

    def __init__(
        self,
        spec: WorldSpec,
        feature_shape: Sequence[int],
        hold: Count,
        margin: Share,
        discount: Discount,
        text: Count,
        hidden: Count,
    ):
        super().__init__(hold, margin, discount)
        self.chunk = spec.chunk
        size = pooled_size(feature_shape)
        self.norm = nn.LayerNorm(size)
        self.words = TextEncoder(text)
        self.head = nn.Sequential(
            nn.Linear(size + text, hidden), nn.SiLU(), nn.Linear(hidden, 2 * self.chunk)
        )

    def forward(self, data: TensorDict) -> Tensor:
        """See FittedJudge."""
        rows = torch.arange(len(data), device=data["offset"].device)
        return self._chunks(data["features"], data["text"])[rows, data["offset"]]

    @torch.no_grad()
    def score(
        self, frames: Tensor, first: Tensor, instruction: list[str], features: Tensor | None = None
    ) -> Judgement:
        """See Judge.score; of frames and first only the number counts.

        Raises:
            MissingFeatures: without features of all frames.
        """
        count = frames.shape[1]
        features = features_of_all(features, count, self.chunk, "embedding", "learned")
        text = text_to_bytes(instruction).to(self.threshold.device)
        each = features.shape[1]
        seen = features.flatten(0, 1).to(self.threshold.device)
        logits = self._chunks(seen, text.repeat_interleave(each, 0)).unflatten(0, (-1, each)).flatten(1, 2)
        return self.judgement(logits[:, :count].to(frames.device))

    def _chunks(self, features: Tensor, text: Tensor) -> Tensor:
        """Logits float32 [N, K, 2] of all frames of chunks with features [N, D] and text [N, TEXT_BYTES]."""
        logits: Tensor = self.head(torch.cat((self.norm(features), self.words(text)), -1))
        return logits.float().unflatten(-1, (self.chunk, 2))
