"""What the commands of `twin.operate` share: the record, the estimate under its plan, errors and results in words."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from scenes.yaml.errors import Problem
from scenes.yaml.standard_output import FAILURE, Terminal, print_error, print_json, to_stdout
from twin.framework import cli, durable
from twin.framework.cli import InputErrorText
from twin.operate.record import NotARecord, RecordFailed, file_of, require_file

if TYPE_CHECKING:
    from scenes.specs.operation import OperationSetup
    from twin.operate.estimate.operation_filter import Operation
    from twin.operate.estimate.reported_estimate import FilterResult
    from twin.operate.record.entries import Alarm
    from twin.operate.record.history import History

Place = Annotated[
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
"""What gives a command the options ``--json`` and ``--quiet``."""
NewFolder = Annotated[Path, typer.Option(readable=False, help="Folder for them; it must not be there yet.")]


@contextmanager
def told() -> Iterator[Console]:
    """Errors as one sentence and an exit code."""
    errors = Console(stderr=True)
    with cli.explained(errors):
        try:
            yield errors
        except NotARecord as error:
            raise InputErrorText(str(error)) from None
        except RecordFailed as error:
            print_error(errors, f"the database cannot do it: {error}; what was not told as taken is not in the record")
            raise typer.Exit(FAILURE) from None


@contextmanager
def input_errors(what: str = "") -> Iterator[None]:
    """Raise InputErrorText for a Problem of what a command was asked for: an option with its dashes, or its place."""
    try:
        yield
    except Problem as problem:
        text = str(problem.at("")).removeprefix("input: ")
        raise InputErrorText(f"{what}: {text}" if what else text) from None


def utc_option(option: str, text: str) -> int:
    """Microseconds of TAI since 2000 of a UTC that a command was given.

    Parameters
    ----------
    option : str
        With its dashes.
    text : str
        After it.

    Raises
    ------
    InputErrorText
        Not a date and time.
    """
    from twin.operate.record.entries import micros

    with input_errors(option):
        return micros(text)


def tell(errors: Console, options: cli.Options, data: Any, show: Callable[[Console], None]) -> None:
    """Print a result, as JSON or as a reader wants it.

    Parameters
    ----------
    errors : Console
        Where it is told that standard output is gone.
    options : cli.Options
        Whether ``data`` are printed, or nothing is.
    data : Any
        Plain data.
    show : Callable[[Console], None]
        Prints it for a reader.
    """
    with to_stdout(errors, "the record is as it was told"):
        if options.as_json:
            print_json(data)
        elif not options.quiet:
            show(Terminal())


def line(console: Console, text: str) -> None:
    """Print a line as it is."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def show_table(console: Console, heads: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[int]) -> None:
    """Print a table, the columns of these numbers flush right."""
    table = cli.result_table()
    for k, head in enumerate(heads):
        table.add_column(head, justify="right" if k in right else "left")
    for row in rows:
        table.add_row(*row)
    cli.print_whole(console, table)


@dataclass(frozen=True)
class Call:
    """A command at work on a record.

    Attributes
    ----------
    place : str
        Folder or address of the record.
    history : History
        The record.
    errors : Console
        Where errors and the progress are told.
    options : cli.Options
        ``as_json`` and ``quiet``.
    """

    place: str
    history: History
    errors: Console
    options: cli.Options

    def tell(self, data: Any, show: Callable[[Console], None]) -> None:
        """Print a result; arguments as of `tell`."""
        tell(self.errors, self.options, data, show)

    def planned(self, plan: Path | None) -> OperationSetup:
        """Return the plan in a file, or that of the record. Raises InputError; InputErrorText: the record has none."""
        from twin.operate.estimate.operation_model import read_plan, stored_plan

        setup = stored_plan(self.history) if plan is None else read_plan(plan, self.history)
        if setup is None:
            raise InputErrorText(
                f"the record keeps no plan of operation; name one, or keep one: python -m twin.operate init RECORD "
                f"{self.history.name} --plan FILE"
            )
        return setup

    def followed(self, setup: OperationSetup, history: History | None = None) -> Operation:
        """Return the estimate of the record under a plan, with all readings; how far it is is told now and then.

        Parameters
        ----------
        setup : OperationSetup
            The plan.
        history : History | None
            The record as it was at an earlier time, in place of the command's.

        Raises
        ------
        InputErrorText
            There is no reading of the monitor.
        """
        from twin.operate.estimate.operation_filter import Operation

        position, history = cli.WorkProgress("follow the record"), history or self.history
        with input_errors(history.url), cli.heartbeat(self.errors, position.__str__, self.options.silent):
            made = Operation(history, setup, lambda done, of: position.advance("readings", done, of))
            made.filter_readings()
        return made

    @property
    def has_estimate(self) -> bool:
        """Whether the record has a plan and a reading of the monitor."""
        return self.history.plan() is not None and self.history.first("monitor") is not None

    def estimate(self, plan: Path | None = None) -> tuple[Operation, FilterResult, list[Alarm]]:
        """Return the estimate under a plan, what it says, and the alarms that are new, which are then in the record."""
        from twin.operate.estimate.reported_estimate import raise_alarms

        operation = self.followed(self.planned(plan))
        filter_result = operation.filter_readings()
        return operation, filter_result, raise_alarms(self.history, operation.plan.operation, filter_result)

    def write_new(self, out: Path, files: Mapping[str, bytes], what: str) -> None:
        """Write files into a new folder.

        Parameters
        ----------
        out : Path
            The folder, see `require_new`.
        files : Mapping[str, bytes]
            Path in it -> content.
        what : str
            They are.

        Raises
        ------
        typer.Exit
            They cannot be written, which has been told.
        """
        try:
            for folder in sorted({out, *((out / name).parent for name in files)}):
                durable.make_folders(folder)
            durable.write_all_safely((out / name, content) for name, content in files.items())
        except OSError as error:
            print_error(self.errors, f"{out}: {error.strerror or error}; what is there is not all of the {what}")
            raise typer.Exit(FAILURE) from None


def require_new(out: Path) -> None:
    """Refuse a folder that is there. Raises InputErrorText."""
    if out.exists():
        raise InputErrorText(f"--out: {out} is there already; name a folder that is not")


def on_record(work: Callable[..., None]) -> Callable[..., None]:
    """Return the command that opens a record and does some work on it.

    Parameters
    ----------
    work : Callable[..., None]
        Called with a `Call` and with the options of its signature; the record comes before them, ``--json`` and
        ``--quiet`` after them.
    """

    def command(record: str, options: cli.Options, **given: Any) -> None:
        with told() as errors:
            if (file := file_of(record)) is not None:
                require_file(file)  # before what reads a database is imported
            from twin.operate.record.history import History

            with History(record) as history:
                work(Call(record, history, errors, options), **given)

    _, *own = signature(work, eval_str=True).parameters.values()
    place = Parameter("record", Parameter.POSITIONAL_OR_KEYWORD, annotation=Place)
    return json_and_quiet(cli.with_parameters(wraps(work)(command), [place, *own]))
