"""Commands in processes of their own, forked from one that has imported everything once for all tests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipeline.chaos import life


@dataclass(frozen=True)
class Ended:
    """What came of a command: its exit status, and all that it printed."""

    status: int
    output: str


def worldloop(folder: Path, *words: str) -> Ended:
    """Run `worldloop <words>` to its end, or to that of the test's time; `folder` receives its log."""
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"{words[0]}-{len(list(folder.glob('*.log')))}.log"
    process = life.begin(list(words), str(log), log)
    try:
        process.join()
    finally:
        process.kill()
    assert process.exitcode is not None
    return Ended(process.exitcode, log.read_text(errors="replace"))
