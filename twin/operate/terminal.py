"""Functions shared by the commands of `twin.operate`: record, estimate under its plan, errors and output."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from scenes.yaml.errors import Problem
from scenes.yaml.standard_output import FAILURE, Terminal, print_error, print_json, to_stdout
from twin.framework import cli
from twin.framework.cli import InputErrorText
from twin.operate.record import NotARecord, RecordFailed, file_of, require_file

if TYPE_CHECKING:
    from scenes.specs.operation import OperationSetup
    from twin.framework.run_folder import RunFolder
    from twin.operate.estimate.operation_filter import Operation
    from twin.operate.estimate.reported_estimate import FilterResult
    from twin.operate.record.entries import Alarm
    from twin.operate.record.history import History

RecordLocation = Annotated[
    str,
    typer.Argument(
        metavar="DIR_OR_URL", help="Folder of the record, or address of a database: postgresql://host/name."
    ),
]
PlanFile = Annotated[
    Path | None,
    typer.Argument(metavar="[PLAN.yaml]", readable=False, help="Plan of operation. Default: that of the record."),
]
json_and_quiet = cli.with_options("out", "seed", "export", "backend", "force", "strict")
"""Decorator that gives a command the options ``--json`` and ``--quiet``."""
NewFolder = Annotated[Path, typer.Option(metavar="DIR", readable=False, help="Folder for them.")]


@contextmanager
def errors_reported() -> Iterator[Console]:
    """Catch errors of a command, print each as one sentence, and end the command with its exit code."""
    errors = Console(stderr=True)
    with cli.explained(errors):
        try:
            yield errors
        except NotARecord as error:
            raise InputErrorText(str(error)) from None
        except RecordFailed as error:
            print_error(errors, f"the database failed: {error}; only files reported as taken are in the record")
            raise typer.Exit(FAILURE) from None


@contextmanager
def input_errors(what: str = "") -> Iterator[None]:
    """Convert a Problem to an InputErrorText about ``what``, an option (with its dashes) or a path."""
    try:
        yield
    except Problem as problem:
        text = str(problem.at("")).removeprefix("input: ")
        raise InputErrorText(f"{what}: {text}" if what else text) from None


def utc_option(option: str, text: str) -> int:
    """Return the UTC given to an option, in microseconds of TAI since 2000.

    Parameters
    ----------
    option : str
        Option with its dashes.
    text : str
        Value of the option.

    Raises
    ------
    InputErrorText
        The value is not a date and time.
    """
    from twin.operate.record.entries import micros

    with input_errors(option):
        return micros(text)


def print_result(errors: Console, options: cli.Options, data: Any, show: Callable[[Console], None]) -> None:
    """Print the result of a command, as JSON or as text.

    Parameters
    ----------
    errors : Console
        Console for error messages, such as that standard output is closed.
    options : cli.Options
        Options that choose JSON, words or nothing.
    data : dict, list, number, str or None
        Plain data of the result.
    show : Callable[[Console], None]
        Function that prints the result in words.
    """
    with to_stdout(errors, "the record is complete"):
        if options.as_json:
            print_json(data)
        elif not options.quiet:
            show(Terminal())


def print_line(console: Console, text: str) -> None:
    """Print a line of text as it is, without interpreting markup."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def show_table(console: Console, heads: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[int]) -> None:
    """Print a table; the columns of the given numbers are aligned to the right."""
    table = cli.result_table()
    for k, head in enumerate(heads):
        table.add_column(head, justify="right" if k in right else "left")
    for row in rows:
        table.add_row(*row)
    cli.print_whole(console, table)


