"""SIGTERM while Ray starts, which takes it for itself."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def our_sigterm() -> Iterator[None]:
    """Within, Ray starts; it takes SIGTERM for itself, and would end a driver with status 15 where shells and
    schedulers expect 143, or, where its C++ turns that end into an error, with 1. Whatever became of it, a
    SIGTERM that came ends the process with 143.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before, (listen, wake) = signal.getsignal(signal.SIGTERM), os.pipe()
    report = sys.unraisablehook

    def quietly(lost: Any) -> None:
        # Ray's handler exits; where it interrupts what forks, Python drops that and reports it.
        if not isinstance(lost.exc_value, SystemExit):
            report(lost)

    for end in (listen, wake):
        os.set_blocking(end, False)
    # It gets every signal, whoever handles it.
    listening = signal.set_wakeup_fd(wake, warn_on_full_buffer=False)

    def terminated() -> bool:
        try:
            return signal.SIGTERM in os.read(listen, 4096)
        except BlockingIOError:  # none came
            return False

    sys.unraisablehook = quietly
    try:
        yield
    except (SystemExit, Exception) as error:
        if terminated():
            raise SystemExit(128 + signal.SIGTERM) from error
        raise
    else:
        if terminated():
            raise SystemExit(128 + signal.SIGTERM)
    finally:
        sys.unraisablehook = report
        signal.set_wakeup_fd(listening)
        signal.signal(signal.SIGTERM, before)
        os.close(listen)
        os.close(wake)
