"""Median and 90th percentile of measured errors."""

from __future__ import annotations

import torch
from torch import Tensor

_MOST = 1_000_000  # values looked at; torch.quantile takes 16 M, and a million says the same


def quantiles(values: Tensor) -> dict[str, float]:
    """{"median", "p90"} of the finite values [N], NaN where there is none."""
    values = values[torch.isfinite(values)]
    if not len(values):
        return {"median": float("nan"), "p90": float("nan")}
    values = values[:: len(values) // _MOST + 1]
    return {"median": float(values.median()), "p90": float(values.quantile(0.9))}
