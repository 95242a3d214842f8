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
    """Let SIGTERM and SIGHUP end the program as an exception, so that a half-written run folder is removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    got: list[int] = []

    def leave(number: int, frame: object) -> None:
        if not got:  # a second one must not break off the clearing up
            got.append(number)
            raise SystemExit(128 + number)

    before = {number: signal.signal(number, leave) for number in ending_signals()}
    try:
        yield
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
