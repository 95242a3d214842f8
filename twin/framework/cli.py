"""Shared parts of the commands: options, exit codes, error messages in one sentence, and a clean end on signals."""

import errno
import math
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer
from rich import box, progress
from rich.console import Console
from rich.table import Table
from typer.core import TyperGroup

from optics.numerics.backend import NAMES
from scenes.yaml.errors import InputError, nearest
from scenes.yaml.standard_output import BAD_INPUT, FAILURE, code_of, print_error

DOUBTFUL, INTERRUPTED = 3, 128 + signal.SIGINT
NO_NAME = (errno.ENAMETOOLONG, errno.ELOOP)
"""Error numbers that the operating system returns for paths that no file can have, such as too long ones."""
LARGEST_SEED = 2**63 - 1
BACKEND_HELP = f"Backend of the ray trace: {' or '.join(NAMES)}."
OUT_HELP = "Run folder to make. Default: runs/NAME-001, -002, ... (the first free one), with the NAME of the file."

File = Annotated[Path, typer.Argument(readable=False, help="YAML file of the test, or the config.yaml of a run.")]
Out = Annotated[Path | None, typer.Option(metavar="DIR", readable=False, help=OUT_HELP)]
Seed = Annotated[
    int | None, typer.Option(min=0, max=LARGEST_SEED, help="Seed of all random numbers; overrides that of the file.")
]
BackendName = Annotated[str, typer.Option("--backend", help=BACKEND_HELP)]
Force = Annotated[bool, typer.Option("--force", help="Replace the run folder if it exists.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout, and nothing else.")]
EXPORT_HELP = "Also write the measurements as a folder of tables that the same command can read, with a test file."
Export = Annotated[Path | None, typer.Option("--export", readable=False, metavar="DIR", help=EXPORT_HELP)]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
STRICT_HELP = "Exit with code 3 if a sigma is not reliable or another verdict on the result is negative."
Strict = Annotated[bool, typer.Option("--strict", help=STRICT_HELP)]
WORKERS_HELP = "Number of worker processes. Default: one for each core."
Workers = Annotated[int | None, typer.Option(min=1, max=1024, help=WORKERS_HELP)]
SCHEDULER_HELP = "Address of a running Dask cluster to use, as for `python -m twin.study --scheduler`."
Scheduler = Annotated[str | None, typer.Option(help=SCHEDULER_HELP)]


@dataclass(frozen=True)
class Options:
    """Options that the user chose; every field is an option of the commands that make a run folder, see `with_options`.

    Attributes
    ----------
    out : Path | None
        Run folder; None for the next free one.
    seed : int | None
        Seed; None for that of the file.
    export : Path | None
        Folder for the measured data; None for no export.
    backend : str
        Backend of the ray trace.
    force : bool
        True to replace an existing run folder.
    as_json : bool
        True to print the numbers as JSON.
    quiet : bool
        True to print nothing but errors.
    strict : bool
        True to end with the exit code DOUBTFUL if a verdict on the result is negative.
    """

    out: Out = None
    seed: Seed = None
    export: Export = None
    backend: BackendName = "llvm"
    force: Force = False
    as_json: AsJson = False
    quiet: Quiet = False
    strict: Strict = False

    @property
    def silent(self) -> bool:
        """True if the user asked for no output but the result (--quiet or --json), so that no progress is shown."""
        return self.as_json or self.quiet


Command = Callable[..., None]
"""Function from whose signature Typer makes a command with arguments and options."""


def program(**more: Any) -> typer.Typer:
    """Return a Typer application without commands, with the settings that all programs share.

    Further arguments go to Typer.
    """
    return typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False, **more)


def unnamed(meant: Callable[[Sequence[str]], str]) -> type[TyperGroup]:
    """Return a class for Typer programs whose subcommand may be omitted.

    Parameters
    ----------
    meant : callable
        Function that chooses the subcommand from the arguments if the first of them is not a subcommand.
    """

    class Group(TyperGroup):
        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            return list(super().parse_args(ctx, self.whole(args)))

        def whole(self, args: list[str]) -> list[str]:
            """Return the command-line arguments with the omitted subcommand put before them."""
            named = not args or args[0] in self.commands or args[0] == "--help"
            return args if named else [meant(args), *args]

    return Group


