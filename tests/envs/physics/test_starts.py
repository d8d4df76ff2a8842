"""Inner and outer starts."""

from __future__ import annotations

import numpy as np
import pytest

from envs.physics.starts import belongs, check_starts
from envs.targets import ConfigError


@pytest.mark.parametrize(
    ("drawn", "inner"),
    [
        ((0.5, -1.0, 7.0), True),
        ((0.11, -1.79, 7.0), True),
        ((0.09, -1.0, 7.0), False),
        ((0.5, -0.05, 7.0), False),
    ],
)
def test_a_start_with_a_number_near_the_end_of_its_range_is_an_outer_one(
    drawn: tuple[float, ...], inner: bool
) -> None:
    low, high = np.array([0.0, -2.0, 7.0]), np.array([1.0, 0.0, 7.0])  # the last is always the same
    asked = {starts: belongs(starts, np.array(drawn), low, high) for starts in ("all", "inner", "outer")}
    assert asked == {"all": True, "inner": inner, "outer": not inner}


def test_unknown_choices_are_named() -> None:
    with pytest.raises(ConfigError, match=r"task\.suite\.starts holds 'iner', .* \['inner'"):
        check_starts("iner")
