"""Work that ends by itself after so many minutes, as cleanly as if it had been asked to."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from tqdm import tqdm


@dataclass
class Deadline:
    """Whether the time is over."""

    over: bool = False


@contextmanager
def deadline(minutes: float | None) -> Iterator[Deadline]:
    """Within, this process is sent SIGTERM after so many minutes, upon which whoever learns writes a
    checkpoint and everything else cleans up; the block then ends without an error.

    Args:
        minutes: None for no end; after 0 the time is over from the start, and nothing is sent.

    Yields:
        What says, after the block too, whether the time is over.
    """
    found, within = Deadline(over=minutes == 0), threading.Lock()

    def end() -> None:
        with within:
            if not timer.finished.is_set():
                found.over = True
                os.kill(os.getpid(), signal.SIGTERM)

    timer = threading.Timer(60 * (minutes or 0.0), end)
    timer.daemon = True
    try:
        if minutes:
            timer.start()
        yield found
        with within:  # what was sent before arrives here, at the latest
            timer.cancel()
    except SystemExit:
        if not found.over:
            raise
    except Exception as error:
        if not found.over:
            raise
        # what a library in C makes of the exception that a signal's handler raises
        tqdm.write(f"the time is over; what was at work ended with {type(error).__name__}: {error}")
    finally:
        timer.cancel()
