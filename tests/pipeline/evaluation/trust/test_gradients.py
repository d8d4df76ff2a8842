"""The signal in gradients of noisy batches, and the direction it has, are found as they were made."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from pipeline.evaluation.trust.gradients import Measured, alignment, signal

SIZE, DECISIONS = 4000, 1280


def direction(seed: int) -> Tensor:
    vector = torch.randn(SIZE, generator=torch.Generator().manual_seed(seed))
    return vector / vector.norm()


def batches(true: Tensor, strength: float, count: int, seed: int) -> Tensor:
    """Gradients of unit variance per decision, of which `strength` is signal per 1000 decisions."""
    noise = torch.randn(count, SIZE, generator=torch.Generator().manual_seed(seed)) / SIZE**0.5
    return (strength / 1000) ** 0.5 * true + noise / DECISIONS**0.5


@pytest.mark.parametrize("strength", [0.03, 0.1, 0.5])
def test_signal_is_what_batches_share(strength: float) -> None:
    found = [signal(batches(direction(0), strength, 16, seed), DECISIONS) for seed in range(1, 6)]
    assert all(one.found for one in found)
    for one in found:
        assert abs(one.value - strength) < 4 * one.error < strength
    assert sum(one.value for one in found) / 5 == pytest.approx(strength, rel=0.1)


def test_noise_alone_has_none_and_no_direction() -> None:
    noise = batches(direction(0), 0.0, 16, 3)
    assert not signal(noise, DECISIONS).found
    assert alignment(noise, batches(direction(0), 0.5, 8, 4)) is None


@pytest.mark.parametrize("cosine", [0.0, 0.6, 1.0])
def test_noise_does_not_turn_the_true_directions_apart(cosine: float) -> None:
    one, other = direction(0), direction(1)
    other = cosine * one + (1 - cosine**2) ** 0.5 * (other - (other @ one) * one)
    found = alignment(batches(one, 0.1, 24, 5), batches(other, 0.1, 8, 6))
    assert found is not None and abs(found.value - cosine) < 3 * found.error < 0.3


def test_noise_of_the_same_decisions_is_left_out() -> None:
    """Or two ways to share out the same returns would agree by their noise."""
    mine = batches(direction(0), 0.1, 8, 7)
    theirs = mine - (0.1 / 1000) ** 0.5 * direction(0) + (0.1 / 1000) ** 0.5 * direction(1)
    found, naive = alignment(mine, theirs, apart=False), alignment(mine, theirs)
    assert isinstance(found, Measured) and isinstance(naive, Measured)
    assert abs(found.value) < 0.2 and naive.value > 0.5
