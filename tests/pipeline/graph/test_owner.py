"""One run, one owner: a second command in the same run is refused, whatever ended lets go."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.graph.owner import RunInUse, owning

HOLD = """
import sys, time
from pathlib import Path
from pipeline.graph.owner import owning
with owning(Path(sys.argv[1]), "run"):
    print("held", flush=True)
    time.sleep(600)
"""


NO_FLOCK = """
import errno, fcntl, os
def flock(file, how):
    raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
fcntl.flock = flock
"""


@pytest.fixture(params=["flock", "no flock"])
def holder(
    tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the run, on a file system that knows flock and on one that does not."""
    code = HOLD
    if request.param == "no flock":
        monkeypatch.setattr(fcntl, "flock", fcntl.flock)  # puts it back afterwards
        exec(NO_FLOCK, {})
        code = NO_FLOCK + HOLD
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()


def test_a_second_owner_is_told_who_works_there(holder: subprocess.Popen[str], tmp_path: Path) -> None:
    with pytest.raises(RunInUse) as told, owning(tmp_path, "controls"):
        pass
    words = str(told.value)
    assert str(tmp_path) in words and "worldloop run" in words
    assert f"process {holder.pid} on {socket.gethostname()}, since 2" in words and "name=" in words
    assert json.loads((tmp_path / ".owner.json").read_text())["pid"] == holder.pid  # still its own


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_what_a_dead_owner_held_is_taken_over(
    holder: subprocess.Popen[str], tmp_path: Path, number: signal.Signals
) -> None:
    holder.send_signal(number)
    holder.wait()
    with owning(tmp_path, "run"):
        assert json.loads((tmp_path / ".owner.json").read_text())["pid"] == os.getpid()
    assert not (tmp_path / ".owner.json").exists()


@pytest.mark.long
def test_two_commands_in_one_run_leave_one_good_run(tmp_path: Path) -> None:
    few = "collect.episodes={train: 4, held_out: 1, calibration: 1}"
    words = ["stage", "collect", "experiment=soak", f"runs={tmp_path}", "track=disabled", few]
    first = _worldloop(words)
    lock = tmp_path / "soak/.owner.json"
    deadline = time.monotonic() + 60
    while not lock.exists() and time.monotonic() < deadline and first.poll() is None:
        time.sleep(0.02)
    first.send_signal(signal.SIGSTOP)  # however fast it is, it is there while the other comes
    second = _worldloop(words)
    said = second.communicate()[1]
    first.send_signal(signal.SIGCONT)
    assert first.wait() == 0 and second.returncode == 1, said
    assert "belongs to `worldloop stage collect`, process" in said and "Traceback" not in said
    (folder,) = (tmp_path / "soak/stages").glob("collect-*")
    info = json.loads((folder / "dataset/meta/info.json").read_text())
    assert info["total_episodes"] == json.loads((folder / "manifest.json").read_text())["result"]["episodes"]


def _worldloop(words: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "pipeline", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).resolve().parents[3],
    )
