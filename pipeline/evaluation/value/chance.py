"""What chance does to the agreement of values: how other starts would move each figure, what a perfect world
would show, and which policies the truth tells apart at all.

A finite number of episodes makes values of equal policies differ, so mean errors and rank violations are
above zero even where nothing is wrong.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.rng import resampling_generator
from pipeline.evaluation.statistics import mcnemar

if TYPE_CHECKING:
    from pipeline.evaluation.value.agreement import Cell

RESAMPLES = 1000
_LEVEL = 0.05
_SEED = 0
_RANGES = {"pearson": (-1.0, 1.0), "spearman": (-1.0, 1.0), "mmrv": (0.0, 1.0), "difference": (0.0, 1.0)}
_SIGNED = (-1.0, 1.0)  # of all others
Array = NDArray[np.float64]
Interval = tuple[float, float]


def mmrv(true: Array, estimated: Array) -> Array:
    """Mean maximum rank violation [...] of values [..., N]: for each policy the largest true difference to
    another that the estimates put on the other side of it, averaged. 0 is a ranking kept, and small ones
    matter little.
    """
    true, estimated = np.asarray(true, float), np.asarray(estimated, float)
    gap = np.abs(true[..., :, None] - true[..., None, :])
    less = [side[..., :, None] < side[..., None, :] for side in (estimated, true)]
    return np.asarray((gap * (less[0] != less[1])).max(-1).mean(-1))


def told_apart(cells: Sequence[Cell]) -> NDArray[np.bool_]:
    """Which pairs [N, N] of one task's cells differ in truth beyond chance: McNemar's test over the starts
    that were judged of both, p below .05.
    """
    out = np.zeros((len(cells), len(cells)), bool)
    for row, one in enumerate(cells):
        for column, other in enumerate(cells[:row]):
            both = one.judged.any(0) & other.judged.any(0)
            assert one.true is not None and other.true is not None
            out[row, column] = mcnemar(one.true[both], other.true[both])["p"] < _LEVEL
    return out | out.T


def intervals(tasks: Sequence[Sequence[Cell]], figures: Mapping[str, float | None]) -> dict[str, Interval]:
    """95% intervals of figures by a basic bootstrap over starts, the same ones for all policies of a task.

    Noise lifts mean errors and rank violations and lowers correlations, in a resample once more; a basic
    bootstrap (twice the figure less the quantiles) takes that off. An interval may leave out its figure.

    Args:
        tasks: cells with true values, by task; those of one task have the same starts.
        figures: their values; pearson, spearman, mmrv, difference, bias_in and bias_out, None if unknown.

    Returns:
        (low, high) of each figure that is known and changes with the starts.
    """
    generator = resampling_generator(_SEED)
    pairs = []
    for cells in tasks:
        count = cells[0].judged.shape[1]
        draws = torch.randint(count, (RESAMPLES, count), generator=generator)
        weight = torch.zeros(RESAMPLES, count, dtype=torch.float64)
        weight.scatter_add_(1, draws, torch.ones_like(weight))
        pairs.append(
            tuple(np.stack(side, 1) for side in zip(*(_values(c, weight) for c in cells), strict=True))
        )
    known = np.isfinite(np.concatenate([estimated for _, estimated in pairs], 1)).all(1)
    resampled = _figures([(true[known], estimated[known]) for true, estimated in pairs], tasks)
    out = {}
    for name, values in resampled.items():
        figure, finite = figures.get(name), values[np.isfinite(values)]
        if figure is None or 2 * len(finite) < RESAMPLES or np.ptp(finite) < 1e-12:
            continue
        low, high = 2 * figure - np.quantile(finite, [1 - _LEVEL / 2, _LEVEL / 2])
        out[name] = tuple(float(side) for side in np.clip((low, high), *_RANGES.get(name, _SIGNED)))
    return out  # type: ignore[return-value]


def by_chance(tasks: Sequence[Sequence[Cell]]) -> dict[str, float]:
    """Means of difference and mmrv in a perfect world, of as many episodes: each of them, true or imagined,
    succeeds by chance at its policy's true rate. Repeats that are alike count once. Where equal starts have
    equal outcomes it is less.
    """
    generator, pairs = resampling_generator(_SEED), []
    for cells in tasks:
        rate = torch.tensor([cell.matched for cell in cells], dtype=torch.float64)
        sides = []
        for count in ([int(c.judged.any(0).sum()) for c in cells], [_episodes(c) for c in cells]):
            of = torch.tensor(count, dtype=torch.float64).expand(RESAMPLES, -1)
            won = torch.binomial(of, rate.expand_as(of).contiguous(), generator=generator)
            sides.append((won / of).numpy())
        pairs.append((sides[0], sides[1]))
    found = _figures(pairs, tasks)
    return {name: float(found[name].mean()) for name in ("difference", "mmrv")}


def _episodes(cell: Cell) -> int:
    """Judged imagined episodes of the repeats that are unlike."""
    judged = cell.judged
    unlike = torch.cat((judged, cell.imagined & judged), 1).unique(dim=0)
    return int(unlike[:, : judged.shape[1]].sum())


def _values(cell: Cell, weight: Tensor) -> tuple[Array, Array]:
    """`matched` and `estimated` of a cell, [S] each, of starts weighed as [S, N] says; NaN where none of them
    could be judged.
    """
    assert cell.true is not None
    of = weight @ cell.judged.double().T  # [S, R]
    shares = [
        (weight @ (outcome & cell.judged).double().T / of).nanmean(1).numpy()
        for outcome in (cell.true.expand_as(cell.judged), cell.imagined)
    ]
    return shares[0], shares[1]


def _figures(pairs: Sequence[tuple[Array, Array]], tasks: Sequence[Sequence[Cell]]) -> dict[str, Array]:
    """Figures of `intervals`, [S] each, of (true, estimated) values [S, N] by task; NaN where they cannot be
    told.
    """
    true, estimated = (np.concatenate(side, 1) for side in zip(*pairs, strict=True))
    off = estimated - true
    inside = np.array([cell.inside for cells in tasks for cell in cells])
    out = {
        "pearson": _correlations(true, estimated),
        "spearman": _correlations(
            scipy.stats.rankdata(true, axis=1), scipy.stats.rankdata(estimated, axis=1)
        ),
        "mmrv": np.mean([mmrv(*pair) for pair in pairs], 0),
        "difference": np.abs(off).mean(1),
    }
    sides = (("bias_in", inside), ("bias_out", ~inside))
    return out | {name: off[:, some].mean(1) for name, some in sides if some.any()}


def _correlations(one: Array, other: Array) -> Array:
    """Pearson's of rows [S, N], [S]; NaN where a side does not vary."""
    one, other = (side - side.mean(1, keepdims=True) for side in (one, other))
    size = np.sqrt(np.square(one).sum(1) * np.square(other).sum(1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.where(size > 1e-12, (one * other).sum(1) / size, np.nan)
