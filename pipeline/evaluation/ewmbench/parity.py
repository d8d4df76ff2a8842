"""What EWMBench's public code takes for an arm's travel and track, faults included (strict_parity)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist

NOWHERE = -1.0  # both coordinates of a gripper that was not found


def public_travel(track: NDArray[np.floating[Any]]) -> float:
    """How far a track [T, 2] reaches: the longest side of its convex hull, or the way from the hull's first
    corner to its third, if that is longer.

    The public code means the largest distance of two points, by rotating calipers, and turns their test
    round: counter-clockwise, a side turns left of the one before, and so a leg that should go on to the
    opposite corner never gets beyond the next one. Which corner is the first is up to Qhull.

    Points on one line have no hull: the public code stops there, and this is their largest distance.
    """
    try:
        corners = track[ConvexHull(track).vertices]  # counter-clockwise
    except QhullError:
        return float(cdist(track, track).max())
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return max(float(sides.max()), float(np.linalg.norm(corners[2] - corners[0])))


def unfilled(track: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """A track [T, 2] with (NOWHERE, NOWHERE) in its gaps, as the public code compares one that is hardly
    known.
    """
    return np.where(np.isfinite(track).all(-1, keepdims=True), track, NOWHERE).astype(track.dtype)