def with_options(*without: str) -> Callable[[Command], Command]:
    """Return a decorator that adds the options of `Options` to a command and passes them as its parameter ``options``.

    Parameters
    ----------
    without : str
        Fields of `Options` that the command does not offer.
    """
    hints = get_type_hints(Options, include_extras=True)
    chosen = {parameter.name: parameter.default for parameter in fields(Options) if parameter.name not in without}
    shared = [Parameter(name, Parameter.KEYWORD_ONLY, default=chosen[name], annotation=hints[name]) for name in chosen]

    def made(work: Command) -> Command:
        def command(**arguments: Any) -> None:
            options = Options(**{name: arguments.pop(name) for name in chosen})
            work(**arguments, options=options)

        parameters = [
            parameter for parameter in signature(work, eval_str=True).parameters.values() if parameter.name != "options"
        ]
        return with_parameters(wraps(work)(command), [*parameters, *shared])

    return made


def with_parameters(command: Command, parameters: Sequence[Parameter]) -> Command:
    """Return a command that takes its arguments by keyword, with the parameters from which Typer makes its options."""
    command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def end_strictly(errors: Console, numbers: Any) -> None:
    """End with the exit code DOUBTFUL if a verdict on the result is negative.

    Parameters
    ----------
    errors : Console
        Console that lists the negative verdicts.
    numbers : Any
        Numbers of the result, plain data.

    Raises
    ------
    typer.Exit
        A verdict is negative, see `twin.framework.provenance.negative_verdicts`.
    """
    from twin.framework.durable import first_names
    from twin.framework.provenance import negative_verdicts

    if negative := negative_verdicts(numbers):
        print_error(
            errors, f"--strict: the result is not reliable, since these verdicts are false: {first_names(negative)}"
        )
        raise typer.Exit(DOUBTFUL)


class InputErrorText(Exception):
    """Error of an invalid input that is not in a file, such as an option; the message names it."""


class Incomplete(Exception):
    """Error for work that could not be completed although the request is valid; the message gives the reason.

    Attributes
    ----------
    trace : str
        Traceback of a program error in another process, as text.
    """

    def __init__(self, message: str, trace: str = "") -> None:
        super().__init__(message)
        self.trace = trace


def require_one_of(option: str, value: str, allowed: Collection[str]) -> None:
    """Raise InputErrorText if the value of an option is not one of those allowed.

    Raises
    ------
    InputErrorText
        The value is not one of those allowed.
    """
    if value not in allowed:
        near = nearest(value, allowed)
        meant = f"; did you mean {near!r}?" if near else ";"
        raise InputErrorText(f"{option}: no such format, {value!r}{meant} allowed: {', '.join(allowed)}")


def check_backend(name: str) -> None:
    """Raise InputErrorText for an unknown backend, before any work starts.

    Raises
    ------
    InputErrorText
        No backend has this name.
    """
    if name not in NAMES:
        raise InputErrorText(f"unknown backend {name!r}; choose {' or '.join(NAMES)}")


def no_results_kept() -> str:
    """Return the message of a command that keeps no results when it is interrupted."""
    return "nothing was kept"


@contextmanager
def explained(errors: Console, left: Callable[[], str] = no_results_kept) -> Iterator[None]:
    """Turn errors that a user can cause into one sentence on ``errors`` and the command's exit code.

    Parameters
    ----------
    errors : Console
        Console for the sentence.
    left : callable
        Function that returns the text on what is kept of interrupted work.
    """
    try:
        yield
    except (InputError, InputErrorText) as error:
        print_error(errors, str(error))
        raise typer.Exit(BAD_INPUT) from None
    except KeyboardInterrupt:
        _print_interruption(errors, f"interrupted: {left()}")
        raise typer.Exit(INTERRUPTED) from None
    except SystemExit:
        if left is not no_results_kept:
            _print_interruption(errors, f"terminated: {left()}")
        raise
    except Incomplete as error:
        errors.print(error.trace, end="", markup=False, highlight=False, soft_wrap=True)
        print_error(errors, f"{error}; {left()}")
        raise typer.Exit(FAILURE) from None
    except OSError as error:
        if error.errno not in NO_NAME or not error.filename:
            raise
        print_error(errors, f"{str(error.filename)[:80]}: {error.strerror}")
        raise typer.Exit(BAD_INPUT) from None
    except Exception as error:
        # imported here, so that help and errors in a file do not wait for them
        from optics.numerics.array_math import PhysicalError, UnphysicalError
        from optics.numerics.backend import BackendUnavailable
        from optics.numerics.extension_table import EntryPointError
        from optics.numerics.llvm import LibraryMissing
        from twin.framework.run_folder import RunFolderError

        # an unphysical number is a fault of the program; light that a state loses is a fault of the request
        asked = isinstance(error, RunFolderError | PhysicalError) and not isinstance(error, UnphysicalError)
        if not asked and not isinstance(error, BackendUnavailable | EntryPointError | LibraryMissing):
            raise
        print_error(errors, str(error))
        raise typer.Exit(code_of(error.__cause__) if asked else FAILURE) from None


