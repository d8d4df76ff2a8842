"""Ends what a local Ray leaves running when the process that started it ends, however early and however hard.

Ray's own processes die with their driver, but two of its agents do not always notice, least of all those of a
Ray that was interrupted while it started. `reap_after_me` marks what this process starts from now on, and
starts a small process that keeps in mind whatever descends from the marked, waits for this one's end, and
then ends what is left; after a clean exit that is nothing.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

MARK = "WORLDLOOP_RAY_OF"  # environment variable by which they are known
_EVERY = 1.0  # seconds between looks
_AGENTS = (b"ray::DashboardAgent", b"ray::RuntimeEnvAgent")


def reap_after_me() -> None:
    """Let the Ray processes that this process starts from now on be ended when it ends, however that
    happens.
    """
    if _REAPERS.get(os.getpid()) is None:
        os.environ[MARK] = uuid.uuid4().hex
        # The pipe stays open as long as we live; nobody else holds its other end.
        _REAPERS[os.getpid()] = subprocess.Popen(
            [sys.executable, "-S", __file__, str(os.getsid(0))], stdin=subprocess.PIPE, start_new_session=True
        )


_REAPERS: dict[int, subprocess.Popen[bytes]] = {}  # by the process that they wait for


def marked(mark: str) -> set[int]:
    """Ids of living Ray processes with a mark and of those that descend from them (Linux; elsewhere none).

    The agents write their names over their environment, so they are known by their parents alone.
    """
    wanted, found, parents = f"{MARK}={mark}".encode(), set(), {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(entry.name)] = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            if wanted in (entry / "environ").read_bytes().split(b"\0") and _is_ray(int(entry.name)):
                found.add(int(entry.name))
        except OSError:
            continue  # it ended while we looked, or is none of ours
    while more := {pid for pid, parent in parents.items() if parent in found and pid not in found}:
        found |= more
    return found


def orphans(session: int) -> set[int]:
    """Ids of Ray's agents in a session whose raylet has ended, and with it the parent that would tell whose
    they are: one that was born just before may never have been seen beside it.
    """
    found = set()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent, _, its = (entry / "stat").read_text().rsplit(")", 1)[1].split()[1:4]
            agent = (entry / "cmdline").read_bytes().startswith(_AGENTS)
        except OSError:
            continue  # it ended while we looked
        if agent and int(its) == session and not _is_ray(int(parent)):
            found.add(int(entry.name))
    return found


def _is_ray(pid: int) -> bool:
    try:
        command = Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False
    return command.startswith(b"ray::") or b"/ray/" in command


def main() -> None:
    """Look until standard input closes, give Ray two seconds to end by itself, end what is left."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    mark, known = os.environ[MARK], set()
    while not select.select([sys.stdin], [], [], _EVERY)[0]:
        known |= marked(mark)
    known |= marked(mark)
    time.sleep(2)
    for pid in known | marked(mark) | orphans(int(sys.argv[1])):
        if _is_ray(pid):  # not another process that got its number
            try:
                os.kill(pid, signal.SIGKILL)
            except OSError:
                continue


if __name__ == "__main__":
    main()
