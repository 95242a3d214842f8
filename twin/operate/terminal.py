"""What the commands of `twin.operate` share: where the record is, errors in one sentence, results in the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer
from rich.console import Console

from scenes.yaml.standard_output import FAILURE, Terminal, print_error, print_json, to_stdout
from twin.operate.record.place import NotARecord, RecordFailed, file_of, require_file
from twin.run.cli import InputErrorText, explained

Place = Annotated[
    str,
    typer.Argument(
        metavar="DIR_OR_URL", help="Folder of the record, or address of a database: postgresql://host/name."
    ),
]


def require_record(place: str) -> None:
    """Tell that a folder holds no record, before what reads a record is imported.

    Raises:
        typer.Exit: it holds none, which has been told.
    """
    if (file := file_of(place)) is not None:
        with told():
            require_file(file)


@contextmanager
def told() -> Iterator[Console]:
    """Errors as one sentence and an exit code."""
    errors = Console(stderr=True)
    with explained(errors):
        try:
            yield errors
        except NotARecord as error:
            raise InputErrorText(str(error)) from None
        except RecordFailed as error:
            print_error(errors, f"the database cannot do it: {error}; what was not told as taken is not in the record")
            raise typer.Exit(FAILURE) from None


def tell(errors: Console, as_json: bool, quiet: bool, data: Any, show: Callable[[Console], None]) -> None:
    """A result, as JSON or as a reader wants it.

    Args:
        errors: where it is told that standard output is gone.
        as_json: print ``data``.
        quiet: print nothing else.
        data: plain data.
        show: prints it for a reader.
    """
    with to_stdout(errors, "the record is as it was told"):
        if as_json:
            print_json(data)
        elif not quiet:
            show(Terminal())


def line(console: Console, text: str) -> None:
    """A line as it is."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)