def _print_interruption(errors: Console, text: str) -> None:
    errors.print(text, style="bold red", markup=False, highlight=False, soft_wrap=True)


TICK_SECONDS = 8.0
"""Interval between two progress lines where there is no terminal, in seconds: no user waits longer than 10 s for a sign
of life.
"""


@contextmanager
def heartbeat(
    console: Console, status: Callable[[], str], silent: bool, seconds: float | None = None
) -> Iterator[None]:
    """Print a progress line at regular intervals inside the block, unless a terminal shows the progress.

    Parameters
    ----------
    console : Console
        Console for the lines; if it is a terminal, nothing is printed, since it shows the progress itself.
    status : callable
        Returns the text of a line.
    silent : bool
        True to print nothing.
    seconds : float | None
        Interval between two lines, in seconds; None for TICK_SECONDS.
    """
    if silent or console.is_terminal:
        yield
        return
    ended, pause = threading.Event(), TICK_SECONDS if seconds is None else seconds

    def beat() -> None:
        while not ended.wait(pause):
            console.print(f"progress: {status()}", markup=False, highlight=False, soft_wrap=True)

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()  # so that no line is printed after the block


LONG = 300.0
"""Remaining time above which the expected duration is announced once, in seconds."""
_PACE_SECONDS = 5.0
"""Time after which the speed of a part of the work can be estimated, in seconds: its first steps also include
compilation.
"""


@dataclass
class WorkProgress:
    """Progress of a command's work, which reports to it by calling ``advance``."""

    part: str = "start"
    done: int = 0
    total: int = 1
    begun: float = field(default_factory=time.monotonic)
    before: int = 0
    shortest: float = math.inf

    def advance(self, part: str, done: int, total: int) -> None:
        """Record that ``done`` of ``total`` steps of a part of the work are done."""
        if part != self.part or done < self.done:
            self.begun, self.before, self.shortest = time.monotonic(), done, math.inf
        self.part, self.done, self.total = part, done, total

    @property
    def left(self) -> float:
        """Remaining time of the current part, in seconds, estimated from its speed so far; 0 if no step is done.

        It never grows: where the work becomes slower, it stays at its shortest estimate.
        """
        spent, pieces = time.monotonic() - self.begun, self.done - self.before
        if pieces <= 0:
            return 0.0
        self.shortest = min(self.shortest, spent * (self.total - self.done) / pieces)
        return self.shortest

    @property
    def long(self) -> bool:
        """True if the remaining time of the current part is known and exceeds `LONG`."""
        return time.monotonic() - self.begun > _PACE_SECONDS and self.left > LONG

    def __str__(self) -> str:
        text = f"{self.part}: {self.done} of {self.total}" if self.total > 1 else self.part
        text += f", {time_text(time.monotonic() - self.begun)} so far"
        if self.left:
            text += f", about {time_text(self.left)} left"
        return text


def time_text(seconds: float | None) -> str:
    """Format a duration given in seconds as text: ``45 s``, ``3 min`` or ``2.5 h``."""
    if seconds is None:
        return "an unknown time"
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


def progress_columns(width: int) -> tuple[progress.ProgressColumn, ...]:
    """Return the columns of a progress display: description of ``width`` letters, bar, elapsed and remaining time."""
    return (
        progress.SpinnerColumn(),
        progress.TextColumn(f"{{task.description:{width}}}", markup=False),
        progress.BarColumn(),
        progress.TimeElapsedColumn(),
        progress.TextColumn("left"),
        progress.TimeRemainingColumn(),
    )


def result_table(title: str | None = None) -> Table:
    """Return an empty table, in the style of all commands, in which a result is printed in the terminal."""
    return Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)


def print_whole(console: Console, table: Table) -> None:
    """Print a table at its full width, so that no number is cut off; the terminal wraps longer lines."""
    console.width = max(console.width, console.measure(table, options=console.options.update(width=1000)).maximum)
    console.print(table)


def print_paths(console: Console, target: Path) -> None:
    """Print the paths of the run folder and its report."""
    console.print(f"run folder: {target}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"report:     {target / 'report.html'}", markup=False, highlight=False, soft_wrap=True)


def print_verdict(console: Console, verdict: str, unmet: bool = False, warned: bool = False) -> None:
    """Print the verdict of a result: red if a requirement is not met, yellow if there are warnings.

    Parameters
    ----------
    console : Console
        Terminal.
    verdict : str
        Verdict, one or two sentences.
    unmet : bool
        True if a requirement is not met or an alarm is open.
    warned : bool
        True if the result has warnings.
    """
    style = "bold red" if unmet else "bold yellow" if warned else "bold"
    console.print(verdict, style=style, markup=False, highlight=False, soft_wrap=True)
