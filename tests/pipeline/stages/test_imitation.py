"""The stage that clones the first policy: what it says of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from envs.embodiment import Embodiment
from pipeline.config import load_config
from pipeline.loop import build_loop
from tests.embodiments import ARM_JOINTS


def test_numbers_that_a_policy_holds_constant_are_told_by_name(
    tiny_data: Callable[[Embodiment], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fit = "{steps: 2, batch: 2}"
    words = [
        *("experiment=smoke", "task=lerobot", f"task.data=[{tiny_data(ARM_JOINTS)}]", "task.size=[32,32]"),
        *("imitation.demos=4", f"imitation.fit={fit}", f"imitation.perception={fit}"),
    ]
    result = build_loop(load_config(words), tmp_path).run(until="imitation")["imitation"]["result"]
    still = list(ARM_JOINTS.action_names[2:])  # the square moves two numbers
    assert result["constant"] == still
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "constant" in line]
    assert line == f"imitation: the policy holds constant, as demonstrations do: {', '.join(still)}"
