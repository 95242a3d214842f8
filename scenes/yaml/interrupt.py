"""What a command does with its own process before anything else; no library may do so with its user's."""

from __future__ import annotations

import atexit
import errno
import gc
import os
import sys
from types import TracebackType


def end_quietly() -> None:
    """Let Ctrl-C end this program with one line instead of a traceback, also while its modules are being imported; and
    let it search less for cyclic garbage.

    For a program's own start, before it imports anything else: a library leaves ``sys.excepthook`` and the garbage
    collector alone. The program still ends as the signal would end it, so that a shell sees 130.
    """
    sys.excepthook = _told
    # the imports of a command make hundreds of thousands of objects that stay, and at its end all that is left ends
    # with the process
    gc.set_threshold(50_000)
    # pydantic would look through the metadata of all installed packages for plugins of its own
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    atexit.register(gc.freeze)


def _told(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        sys.stderr.write("interrupted\n")
    elif isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
        # help is written by a library, which has no word for it
        from scenes.yaml.standard_output import leave_stdout

        sys.stderr.write(f"error: cannot write to the standard output: {error.strerror}\n")
        leave_stdout()
    else:
        sys.__excepthook__(kind, error, trace)
