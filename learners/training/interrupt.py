"""SIGINT and SIGTERM as requests: what learns finishes its step, writes its checkpoint and leaves.

Elsewhere both end a command at once, by an exception that lets everything clean up.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def clean_ending() -> Iterator[None]:
    """Within, SIGTERM raises SystemExit(143) and SIGINT KeyboardInterrupt, so that whoever is at work can
    clean up; a second SIGTERM kills. Libraries written in C turn what a handler raises in them into
    errors of their own; it is the signal that ends the command all the same.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received = 0
    before: dict[int, Any] = {number: signal.getsignal(number) for number in _SIGNALS}

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal received
        received = number
        signal.signal(number, signal.SIG_DFL if number == signal.SIGTERM else before[number])
        leave(number)

    for number, handler in before.items():
        if handler is not signal.SIG_IGN:  # as shells start what runs in the background
            signal.signal(number, end)
    try:
        yield
    except (Exception, SystemExit) as error:  # Ray makes of the end another one, with status 1
        if received:
            leave(received, error)
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def deferred_signals() -> Iterator[Callable[[], int]]:
    """Within, the first SIGINT or SIGTERM only sets what the yielded function returns, the signal's number;
    a second one ends the process as it would elsewhere. One that comes after the last call, as the last
    checkpoint is written, ends the process on leaving.

    Outside the main thread, where Python handles no signals, it changes nothing.
    """
    received = 0
    if threading.current_thread() is not threading.main_thread():
        yield lambda: 0
        return
    before = {number: signal.getsignal(number) for number in _SIGNALS}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal received
        received = number
        restore()

    for number in _SIGNALS:
        signal.signal(number, note)
    try:
        yield lambda: received
    finally:
        restore()
    if received:
        leave(received)


def leave(number: int, cause: BaseException | None = None) -> NoReturn:
    """End as the signal asks, with the exit status that shells expect of it."""
    if number == signal.SIGINT:
        raise KeyboardInterrupt from cause
    raise SystemExit(128 + number) from cause
