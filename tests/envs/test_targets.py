"""Objects from config sections, and what is said of sections that cannot be built."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from envs.targets import ConfigError, build, options


@dataclass(frozen=True)
class Thing:
    """Something with two options and what it is told of its world."""

    spec: str
    size: tuple[int, int]
    nested: dict[str, Any]

    def __post_init__(self) -> None:
        if self.size[0] < 0:
            raise ValueError("size must not be negative")


HERE = "tests.envs.test_targets.Thing"


def test_lists_become_tuples_and_nested_sections_stay_dictionaries() -> None:
    made = build({"_target_": HERE, "size": [1, 2], "nested": {"a": [3]}}, "thing", spec="s")
    assert made == Thing("s", (1, 2), {"a": (3,)})
    assert options(Thing, {"spec": "s", "size": [1, 2], "nested": {}}, "thing").size == (1, 2)


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ({}, r"thing\._target_=None must be the import path"),
        ({"_target_": "Thing"}, r"thing\._target_='Thing' must be the import path"),
        ({"_target_": "nowhere.Thing"}, "nowhere.Thing does not import: No module named 'nowhere'"),
        ({"_target_": "tests.envs.test_targets.Think"}, "has no Think; did you mean Thing"),
        ({"_target_": HERE, "size": [1, 1], "nested": {}, "sise": 1}, r"thing\.sise .* did you mean size"),
        ({"_target_": HERE, "size": [1, 1]}, r"thing\.nested is missing"),
        (
            {"_target_": HERE, "size": [-1, 1], "nested": {}},
            r"size must not be negative \(.*test_targets\.py, line \d+\)",  # of somebody else's class
        ),
        ({"_target_": HERE, "size": [1, 1], "nested": {}, "spec": "x"}, r"thing\.spec is filled in"),
        ({"_target_": "fractions.Fraction"}, "takes no argument 'spec'"),
    ],
)
def test_what_cannot_be_built_is_named(section: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        build(section, "thing", spec="s")