@dataclass(frozen=True)
class Call:
    """Command in progress on a record, with the objects that its functions share.

    Attributes
    ----------
    location : str
        Folder or address of the record.
    history : History
        Record of the instrument in operation.
    errors : Console
        Console for errors and progress.
    options : cli.Options
        Options of the command: output as JSON (``as_json``), no output (``quiet``).
    started : float
        Start of the command, seconds since the epoch.
    """

    location: str
    history: History
    errors: Console
    options: cli.Options
    started: float = field(default_factory=time.time)

    def print_result(self, data: Any, show: Callable[[Console], None]) -> None:
        """Print the result of the command, as JSON or, by the function ``show``, as text."""
        print_result(self.errors, self.options, data, show)

    def resolve_plan(self, plan: Path | None) -> OperationSetup:
        """Return the plan in a file, or the one stored in the record.

        Raises
        ------
        InputError
            The plan is not valid.
        InputErrorText
            The record has no plan.
        """
        from twin.operate.estimate.operation_model import read_plan, stored_plan

        setup = stored_plan(self.history) if plan is None else read_plan(plan, self.history)
        if setup is None:
            raise InputErrorText(self.without_plan)
        return setup

    @property
    def without_plan(self) -> str:
        """Message for a record without a plan of operation, with the command that stores one."""
        return (
            f"the record has no plan of operation; name one, or store one: python -m twin.operate init RECORD "
            f"{self.history.name} --plan FILE"
        )

    def filtered_operation(self, setup: OperationSetup, history: History | None = None) -> Operation:
        """Return the estimate of the record under a plan from all readings; progress is printed.

        Parameters
        ----------
        setup : OperationSetup
            Plan of operation.
        history : History | None
            Earlier state of the record, used instead of the command's record.

        Raises
        ------
        InputErrorText
            There is no reading of the monitor.
        """
        from twin.operate.estimate.operation_filter import Operation

        position, history = cli.WorkProgress("follow the record"), history or self.history
        with input_errors(history.url), cli.heartbeat(self.errors, position.__str__, self.options.silent):
            operation = Operation(history, setup, lambda done, of: position.advance("readings", done, of))
            operation.filter_readings()
        return operation

    @property
    def has_estimate(self) -> bool:
        """True if the record has a plan and a reading that it uses."""
        return self.history.plan() is not None and self.history.first(self.reading_kind) is not None

    @property
    def reading_kind(self) -> str:
        """Kind of the readings that the record's plan uses: ``monitor`` or ``focus``."""
        row = self.history.plan()
        return "monitor" if row is None or row["content"]["operation"].get("focus") is None else "focus"

    def estimate(self, plan: Path | None = None) -> tuple[Operation, FilterResult, list[Alarm]]:
        """Filter the record under a plan; return the estimate, its result, and new alarms, added to the record."""
        from twin.operate.estimate.reported_estimate import raise_alarms

        operation = self.filtered_operation(self.resolve_plan(plan))
        filter_result = operation.filter_readings()
        return operation, filter_result, raise_alarms(self.history, operation.plan.operation, filter_result)

    def write_files(self, folder: RunFolder, files: Mapping[str, bytes], command: str) -> None:
        """Write files into a new folder, with the manifest by which ``--force`` recognises it.

        Parameters
        ----------
        folder : RunFolder
            Folder, not yet open.
        files : Mapping[str, bytes]
            Path in the folder -> content.
        command : str
            Word of the command.

        Raises
        ------
        RunFolderError
            The files cannot be written.
        """
        from twin.framework.run_folder import write_manifest

        with folder:
            for name, content in files.items():
                folder.write_bytes(name, content)
            write_manifest(folder, "twin.operate", self.started, time.time() - self.started, test=command)


def require_new(out: Path, force: bool) -> None:
    """Raise InputErrorText if a file exists, unless the option ``force`` is used."""
    if os.path.lexists(out) and not force:
        raise InputErrorText(f"--out: {out} exists; choose another, or replace it with --force")


def on_record(work: Callable[..., None]) -> Callable[..., None]:
    """Convert a function to a command that opens a record and calls the function with it.

    Parameters
    ----------
    work : Callable[..., None]
        Function of a `Call` and of the command's options. The command has the record as its first argument, and
        ``--json`` and ``--quiet`` as its last options.
    """

    def command(record: str, options: cli.Options, **arguments: Any) -> None:
        with errors_reported() as errors:
            if (file := file_of(record)) is not None:
                require_file(file)  # check before the database library is imported
            from twin.operate.record.history import History

            with History(record) as history:
                work(Call(record, history, errors, options), **arguments)

    _, *parameters = signature(work, eval_str=True).parameters.values()
    location = Parameter("record", Parameter.POSITIONAL_OR_KEYWORD, annotation=RecordLocation)
    return json_and_quiet(cli.with_parameters(wraps(work)(command), [location, *parameters]))
