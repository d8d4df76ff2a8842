"""SIGINT and SIGTERM as requests: what learns finishes its step, writes its checkpoint and leaves.

Elsewhere both end a command at once, by an exception that lets everything clean up.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def clean_ending() -> Iterator[None]:
    """Within, SIGTERM raises SystemExit(143), so that whoever is at work can clean up; a second one kills."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGTERM)

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        leave(number)

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def deferred_signals() -> Iterator[Callable[[], int]]:
    """Within, the first SIGINT or SIGTERM only sets what the yielded function returns, the signal's number;
    a second one ends the process as it would elsewhere. One that comes after the last call, as the last
    checkpoint is written, ends the process on leaving.

    Outside the main thread, where Python handles no signals, it changes nothing.
    """
    asked = 0
    if threading.current_thread() is not threading.main_thread():
        yield lambda: 0
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = number
        restore()

    for number in _SIGNALS:
        signal.signal(number, note)
    try:
        yield lambda: asked
    finally:
        restore()
    if asked:
        leave(asked)


def leave(number: int) -> NoReturn:
    """End as the signal asks, with the exit status that shells expect of it."""
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise SystemExit(128 + number)
