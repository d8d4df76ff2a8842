"""Which of the starts that a bench draws are laid out, so that some stay unseen in training."""

from __future__ import annotations

import numpy as np

from envs.physics.suite import Array, check_names

STARTS = ("all", "inner", "outer")
_INNER = 0.8  # of each number's range, in its middle
_TELLING = 0.1  # of the widest range; what is drawn from less, such as from a millimetre, is no other start


def check_starts(starts: str) -> None:
    """Refuse an unknown choice of starts.

    Raises:
        SuiteError: naming the choices.
    """
    check_names("task.suite.starts", [starts], STARTS)


def belongs(starts: str, drawn: Array, low: Array, high: Array) -> bool:
    """Whether a start is one of those chosen: "inner" has every number in the middle of its range, "outer" at
    least one near an end, "all" is both.

    Args:
        starts: one of STARTS.
        drawn: [n], what was drawn, such as coordinates in metres.
        low, high: [n], between which that was drawn evenly; a number whose range is empty, or less than a
            tenth of the widest, says nothing.
    """
    ranges = np.subtract(high, low)
    telling = (ranges > 0) & (ranges >= _TELLING * ranges.max())
    off_middle = np.abs(2 * np.subtract(drawn, low) - ranges) / np.where(telling, ranges, np.inf)
    return starts == "all" or bool((off_middle > _INNER).any()) == (starts == "outer")
