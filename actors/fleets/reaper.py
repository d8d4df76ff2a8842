"""Ends what a local Ray leaves running when the process that started it is killed.

Ray's own processes die with their driver, but two of its agents do not always notice. `reap_after_me` starts
a small process that waits for this one's end and then ends the agents; after a clean exit it finds none.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path


def descendants(root: int) -> list[int]:
    """Process ids of all descendants of a process (Linux; elsewhere none)."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
        except OSError:
            continue  # it ended while we looked
        parents.setdefault(parent, []).append(int(entry.name))
    found, queue = [], [root]
    while queue:
        children = parents.get(queue.pop(), [])
        found += children
        queue += children
    return found


def reap_after_me() -> None:
    """Let the Ray processes that descend from this one be ended when it ends, however that happens."""
    mine = [pid for pid in descendants(os.getpid()) if "ray" in _command(pid)]
    if mine:
        # The pipe stays open as long as we live; nobody else holds its other end.
        child = subprocess.Popen(
            [sys.executable, "-S", __file__, *map(str, mine)], stdin=subprocess.PIPE, start_new_session=True
        )
        _PIPES.append(child)


_PIPES: list[subprocess.Popen[bytes]] = []


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def main() -> None:
    """Wait until standard input closes, give Ray two seconds to end by itself, end what is left."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.stdin.buffer.read()
    time.sleep(2)
    for pid in map(int, sys.argv[1:]):
        if "ray" in _command(pid):  # not another process that got its number
            try:
                os.kill(pid, signal.SIGKILL)
            except OSError:
                continue


if __name__ == "__main__":
    main()
