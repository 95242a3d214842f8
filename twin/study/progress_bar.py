"""How far a study is that a script started: the pipe by which its process tells it, and a line that shows it.

The command itself has a bar of its own; this one draws with nothing that a script does not have.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable
from contextlib import suppress

Told = Callable[[int, int], None]
"""What is told that so many runs of so many are there."""


def shown_bar() -> Told:
    """A line on stderr that says how far a study is, drawn over the one before: on a terminal and in a notebook's cell.
    Elsewhere, in a file, nothing is written.
    """
    stream = sys.stderr
    if not (stream.isatty() or "ipykernel" in sys.modules):
        return lambda done, total: None
    begun = time.monotonic()

    def told(done: int, total: int) -> None:
        full = _WIDTH * done // max(total, 1)
        spent = time.monotonic() - begun
        left = f", about {spent * (total - done) / done:.0f} s left" if 0 < done < total else ""
        bar = f"runs {'#' * full}{'.' * (_WIDTH - full)} {done} of {total}, {spent:.0f} s{left}"
        # the line before may have been longer
        stream.write(f"\r{bar:<79}" + ("\n" if done == total else ""))
        stream.flush()

    return told


_WIDTH = 30  # of the bar, characters


def tell_through(descriptor: int) -> Told:
    """What writes the numbers into a pipe, a line each time; a reader that is gone ends nothing.

    Args:
        descriptor: of the pipe, inherited; processes that this one starts do not get it.
    """
    os.set_inheritable(descriptor, False)

    def told(done: int, total: int) -> None:
        with suppress(OSError):
            os.write(descriptor, f"{done} {total}\n".encode())

    return told


def tell_all(lines: Iterable[str], told: Told) -> None:
    """Tell what comes out of such a pipe, until its other end is closed."""
    for line in lines:
        done, total = line.split()
        told(int(done), int(total))
