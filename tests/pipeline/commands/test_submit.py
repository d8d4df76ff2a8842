"""What is submitted is told by words of the command's own; only the folder of runs is looked for here."""

from __future__ import annotations

import pytest

from envs.targets import ConfigError
from pipeline.cli import tools
from pipeline.commands import submit

HEAD = "http://127.0.0.1:1"


@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "experiment=smoke", "policy=rl-2", "runs=/shared/runs"],
        ["trust", "experiment=smoke", "round=2", "runs=/shared/runs"],
        ["rewards", "experiment=smoke", "rewards=[proxy]", "variants=[x]", 'runs="/shared/runs"'],
        ["judge", "judge=vlm", "frames=all,4", "data=/set", "runs=/shared/runs"],
        ["gridworld", "squares=1,3", "runs=/shared/runs"],
    ],
)
def test_words_of_a_commands_own_are_left_to_the_job(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[tuple[str, list[str]]] = []
    monkeypatch.setattr(submit, "submit", lambda address, words: sent.append((address, words)))
    tools.submit([HEAD, *words])
    assert sent == [(HEAD, words)]
    without = [word for word in words if not word.startswith("runs=")]
    with pytest.raises(ConfigError, match="runs=runs would lie in the job's working folder"):
        tools.submit([HEAD, *without, "launch=ray", "stage"])
    with pytest.raises(ConfigError, match="runs=here would lie in the job's working folder"):
        tools.submit([HEAD, *without, "runs=here"])
