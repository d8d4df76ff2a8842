"""Statistics of a LeRobot data set, of each episode and of all together, as in LeRobot's meta/stats.json.

Each feature has min, max, mean, std, count and the quantiles q01 q10 q50 q90 q99; pictures per channel in
0..1 with shape [3, 1, 1].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_PICTURES = 8  # of an episode that are looked at


def column_stats(values: NDArray[Any]) -> dict[str, list[Any]]:
    """Statistics of a column [T] or [T, n], each a list of n."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    stats = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    stats |= dict(zip(QUANTILES, np.quantile(rows, list(QUANTILES.values()), axis=0), strict=True))
    return {**{name: value.tolist() for name, value in stats.items()}, "count": [len(rows)]}


def picture_stats(frames: NDArray[np.uint8]) -> dict[str, list[Any]]:
    """Statistics per channel of some of a camera's frames uint8 [T, 3, H, W], in 0..1."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(_PICTURES, len(frames))).round().astype(int))
    levels = np.arange(256) / 255.0
    columns: dict[str, list[Any]] = {name: [] for name in ("min", "max", "mean", "std", *QUANTILES)}
    for channel in range(3):
        counts = np.bincount(frames[chosen, channel].reshape(-1), minlength=256)
        share, found = counts / counts.sum(), np.flatnonzero(counts)
        mean = float(share @ levels)
        values = {
            "min": levels[found[0]],
            "max": levels[found[-1]],
            "mean": mean,
            "std": float(np.sqrt(share @ (levels - mean) ** 2)),
        }
        below = share.cumsum()
        values |= {
            name: levels[min(int(np.searchsorted(below, part)), 255)] for name, part in QUANTILES.items()
        }
        for name, value in values.items():
            columns[name].append([[float(value)]])
    return {**columns, "count": [len(chosen)]}


def merge_stats(episodes: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Statistics of a data set from its episodes' metadata rows, whose keys are stats/<feature>/<statistic>.

    Quantiles of the whole cannot be had from those of its parts; as LeRobot does, the lowest of the lower and
    the highest of the upper ones stand for them.
    """
    named = {key[len("stats/") : -len("/mean")] for key in episodes[0] if key.endswith("/mean")}
    merged = {}
    for name in sorted(key for key in named if f"stats/{key}/count" in episodes[0]):
        rows = [row for row in episodes if row.get(f"stats/{name}/mean") is not None]

        def of(stat: str, rows: list[Mapping[str, Any]] = rows, name: str = name) -> NDArray[np.float64]:
            return np.array([row[f"stats/{name}/{stat}"] for row in rows], np.float64)

        count, mean, std = of("count").reshape(-1), of("mean"), of("std")
        share = (count / count.sum()).reshape(-1, *([1] * (mean.ndim - 1)))
        total = (mean * share).sum(0)
        stats = {
            "min": of("min").min(0),
            "max": of("max").max(0),
            "mean": total,
            "std": np.sqrt((share * (std**2 + (mean - total) ** 2)).sum(0)),
            "count": np.array([int(count.sum())]),
        }
        for quantile, part in QUANTILES.items():
            if all(row.get(f"stats/{name}/{quantile}") is not None for row in rows):
                values = of(quantile)
                stats[quantile] = values.min(0) if part <= 0.5 else values.max(0)
        merged[name] = {stat: value.tolist() for stat, value in stats.items()}
    return merged
