"""Frechet distances between Gaussians over features, as FID and FVD are; never between different features."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pipeline.evaluation.fidelity.extractors import Extractor


class Moments:
    """Mean and covariance of an extractor's features, gathered part by part, float64.

    Args:
        extractor: whose features they are.
    """

    def __init__(self, extractor: Extractor):
        self.extractor, self.count = extractor, 0
        self._sum = self._outer = torch.zeros(())

    def add(self, pictures: Tensor) -> None:
        """Take in pictures or clips, as the extractor takes them."""
        self.take(self.extractor(pictures))

    def take(self, features: Tensor) -> None:
        """Take in what the extractor said, float32 [N, D]."""
        features = features.double()
        self.count += len(features)
        self._sum = self._sum + features.sum(0)
        self._outer = self._outer + features.T @ features

    @property
    def mean(self) -> Tensor:
        """[D]."""
        return self._sum / self.count

    @property
    def covariance(self) -> Tensor:
        """[D, D], unbiased."""
        centred = self._outer - self.count * torch.outer(self.mean, self.mean)
        return centred / (self.count - 1)


def frechet(made: Moments, true: Moments) -> dict[str, Any]:
    """{"extractor", "value", "dim", "samples"}: the squared Frechet distance of two Gaussians (Dowson and
    Landau 1982), |mean - mean|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)).

    It is biased upwards where samples are few; compare figures of equal numbers of them alone.

    Raises:
        ValueError: if the features are of different extractors, or of fewer than two samples.
    """
    if made.extractor.name != true.extractor.name:
        raise ValueError(
            f"features of {made.extractor.name!r} and of {true.extractor.name!r} have no distance; use one"
            " extractor for both"
        )
    if min(made.count, true.count) < 2:
        raise ValueError(f"a covariance needs two samples at least, not {made.count} and {true.count}")
    root = _root(made.covariance)
    cross = torch.linalg.eigvalsh(root @ true.covariance @ root).clamp(min=0).sqrt().sum()
    spread = made.covariance.trace() + true.covariance.trace() - 2 * cross
    value = (made.mean - true.mean).square().sum() + spread
    return {
        "extractor": made.extractor.name,
        "value": max(0.0, float(value)),
        "dim": len(made.mean),
        "samples": made.count,
    }


def _root(matrix: Tensor) -> Tensor:
    """The square root of a symmetric positive semidefinite matrix."""
    values, vectors = torch.linalg.eigh((matrix + matrix.T) / 2)
    return (vectors * values.clamp(min=0).sqrt()) @ vectors.T
