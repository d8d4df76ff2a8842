"""Noise on scripted behaviours is the same at any rate of actions, and never what it must not be."""

from __future__ import annotations

import numpy as np
import pytest

from envs.physics.noise import Drift, Interruptions


@pytest.mark.parametrize("period", [0.05, 0.1, 0.2])
def test_a_drift_has_its_spread_and_forgets_in_seconds(period: float) -> None:
    drift = Drift(2.0, (400,), np.random.default_rng(0), period)
    for _ in range(round(4.0 / period)):
        drift()
    before = drift().copy()
    for _ in range(round(0.4 / period)):
        after = drift()
    assert after.std() == pytest.approx(2.0, rel=0.15)
    assert np.corrcoef(before, after)[0, 1] == pytest.approx(0.8**4, abs=0.15)


@pytest.mark.parametrize("period", [0.05, 0.1, 0.2])
def test_interruptions_come_as_often_and_last_as_long_at_any_rate(period: float) -> None:
    drawn: list[float] = []
    rng = np.random.default_rng(0)
    interruptions = Interruptions[float](0.7, 0.6, rng, period)

    def draw() -> float:
        drawn.append(rng.random())
        return drawn[-1]

    seen = [interruptions(draw) for _ in range(round(2000 / period))]
    frames = round(0.6 / period)
    assert sum(value is not None for value in seen) in range(
        len(drawn) * frames - frames, len(drawn) * frames + 1
    )
    # 0.1 per 0.1 s at level 1 falls with the level's square; while one lasts none begins
    waiting = 2000 - (0.6 - period) * len(drawn)
    assert len(drawn) / waiting == pytest.approx(0.49, rel=0.1)
    first = next(k for k, value in enumerate(seen) if value is not None)
    assert set(seen[first : first + frames]) == {drawn[0]}


def test_the_ends_of_the_scale() -> None:
    never, always = (Interruptions[int](level, 0.6, np.random.default_rng(0), 0.1) for level in (0.0, 1.0))
    assert {never(lambda: 1) for _ in range(500)} == {None}
    assert [always(iter(range(9)).__next__) for _ in range(6)] == [0] * 6
    with pytest.raises(ValueError, match=r"noise_level=1.5"):
        Interruptions[int](1.5, 0.6, np.random.default_rng(0), 0.1)
