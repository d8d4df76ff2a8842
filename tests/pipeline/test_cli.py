"""The command line answers at once, and mistakes are one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent


def worldloop(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "pipeline", *words], cwd=ROOT, capture_output=True, text=True, check=False
    )


def test_help_lists_the_commands_without_loading_torch() -> None:
    out = worldloop("--help")
    assert out.returncode == 0 and "doctor" in out.stdout and "controls" in out.stdout
    code = "import sys, pipeline.cli as c; c._help(); assert not {'torch', 'ray', 'wandb'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_mistakes_are_one_line() -> None:
    unknown = worldloop("evalute")
    assert unknown.returncode == 2 and "did you mean evaluate" in unknown.stderr
    for words, said in (
        (("config", "nope=1"), "nope"),
        (("controls", "experiment=smoke", "name=never-run"), "worldloop run"),
        (("compare", "/nowhere"), "result.json is not there"),
        (("stage",), "worldloop stages"),
    ):
        wrong = worldloop(*words)
        assert wrong.returncode == 1 and said in wrong.stderr and "Traceback" not in wrong.stderr, wrong
