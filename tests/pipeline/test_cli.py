"""The command line answers at once, and mistakes are one line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.cli.main import main

ROOT = Path(__file__).resolve().parent.parent.parent


def worldloop(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "pipeline", *words], cwd=ROOT, capture_output=True, text=True, check=False
    )


def test_help_lists_the_commands_without_loading_torch() -> None:
    out = worldloop("--help")
    assert out.returncode == 0 and "doctor" in out.stdout and "controls" in out.stdout
    loaded = "assert not {'torch', 'ray', 'wandb'} & set(sys.modules)"
    code = f"import sys; from pipeline.cli.main import _help; _help(); {loaded}"
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


def test_every_command_explains_itself_at_once_and_starts_nothing() -> None:
    from pipeline.cli.main import COMMANDS

    for name in ("run", "chaos", "convert"):
        out = worldloop(name, "--help")
        assert out.returncode == 0 and out.stdout.startswith(f"worldloop {name} "), out
    assert all(command.__doc__ for command in COMMANDS.values())
    assert worldloop("--version").stdout.startswith("worldloop 0.")


def test_shells_complete_commands_and_choices() -> None:
    def completed(*words: str) -> list[str]:
        script = worldloop("completion", "bash").stdout
        ask = f"COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; _worldloop"
        line = f'{script}\n{ask}; echo "${{COMPREPLY[@]}}"'
        return subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True).stdout.split()

    assert completed("worldloop", "ru") == ["run"]
    assert "experiment=smoke" in completed("worldloop", "run", "exp")
    assert completed("worldloop", "run", "experiment", "=", "quickstart_") == ["quickstart_dit"]
    assert "bashcompinit" in worldloop("completion", "zsh").stdout
    assert "say which shell" in worldloop("completion", "fish").stderr


def test_tasks_are_listed_with_what_can_be_chosen() -> None:
    some, one = worldloop("tasks"), worldloop("tasks", "task=metaworld")
    assert "task=push" in some.stdout and "hand_left" in some.stdout and "(50; " in some.stdout, some
    assert "window-open-v3" in one.stdout and "task=push" not in one.stdout
    assert "did you mean metaworld" in worldloop("tasks", "task=metawrld").stderr


def test_choices_and_classes_of_the_folder_one_stands_in_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "found_here.py").write_text("class Mine:\n    def __init__(self, spec, width: int): ...\n")
    (tmp_path / "choices/policy").mkdir(parents=True)
    (tmp_path / "choices/policy/mine.yaml").write_text("_target_: found_here.Mine\nwidth: 3\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(ROOT), *sys.path])  # as it was, once this is over
    monkeypatch.setattr(
        sys, "argv", ["worldloop", "config", "hydra.searchpath=[file://choices]", "policy=mine"]
    )
    main()
    assert "_target_: found_here.Mine" in capsys.readouterr().out
