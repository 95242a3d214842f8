"""Ctrl-C before a command has begun."""

from __future__ import annotations

import sys
from types import TracebackType


def end_quietly() -> None:
    """Let Ctrl-C end this program with one line instead of a traceback, also while its modules are being imported.

    For a program's own start, before it imports anything else: a library leaves ``sys.excepthook`` alone. The program
    still ends as the signal would end it, so that a shell sees 130.
    """
    sys.excepthook = _told


def _told(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        sys.stderr.write("interrupted\n")
    else:
        sys.__excepthook__(kind, error, trace)
