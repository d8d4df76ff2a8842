"""How far a generated trajectory is from the true one in space (SA), order (TA) and dynamics (DYN).

Distances are in shares of the picture's width. Scores are those of EWMBench's paper, 1 / (distance + eps) and
DYN, cut off at the public code's caps and divided by them: 0..1, and 1 for what is closer than a detector
can tell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from pipeline.evaluation.ewmbench.parity import public_travel, unfilled

Floats = NDArray[np.floating[Any]]
EPS = 1e-8
VELOCITY, ACCELERATION = 0.007, 0.003  # weights in DYN
CAPS = {"sa": 24.979, "ta": 50.202, "dyn": 22.519}
MOST_MISSING = 0.8  # share of frames without a detection beyond which there is no trajectory
STILL = 0.02  # widths of a picture: the travel of an arm that stands still, as a detector trembles


@dataclass(frozen=True)
class Scores:
    """Of one sample, or means of several.

    Args:
        sa, ta, dyn: 0..1, more is better.
        hsd, ndtw: distances in shares of the picture's width, or as strict_parity has it; None where there is
            no trajectory.
        missing: share of the generated frames in which no gripper was found.
        lost: share of the cameras in which the generated video has no trajectory.
    """

    sa: float
    ta: float
    dyn: float
    hsd: float | None
    ndtw: float | None
    missing: float
    lost: float

    def row(self) -> dict[str, float | None]:
        """As JSON."""
        return asdict(self)


def fill_gaps(track: Floats) -> Floats | None:
    """A track [T, 2] whose gaps (NaN) are filled linearly, and with the nearest point before the first and
    after the last; None if more than MOST_MISSING of it is missing.
    """
    seen = np.isfinite(track).all(-1)
    if not seen.any() or 1 - seen.mean() > MOST_MISSING:
        return None
    at = np.arange(len(track))
    filled = [np.interp(at, at[seen], track[seen, k]) for k in range(track.shape[1])]
    return np.stack(filled, -1).astype(track.dtype)


def travel(track: Floats) -> float:
    """The largest distance between two points of a track [T, 2]."""
    return float(cdist(track, track).max())


def hausdorff(one: Floats, other: Floats) -> float:
    """Symmetric Hausdorff distance of tracks [T, 2] and [U, 2]: the farthest that a point of either is from
    the other.
    """
    apart = cdist(one, other)
    return float(max(apart.min(1).max(), apart.min(0).max()))


def normalised_dtw(one: Floats, other: Floats) -> float:
    """Dynamic time warping: the least sum of distances along a path that pairs both tracks' points in order,
    divided by the path's length. Of equal paths the one with more diagonal steps is taken.
    """
    apart = cdist(one, other)
    cost = np.full((len(one) + 1, len(other) + 1), np.inf)
    steps = np.zeros_like(cost, dtype=np.int64)
    cost[0, 0] = 0.0
    for i in range(1, len(one) + 1):
        for j in range(1, len(other) + 1):
            before = min(((i - 1, j - 1), (i - 1, j), (i, j - 1)), key=lambda at: cost[at])
            cost[i, j] = apart[i - 1, j - 1] + cost[before]
            steps[i, j] = 1 + steps[before]
    return float(cost[-1, -1] / steps[-1, -1])


def dynamics(one: Floats, other: Floats, strict_parity: bool) -> float:
    """DYN of tracks [T, 2] and [U, 2] of three points or more: for speed and its change from frame to frame,
    the ratio of their spans over the Wasserstein distance of their values.

    Equal values have a distance of 0, for which the public code gives 0, a fault that strict_parity keeps.
    Else distances count as one at least at which both halves together come to the cap, so neither stands in
    for the other.
    """
    score, least = 0.0, (VELOCITY + ACCELERATION) / CAPS["dyn"]
    speeds = [np.linalg.norm(np.diff(track, axis=0), axis=1) for track in (one, other)]
    for weight, (a, b) in ((VELOCITY, speeds), (ACCELERATION, [np.diff(speed) for speed in speeds])):
        spans = sorted((float(np.ptp(a)), float(np.ptp(b))))
        ratio = (spans[0] + EPS) / (spans[1] + EPS)
        distance = float(scipy.stats.wasserstein_distance(a, b))
        if not strict_parity:
            score += weight * ratio / max(distance, least)
        elif distance:
            score += weight * ratio / distance
    return score


def scores(made: Floats, true: Floats, size: tuple[int, int], strict_parity: bool) -> Scores | None:
    """Scores of a generated against the true trajectory; they may be of different lengths.

    Every arm counts: distances are means over the arms, DYN over those that truly move.

    With strict_parity all is as in the public code, in float32. Pictures' width and height both count 1. Only
    the arm counts that it takes for the one with the longest true travel (parity.public_travel). That arm is
    counted among those that have a true track, a fault where one has none: an arm may be taken whose truth is
    mostly (-1, -1). What matches perfectly in its dynamics gets 0. Dynamic time warping alone is exact, where
    the public code approximates it.

    Args:
        made, true: [T, arms, 2] and [U, arms, 2] in pixels, NaN where nothing was found.
        size: (height, width) of the pictures.

    Returns:
        None if no arm has a true trajectory.

    Raises:
        ValueError: if arms differ in number, or there are fewer than three frames.
    """
    if made.ndim != 3 or made.shape[1:] != true.shape[1:]:
        raise ValueError(
            f"trajectories are [T, arms, 2] of the same arms, here {made.shape} and {true.shape}; detect both"
            " by one detector"
        )
    if min(len(made), len(true)) < 3:
        raise ValueError(
            f"accelerations need three frames at least, not {len(made)} and {len(true)}; choose longer"
            " episodes"
        )
    height, width = size
    unit = np.array((width, height) if strict_parity else (width, width), float)
    kind = np.float32 if strict_parity else np.float64
    truth = [(track / unit).astype(kind) for track in true.swapaxes(0, 1)]
    wanted = [fill_gaps(track) for track in truth]
    found = [fill_gaps((track / unit).astype(kind)) for track in made.swapaxes(0, 1)]
    known = [arm for arm, track in enumerate(wanted) if track is not None]
    if not known:
        return None
    reach = public_travel if strict_parity else travel
    travels = [reach(wanted[arm]) for arm in known]  # type: ignore[arg-type]
    if strict_parity:
        chosen = moving = [int(np.argmax(travels))]
        wanted = [unfilled(truth[arm]) if track is None else track for arm, track in enumerate(wanted)]
    else:
        chosen = known
        moving = [arm for arm, far in zip(known, travels, strict=True) if far > STILL] or known
    missing = float(1 - np.isfinite(made[:, chosen]).all(-1).mean())
    pairs = {arm: (found[arm], wanted[arm]) for arm in chosen}
    if any(track is None for pair in pairs.values() for track in pair):
        return Scores(0.0, 0.0, 0.0, None, None, missing, lost=1.0)
    far = float(np.mean([hausdorff(*pairs[arm]) for arm in chosen]))  # type: ignore[arg-type]
    late = float(np.mean([normalised_dtw(*pairs[arm]) for arm in chosen]))  # type: ignore[arg-type]
    moved = [_capped("dyn", dynamics(*pairs[arm], strict_parity)) for arm in moving]  # type: ignore[arg-type]
    return Scores(
        sa=_capped("sa", _inverse(far)),
        ta=_capped("ta", _inverse(late)),
        dyn=float(np.mean(moved)),
        hsd=far,
        ndtw=late,
        missing=missing,
        lost=0.0,
    )


def mean_scores(rows: list[Scores]) -> Scores | None:
    """Means over cameras, samples or episodes; distances over those that have any."""
    if not rows:
        return None
    values: Mapping[str, list[float | None]] = {
        name: [getattr(row, name) for row in rows] for name in Scores.__dataclass_fields__
    }
    means = {}
    for name, some in values.items():
        known = [value for value in some if value is not None]
        means[name] = float(np.mean(known)) if known else None
    return Scores(**means)  # type: ignore[arg-type]


def best_of(samples: list[Scores]) -> int:
    """The position of the sample with the least Hausdorff distance among those that lost their grippers in
    the fewest cameras: a distance is a mean over the others, and hides that. Of equal samples the first.
    """
    ranks = [(sample.lost, np.inf if sample.hsd is None else sample.hsd) for sample in samples]
    return ranks.index(min(ranks))


def _inverse(distance: float) -> float:
    return 1 / (distance + EPS)


def _capped(name: str, score: float) -> float:
    return float(min(score, CAPS[name]) / CAPS[name])
