"""The command line answers at once, and mistakes are one line."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import pytest

from pipeline.cli.main import COMMANDS, main
from tests.sampling import every

ROOT = Path(__file__).resolve().parents[3]
Answer = subprocess.CompletedProcess[str]


def process(*words: str) -> Answer:
    """`python -m pipeline <words>`, as a shell runs it."""
    return subprocess.run(
        [sys.executable, "-m", "pipeline", *words], cwd=ROOT, capture_output=True, text=True, check=False
    )


def worldloop(*words: str) -> Answer:
    """The same in this process, which has imported what it needs."""
    out, err, status = io.StringIO(), io.StringIO(), 0
    with patch.object(sys, "argv", ["worldloop", *words]):
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                main()
            except SystemExit as end:
                assert isinstance(end.code, int)
                status = end.code
    return subprocess.CompletedProcess(list(words), status, out.getvalue(), err.getvalue())


def unread(*words: str) -> tuple[int, str]:
    """Exit status and stderr of `python -m pipeline <words>` whose stdout nobody reads."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as nobody:
        out = subprocess.run(
            [sys.executable, "-m", "pipeline", *words],
            cwd=ROOT,
            stdout=nobody,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    return out.returncode, out.stderr


def test_help_lists_the_commands() -> None:
    out = process("--help")
    assert out.returncode == 0 and "doctor" in out.stdout and "controls" in out.stdout


@pytest.mark.parametrize(
    "words", every(4, [[], ["--help"], ["doctor", "--help"], ["stages", "experiment=smoke"]])
)
def test_a_reader_that_goes_ends_a_command_without_a_word(words: list[str]) -> None:
    assert unread(*words) == (128 + signal.SIGPIPE, "")


def test_of_an_end_with_nobody_to_read_output_the_mistake_is_told() -> None:
    status, said = unread("nonsense")
    assert status == 2 and said.startswith("no command 'nonsense'") and said.count("\n") == 1


def test_a_broken_pipe_that_is_not_stdout_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def ask(words: list[str]) -> None:
        one, other = socket.socketpair()
        with one, other:
            other.close()
            one.send(b"to nobody")

    monkeypatch.setitem(COMMANDS, "doctor", ask)
    out = worldloop("doctor")
    assert out.returncode == 1 and out.stderr == "worldloop doctor: [Errno 32] Broken pipe\n"


def test_what_needs_no_learning_is_answered_without_loading_torch() -> None:
    code = """if True:
        import sys
        from pipeline.cli.main import main
        for words in sys.argv[1:]:
            sys.argv = ["worldloop", *words.split()]
            try:
                main()
            except SystemExit as end:
                assert end.code in (1, 2), words
            assert not {"torch", "ray", "wandb"} & set(sys.modules), words
        """
    light = ["--help", "run --help", "evalute", "stage", "tasks", "completion bash", "config simulator=gan"]
    light += [f"{name} nope=1" for name in ("run", "rl", "stages", "evaluate", "controls", "finetune")]
    done = subprocess.run([sys.executable, "-c", code, *light], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("run", [process, worldloop])
def test_a_mistake_is_one_line(run: Callable[..., Answer]) -> None:
    wrong = run("config", "nope=1")
    assert wrong.returncode == 1 and wrong.stderr.count("\n") == 1 and "nope" in wrong.stderr, wrong


def test_mistakes_name_the_fix() -> None:
    unknown = worldloop("evalute")
    assert unknown.returncode == 2 and "did you mean evaluate" in unknown.stderr
    for words, said in (
        (("controls", "experiment=smoke", "name=never-run"), "worldloop run"),
        (("compare", "/nowhere"), "result.json is not there"),
        (("stage",), "worldloop stages"),
        (
            ("stage", "distill", "experiment=smoke"),
            "distill.steps=0 is without a student; add distill.steps=2",
        ),
        (
            ("evaluate", "policy=imitation", "policy=coarse", "experiment=smoke", "name=never-run")
            + (f"hydra.searchpath=[file://{ROOT}/examples/configs]",),
            "first `worldloop stage imitation`",  # coarse is the class of its weights
        ),
        (
            ("evaluate", "policy=imitaton", "experiment=smoke"),
            "choice of configs/policy; did you mean imitation",
        ),
        (
            ("evaluate", "policy=chunk_gaussian", "variant=swapped", "experiment=smoke"),
            "variant=swapped: this task has no variants",
        ),
        (("evaluate", "world=imagined", "experiment=smoke"), "say what to evaluate: policy=<stage|folder>"),
        (
            ("evaluate", "simulator=dit_small", "variant=swapped", "experiment=smoke"),
            "simulator=dit_small is measured by itself: leave out policy=, world= and variant=",
        ),
        (
            ("evaluate", "simulator=dit_small", "experiment=smoke", "name=never-run"),
            "is no LeRobot data set (yet); run the stages that record",
        ),
        (("run", "policy=openpi", "experiment=smoke"), "OpenPIPolicy cannot learn"),
        (("stage", "rl-1", "policy=openpi", "experiment=smoke"), "OpenPIPolicy cannot learn"),
        (("study", "policy=openpi", "experiment=smoke", "study.minutes=0"), "OpenPIPolicy cannot learn"),
        (("tasks", "metaworld"), "did you mean task=metaworld?"),
        (("tasks", "task=tabletop", "task.suite.scenes=attic"), "task.suite.scenes holds 'attic'"),
        (("bench", "serving", "seconds=soon"), "seconds=soon: say a number above 0"),
    ):
        wrong = worldloop(*words)
        assert wrong.returncode == 1 and said in wrong.stderr and "Traceback" not in wrong.stderr, wrong


def test_every_command_explains_itself_at_once_and_starts_nothing() -> None:
    for name in ("run", "chaos", "convert"):
        out = worldloop(name, "--help")
        assert out.returncode == 0 and out.stdout.startswith(f"worldloop {name} "), out
    assert "[key=value ...]" in worldloop("run", "--help").stdout
    for words in (("convert", "--help"), ("help", "convert")):  # whose words are none of configs/
        usage, _, rest = worldloop(*words).stdout.partition("\n")
        assert usage == "worldloop convert SRC DST [frames=N] [size=[H,W]]" and "configs/" not in rest
    usage, _, rest = worldloop("compare", "--help").stdout.partition("\n")
    assert usage == "worldloop compare runs/quickstart runs/quickstart_dit"
    assert "equal training time are compared by worldloop study experiment=worlds" in " ".join(rest.split())
    assert max(map(len, worldloop("--help").stdout.splitlines())) <= 100
    assert all(command.__doc__ for command in COMMANDS.values())
    assert worldloop("--version").stdout.startswith("worldloop 0.")


def test_shells_complete_commands_and_choices() -> None:
    script = worldloop("completion", "bash").stdout

    def completed(*words: str) -> list[str]:
        ask = f"COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; _worldloop"
        line = f'{script}\n{ask}; echo "${{COMPREPLY[@]}}"'
        return subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True).stdout.split()

    assert completed("worldloop", "ru") == ["run"]
    assert "experiment=smoke" in completed("worldloop", "run", "exp")
    assert completed("worldloop", "run", "experiment", "=", "quickstart_") == [
        "quickstart_dit",
        "quickstart_fine",
        "quickstart_long",
    ]
    assert "bashcompinit" in worldloop("completion", "zsh").stdout
    assert "say which shell" in worldloop("completion", "fish").stderr


def test_tasks_are_listed_with_what_can_be_chosen(tmp_path: Path) -> None:
    some, one = worldloop("tasks"), worldloop("tasks", "task=metaworld")
    assert "task=push" in some.stdout and "hand_left" in some.stdout and "(50; " in some.stdout, some
    assert "window-open-v3" in one.stdout and "task=push" not in one.stdout
    assert "did you mean metaworld" in worldloop("tasks", "task=metawrld").stderr
    assert "no physics" in worldloop("tasks", "task=lerobot").stdout
    assert "say of which task" in worldloop("tasks", f"pictures={tmp_path}").stderr
    assert "say of which task" in worldloop("tasks", "task.name=push").stderr
    odd = worldloop("tasks", "task=tabletop", "task.name=[push,pushh]")
    assert "task.name='pushh' is unknown; the nearest of" in odd.stderr and "'push'" in odd.stderr
    assert odd.returncode == 1 and not odd.stdout
    mine = f"hydra.searchpath=[file://{ROOT}/examples/configs]"
    drawn = worldloop("tasks", mine, "task=dot", f"pictures={tmp_path}")
    assert "robot dot" in drawn.stdout and (tmp_path / "dot-reach.gif").exists(), drawn


@pytest.mark.long
def test_a_suite_that_cannot_be_built_leaves_the_others_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_suite.py").write_text(
        "class Arm:\n    def __init__(self, robot: str):\n        open(robot)\n\n\n"
        "class Slip:\n    def __init__(self, robot: str):\n        self.nothing\n"
    )
    (tmp_path / "choices/task").mkdir(parents=True)
    for name in ("Arm", "Slip"):
        (tmp_path / f"choices/task/{name}.yaml").write_text(
            f"suite: {{_target_: broken_suite.{name}, robot: /nowhere/robot.xml}}\nname: reach\n"
            "size: [32, 32]\nchunk: 4\nhorizon: 12\nmode: absolute\n"
        )
    monkeypatch.syspath_prepend(str(tmp_path))
    mine = f"hydra.searchpath=[file://{tmp_path}/choices]"
    listed = worldloop("tasks", mine)
    assert listed.returncode == 0 and "task=push" in listed.stdout, listed
    assert "task.suite (broken_suite.Arm): [Errno 2] No such file or directory: '/nowhere" in listed.stdout
    assert "task.suite (broken_suite.Slip): AttributeError: " in listed.stdout
    for name in ("Arm", "Slip"):
        wrong = worldloop("run", mine, f"task={name}", "experiment=smoke")
        assert wrong.returncode == 1 and f"task.suite (broken_suite.{name}): " in wrong.stderr, wrong


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
