"""Settings that a command makes for its own process at its start; a library must not make them for its user's."""

import atexit
import errno
import gc
import os
import sys
from types import TracebackType


def end_quietly() -> None:
    """Make Ctrl-C end this program with one line instead of a traceback, and reduce the work of the garbage collector.

    A program calls this at its start, before other imports, so that it also holds while its modules are imported. A
    library leaves ``sys.excepthook`` and the garbage collector alone. The program still ends as the signal would end
    it, so that a shell sees exit code 130.
    """
    sys.excepthook = _report_uncaught
    # the imports of a command create hundreds of thousands of objects that live until the process ends, so that
    # searching them for cycles is wasted time
    gc.set_threshold(50_000)
    # pydantic would otherwise search the metadata of all installed packages for plugins
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    atexit.register(gc.freeze)


def _report_uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Report an uncaught exception: one line for Ctrl-C and for a full disk, the traceback for anything else."""
    if issubclass(kind, KeyboardInterrupt):
        sys.stderr.write("interrupted\n")
    elif isinstance(error, OSError) and error.errno == errno.ENOSPC and error.filename is None:
        # the library that prints help does not report this error
        from scenes.yaml.standard_output import leave_stdout

        sys.stderr.write(f"error: cannot write to the standard output: {error.strerror}\n")
        leave_stdout()
    else:
        sys.__excepthook__(kind, error, trace)
