"""Is the scene kept (EWMBench: scene consistency), and do samples differ (diversity)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class Scene:
    """Mean cosine of the patches of each frame to those of the frame before and of the first, the mean of
    both, and how many frames were compared: all but the first.
    """

    previous: float
    first: float
    score: float
    frames: int


def scene_consistency(patches: Tensor, strict_parity: bool) -> Scene:
    """Of the frames of one video.

    Args:
        patches: float32 [T, P, D] of one extractor.
        strict_parity: compare as the public code does: for each feature the values of all patches, instead of
            for each patch the values of all features; and no frame counts less than 0.

    Raises:
        ValueError: for fewer than two frames.
    """
    if len(patches) < 2:
        raise ValueError(f"scene consistency compares frames, and there are {len(patches)}")
    unit = functional.normalize(patches, dim=-1)
    axis = 1 if strict_parity else 2

    def alike(one: Tensor, other: Tensor) -> float:
        cosines = functional.cosine_similarity(one, other, dim=axis).mean(-1)
        return float((cosines.clamp(min=0) if strict_parity else cosines).mean())

    previous, first = alike(unit[1:], unit[:-1]), alike(unit[1:], unit[:1].expand_as(unit[1:]))
    return Scene(previous, first, (previous + first) / 2, len(unit) - 1)


def diversity(embeddings: Tensor) -> float | None:
    """1 - mean cosine of all pairs of samples' embeddings [S, D]; None of fewer than two samples."""
    count = len(embeddings)
    if count < 2:
        return None
    unit = functional.normalize(embeddings.double(), dim=-1)
    alike = unit @ unit.T
    return float(1 - (alike.sum() - alike.diagonal().sum()) / (count * (count - 1)))


def video_embedding(features: Tensor, strict_parity: bool) -> Tensor:
    """One embedding [D] of a video's features [T, V, D]: their mean; with strict_parity that of features of
    length 1, as in the public code.
    """
    each = features.flatten(0, 1)
    return (functional.normalize(each, dim=-1) if strict_parity else each).mean(0)


def mean_scene(rows: list[Scene]) -> Scene | None:
    """Means over the views of a video."""
    if not rows:
        return None
    table = torch.tensor([[row.previous, row.first, row.score] for row in rows], dtype=torch.float64)
    previous, first, score = table.mean(0).tolist()
    return Scene(previous, first, score, rows[0].frames)
