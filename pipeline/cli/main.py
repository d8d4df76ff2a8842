"""The command line. Every command takes Hydra overrides: worldloop run experiment=quickstart seed=1.

What a command needs is imported when it runs, so that help and mistakes answer at once.
"""

from __future__ import annotations

import atexit
import os
import re
import select
import signal
import sys
import textwrap
from collections.abc import Callable
from typing import Any

from envs.targets import ROOMS, nearest
from pipeline.cli import runs, tools, worlds
from pipeline.cli.words import Words

COMMANDS: dict[str, Callable[[Words], None]] = {
    command.__name__.replace("_", "-"): command
    for command in (
        *(runs.run, runs.rl, runs.stage, runs.stages, runs.evaluate),
        *(runs.trust, runs.gradients, runs.cross_validate, runs.controls, runs.study),
        *(
            worlds.policy_value,
            worlds.fidelity,
            worlds.ewmbench,
            worlds.summary,
            worlds.sweep,
            worlds.rewards,
            worlds.gridworld,
        ),
        tools.judge,
        *(runs.compare, runs.finetune, tools.serve, tools.play, tools.convert, tools.inspect, tools.bench),
        *(tools.verify, tools.submit, tools.chaos, tools.tasks, tools.config, tools.doctor, tools.completion),
    )
}
# commands whose words are their own, none of configs/
_NO_KEYS = ("compare", "convert", "inspect", "verify", "tasks", "doctor", "completion")
_STDOUT = 1  # its file descriptor


def _help() -> str:
    lines = [line for name in COMMANDS for line in _wrapped(_about(name), f"  {name:<14} ", " " * 17)]
    return (
        "worldloop <command> [key=value ...]\n\n"
        + "\n".join(lines)
        + "\n\nKeys are those of configs/; `worldloop config` prints them.\n`worldloop <command> --help` says"
        " more of one, `worldloop --version` which this is."
    )


def _help_of(name: str) -> str:
    """How a command is called, what it does, and what its words are."""
    about = _about(name)
    example = re.search(rf"worldloop {name}( [^;:)]+)?", about)
    usage = example.group().strip() if example else f"worldloop {name}"
    if name in _NO_KEYS:
        return "\n".join([usage, "", *_wrapped(about)])
    keys = (
        "Keys are those of configs/, as in experiment=smoke rl.lr=1e-4; `worldloop config` prints all with"
        " their values."
    )
    return "\n".join([f"{usage} [key=value ...]", "", *_wrapped(about), "", *_wrapped(keys)])


def _about(name: str) -> str:
    return " ".join((COMMANDS[name].__doc__ or "").split())


def _wrapped(text: str, first: str = "", others: str = "") -> list[str]:
    """Lines no wider than a terminal that many have; what is typed is not torn apart."""
    how: dict[str, Any] = {"break_long_words": False, "break_on_hyphens": False}
    return textwrap.wrap(text, 100, initial_indent=first, subsequent_indent=others, **how)


def _explained(error: Exception) -> bool:
    """Whether an error's message is all that a user needs: the system's, and those that Worldloop defines."""
    return isinstance(error, OSError) or type(error).__module__.split(".")[0] in ROOMS


def _find_modules_here() -> None:
    """Let a `_target_` name a class in the folder in which the command was typed, as `python -m` does.

    What is installed is found first. Physics workers and Ray's processes on this machine look there too.
    """
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())


def main() -> None:
    """Entry point of `worldloop` and `python -m pipeline`. Where nobody reads its output any more, as of
    `worldloop --help | head -1`, it ends as SIGPIPE would end it, with 141 and without a word.
    """
    _find_modules_here()
    try:
        _command(sys.argv[1:])
        print(end="", flush=True)  # here, where it can be caught, and not as Python ends
    except BaseException as error:
        if not _unread():
            raise
        # Python flushes once more as it ends: what is left goes nowhere, without an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), _STDOUT)
        if not isinstance(error, BrokenPipeError):
            raise
        sys.exit(128 + signal.SIGPIPE)


def _unread() -> bool:
    """Whether stdout is a pipe, or a socket, whose other end was closed."""
    poll = select.poll()
    poll.register(_STDOUT, 0)  # errors are always told
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


def _command(words: Words) -> None:
    """Answer, or run the command that words begin with."""
    if words[:1] == ["help"] and words[1:] and words[1] in COMMANDS:
        words = [words[1], "--help"]
    if not words or words[0] in ("-h", "--help", "help"):
        print(_help())
        return
    if words[0] in ("-V", "--version", "version"):
        from importlib.metadata import version

        print(f"worldloop {version('worldloop')}")
        return
    if words[0] not in COMMANDS:
        print(f"no command {words[0]!r}{nearest(words[0], COMMANDS)}; worldloop --help", file=sys.stderr)
        sys.exit(2)
    if {"-h", "--help"} & set(words[1:]):
        print(_help_of(words[0]))
        return
    from learners.training.interrupt import clean_ending

    try:
        with clean_ending():
            COMMANDS[words[0]](words[1:])
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from the last checkpoint", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        if not _explained(error) or (isinstance(error, BrokenPipeError) and _unread()):
            raise
        print(f"worldloop {words[0]}: {error}", file=sys.stderr)
        sys.exit(1)
    finally:
        # What is registered last runs first: from now on there is nothing left to save, and libraries' own
        # endings answer Ctrl-C with a traceback.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_DFL)
