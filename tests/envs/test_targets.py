"""Objects from config sections, and what is said of sections that cannot be built."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from envs.physics.suite import SuiteError
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
        if "file" in self.nested:
            open(self.nested["file"]).close()
        if "key" in self.nested:
            {}[self.nested["key"]]


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
        (
            {"_target_": HERE, "size": [1, 1], "nested": {"file": "/nowhere/robot.xml"}},
            rf"^thing \({HERE}\): .*No such file or directory: '/nowhere/robot\.xml' \(.*, line \d+\)$",
        ),
        (
            {"_target_": HERE, "size": [1, 1], "nested": {"key": "arm"}},
            rf"^thing \({HERE}\): KeyError: 'arm' \(.*test_targets\.py, line \d+\)$",
        ),
        ({"_target_": HERE, "size": [1, 1], "nested": {}, "spec": "x"}, r"thing\.spec is filled in"),
        ({"_target_": "fractions.Fraction"}, "takes no argument 'spec'"),
    ],
)
def test_what_cannot_be_built_is_named(section: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        build(section, "thing", spec="s")


def test_what_a_class_of_ours_raises_of_its_own_is_not_said_otherwise() -> None:
    section = {"_target_": "envs.physics.suite.check_task", "task": "a", "tasks": []}
    with pytest.raises(SuiteError):
        build(section, "thing")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x = 1\ny = {}['size']", r"KeyError: 'size' \(.*broken_here\.py, line 2\)"),
        ("x = (", r"SyntaxError: .*\(broken_here\.py, line 1\)"),
        ("import nowhere", r"No module named 'nowhere'"),
    ],
)
def test_a_module_that_fails_is_named(
    text: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_here.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ConfigError, match=rf"^thing\._target_=broken_here\.Thing does not import: {said}"):
        build({"_target_": "broken_here.Thing"}, "thing")
