"""Which cases of a test `make test` runs; the others are `long`, and `make test-all` has them.

A case is a tuple of values, or one value; one value that is a tuple is a tuple of that one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def every(number: int, cases: Iterable[Any]) -> list[Any]:
    """Cases of which every so many stays, beginning with the first.

    Of a product of engines and robots each engine and each robot stays with some of the others, where
    `number` and the count of robots have no common divisor.
    """
    return [_case(case, place % number == 0) for place, case in enumerate(cases)]


def those(kept: Collection[Any], cases: Iterable[Any]) -> list[Any]:
    """Cases of which those that are named stay.

    Raises:
        ValueError: where one that is named is none of them.
    """
    cases = list(cases)
    if missing := [case for case in kept if case not in cases]:
        raise ValueError(f"{missing} are none of {cases}")
    return [_case(case, case in kept) for case in cases]


def _case(case: Any, stays: bool) -> Any:
    values = case if isinstance(case, tuple) else (case,)
    return pytest.param(*values, marks=() if stays else pytest.mark.long)
