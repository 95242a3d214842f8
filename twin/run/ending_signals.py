"""Signals that ask the program to end, and where it may end."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


def ending_signals() -> tuple[signal.Signals, ...]:
    """Signals that ask the program to end, Ctrl-C aside. SIGHUP does not when ``nohup`` has started it."""
    asked = (signal.SIGTERM, signal.SIGHUP)
    return tuple(number for number in asked if signal.getsignal(number) != signal.SIG_IGN)


@contextmanager
def exit_on_terminate() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the program as an exception, as Ctrl-C does, so that a half-written run folder is
    removed. The exception that leaves the block is the signal's whatever became of it on its way: compiled modules turn
    one that comes while they are imported or call back into their own, and clearing up may fail after it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    got: list[int] = []

    def leave(number: int, frame: object) -> None:
        got.append(number)
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        if len(got) == 1:  # a second one must not break off the clearing up
            raise SystemExit(128 + number)

    asked = ending_signals()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        asked = (*asked, signal.SIGINT)
    before = {number: signal.signal(number, leave) for number in asked}
    try:
        yield
    except BaseException as error:
        if got:
            raise (KeyboardInterrupt() if got[0] == signal.SIGINT else SystemExit(128 + got[0])) from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def ending_later() -> Iterator[None]:
    """Ctrl-C and signals that ask to end are heeded when the block is over, of what cannot be broken off."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    got: list[int] = []
    asked = (signal.SIGINT, *ending_signals())
    before = {number: signal.signal(number, lambda number, frame: got.append(number)) for number in asked}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    for heard in got:
        signal.raise_signal(heard)
