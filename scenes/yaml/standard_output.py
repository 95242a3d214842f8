"""What commands write: results to stdout, all of them or an exit code that says so, and errors to stderr."""

from __future__ import annotations

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
"""Error numbers of failures of the machine, such as a full disk, and not of what a user named."""
PIPE_CLOSED = 128 + signal.SIGPIPE
"""Exit code with which a shell tells of a program that the signal has ended."""


def print_error(errors: Console, text: str) -> None:
    """One error message, as it is: no markup, no wrapping; control characters as escapes."""
    text = "\n".join(printable(line) for line in text.split("\n"))
    errors.print(f"error: {text}", style="bold red", markup=False, highlight=False, soft_wrap=True)


def code_of(error: BaseException | None) -> int:
    """Return the exit code of a failure to write: FAILURE where the machine is its cause, else BAD_INPUT."""
    return FAILURE if isinstance(error, OSError) and error.errno in _OF_THE_MACHINE else BAD_INPUT


@contextmanager
def to_stdout(errors: Console, kept: str = "") -> Iterator[None]:
    """Inside the block the results are written to stdout, all of them before it ends.

    A reader that has seen enough, as ``head`` has, ends the command without a word, as it does other programs.

    Parameters
    ----------
    errors : Console
        Where it is told that stdout cannot be written, on a full disk for instance.
    kept : str
        Where the results are all the same, for this message.

    Raises
    ------
    typer.Exit
        It cannot.
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
    """Let nobody try again to write what is left in the buffers: the interpreter does at its end."""
    try:
        place = sys.stdout.fileno()
    except (OSError, ValueError):  # it is no file
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, place)
    os.close(nowhere)


class Terminal(Console):
    """The terminal for results. That nobody reads any longer is left to ``to_stdout``."""

    def on_broken_pipe(self) -> None:
        """Raise it again."""
        raise


def print_json(data: Any, indent: int | None = None) -> None:
    """One line of JSON on stdout; NaN and infinities are refused, since JSON has none."""
    json.dump(data, sys.stdout, indent=indent, allow_nan=False)
    sys.stdout.write("\n")
