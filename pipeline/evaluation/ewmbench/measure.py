"""Measures videos, generated and recorded alike: the same instruments look at both."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pipeline.evaluation.ewmbench.features import PatchExtractor
from pipeline.evaluation.ewmbench.records import Record
from pipeline.evaluation.ewmbench.scene import Scene, scene_consistency, video_embedding
from pipeline.evaluation.ewmbench.semantics import Reader
from pipeline.evaluation.fidelity.extractors import Extractor
from pipeline.evaluation.grippers.detector import GripperDetector


@dataclass(frozen=True)
class Instruments:
    """What videos are looked at with.

    Args:
        patches: of scene consistency.
        frames: of whole videos, for diversity.
        views: positions of the cameras whose video counts.
        detector: of grippers; None where there can be none.
        detected: positions of the cameras that it looks through, in its order.
        reader: asks a vision-language model; None without one.
        strict_parity: see scene.scene_consistency and scene.video_embedding.
    """

    patches: PatchExtractor
    frames: Extractor
    views: tuple[int, ...]
    detector: GripperDetector | None
    detected: tuple[int, ...]
    reader: Reader | None
    strict_parity: bool

    def measure(self, videos: Sequence[Tensor]) -> list[Record]:
        """What can be said of videos uint8 [T, V, 3, H, W] of two frames or more.

        Raises:
            JudgeError: if the vision-language model cannot be asked any more.
        """
        read: Iterable[Any] = [None] * len(videos)
        if self.reader is not None:
            read = self.reader.read([video.numpy() for video in videos])
        return [
            Record(self._scene(video), self._embedding(video), self.tracks(video), report)
            for video, report in zip(videos, read, strict=True)
        ]

    def tracks(self, video: Tensor) -> Tensor | None:
        """Pixels float32 [T, V, arms, 2] of grippers in a video; None without a detector."""
        if self.detector is None:
            return None
        return self.detector.detect(video[:, list(self.detected)], torch.arange(len(self.detected)))

    def _scene(self, video: Tensor) -> tuple[Scene, ...]:
        return tuple(
            scene_consistency(self.patches(video[:, view]), self.strict_parity) for view in self.views
        )

    def _embedding(self, video: Tensor) -> Tensor:
        seen = video[:, list(self.views)]
        features = self.frames(seen.flatten(0, 1)).unflatten(0, seen.shape[:2])
        return video_embedding(features, self.strict_parity)
