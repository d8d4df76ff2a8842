"""Where scores say that something is as likely as not."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.special import expit
from torch import Tensor


def as_likely_as_not(score: Tensor, true: Tensor) -> float | None:
    """The score, 0.02..1, at which an outcome is as likely true as not, near 1 if none that occurs does so.

    The likelihood is logistic in the logit of the score (Platt 1999, with his targets, which keep it finite
    where scores part the outcomes): it uses all of them, where a threshold of best accuracy jumps with a few.
    Outcomes that are mostly true weigh no more than the others: the better the examples, the more lenient
    the threshold would be, and it is used on what is not as good.

    Args:
        score: float64 [N] in 0..1.
        true: bool [N].

    Returns:
        None where no outcome is true, or all are, or scores do not rise with them.
    """
    hits = float(true.sum())
    if hits in (0.0, float(len(true))):
        return None
    logits = torch.logit(score.clamp(0.01, 0.99)).numpy()
    if logits.min() == logits.max():  # any slope fits a constant
        return None
    misses = len(true) - hits
    targets = torch.where(true, (hits + 1) / (hits + 2), 1 / (misses + 2)).double().numpy()
    weights = torch.where(true, min(1.0, misses / hits), 1.0).double().numpy()

    def misfit(line: Any) -> tuple[float, Any]:
        logit = line[0] * logits + line[1]
        value = (weights * (np.logaddexp(0, logit) - targets * logit)).mean()
        gap = weights * (expit(logit) - targets)
        return float(value), [(gap * logits).mean(), gap.mean()]

    slope, offset = minimize(misfit, [1.0, 0.0], jac=True).x
    return None if slope <= 0 else float(expit(-offset / slope).clip(0.02, 1.0))
