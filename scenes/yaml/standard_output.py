"""Output of commands: results to stdout, errors to stderr.

A command that cannot write all of its results ends with an exit code that says so.
"""

import errno
import json
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import typer
from rich.console import Console

from scenes.yaml.errors import printable

BAD_INPUT, FAILURE = 2, 1
_OF_THE_MACHINE = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.EMFILE, errno.ENFILE, errno.ENOMEM)
"""Error numbers of failures of the machine, such as a full disk, in contrast to those caused by a path of the user."""
PIPE_CLOSED = 128 + signal.SIGPIPE
"""Exit code with which a shell reports a program that SIGPIPE has ended."""


def print_error(errors: Console, text: str) -> None:
    """Print one error message without markup or wrapping, with control characters as escapes."""
    text = "\n".join(printable(line) for line in text.split("\n"))
    errors.print(f"error: {text}", style="bold red", markup=False, highlight=False, soft_wrap=True)


def code_of(error: BaseException | None) -> int:
    """Return the exit code of a failure to write: FAILURE if the machine is its cause, else BAD_INPUT."""
    return FAILURE if isinstance(error, OSError) and error.errno in _OF_THE_MACHINE else BAD_INPUT


@contextmanager
def to_stdout(errors: Console, kept: str = "") -> Iterator[None]:
    """Flush all results that the block writes to stdout, and report when they cannot be written.

    A reader that closes the pipe early, as ``head`` does, ends the command without a message, as it ends other
    programs.

    Parameters
    ----------
    errors : Console
        Console for the message that stdout cannot be written, for instance on a full disk.
    kept : str
        Text that says where the results are stored besides, for this message.

    Raises
    ------
    typer.Exit
        The results cannot be written.
    """
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        leave_stdout()
        raise typer.Exit(PIPE_CLOSED) from None
    except OSError as error:
        leave_stdout()
        reason = os.strerror(error.errno) if error.errno else str(error)
        print_error(errors, f"cannot write to the standard output: {reason}" + (f"; {kept}" if kept else ""))
        raise typer.Exit(FAILURE) from None


def leave_stdout() -> None:
    """Redirect stdout to the null device, so that the interpreter does not write the rest of the buffers at its end."""
    try:
        descriptor = sys.stdout.fileno()
    except (OSError, ValueError):  # stdout is not a file
        return
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, descriptor)
    os.close(null)


class Terminal(Console):
    """Terminal for results that leaves the handling of a broken pipe to ``to_stdout``.

    A pipe is broken when its reader, such as ``head``, ends before all results are written.
    """

    def on_broken_pipe(self) -> None:
        """Raise the exception of the broken pipe again, so that ``to_stdout`` handles it."""
        raise


def print_json(data: Any, indent: int | None = None) -> None:
    """Print data as one line of JSON on stdout; NaN and infinities are refused, since JSON has neither."""
    json.dump(data, sys.stdout, indent=indent, allow_nan=False)
    sys.stdout.write("\n")
