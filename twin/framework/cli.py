"""What the commands share: options, exit codes, errors as one sentence, and an orderly end on signals."""

from __future__ import annotations

import errno
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
"""Error numbers of names that no file can have."""
LARGEST_SEED = 2**63 - 1
BACKEND_HELP = f"Where to trace: {' or '.join(NAMES)}."
OUT_HELP = "Run folder to make. Default: runs/NAME-001, -002, ... (the first that is free), NAME that of the file."

File = Annotated[Path, typer.Argument(readable=False, help="YAML file of the test, or the config.yaml of a run.")]
Out = Annotated[Path | None, typer.Option(readable=False, help=OUT_HELP)]
Seed = Annotated[
    int | None, typer.Option(min=0, max=LARGEST_SEED, help="Seed of everything drawn; overrides the file's.")
]
BackendName = Annotated[str, typer.Option("--backend", help=BACKEND_HELP)]
Force = Annotated[bool, typer.Option("--force", help="Replace the run folder if it exists.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout, and nothing else.")]
EXPORT_HELP = "Also write what was measured as a folder of tables that the same command reads, with a test file."
Export = Annotated[Path | None, typer.Option("--export", readable=False, metavar="DIR", help=EXPORT_HELP)]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
STRICT_HELP = "Exit with code 3 where a sigma does not hold or another verdict on the result is negative."
Strict = Annotated[bool, typer.Option("--strict", help=STRICT_HELP)]
WORKERS_HELP = "Number of worker processes. Default: one for each core."
Workers = Annotated[int | None, typer.Option(min=1, max=1024, help=WORKERS_HELP)]
SCHEDULER_HELP = "Use a running Dask cluster, as of `python -m twin.study --scheduler`."
Scheduler = Annotated[str | None, typer.Option(help=SCHEDULER_HELP)]


@dataclass(frozen=True)
class Options:
    """What the user chose: every field is an option of the commands that make a run folder, see `with_options`.

    Attributes
    ----------
    out : Out
        Run folder, None for the next free one.
    seed : Seed
        None for the file's.
    export : Export
        Folder for what was measured, None for none.
    backend : BackendName
        Where to trace.
    force : Force
        Replace the run folder.
    as_json : AsJson
        Print the numbers as JSON.
    quiet : Quiet
        Print nothing.
    strict : Strict
        End with the exit code DOUBTFUL where a verdict on the result is negative.
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
        """Whether no progress is shown."""
        return self.as_json or self.quiet


Command = Callable[..., None]
"""Function of whose signature Typer makes a command with its arguments and options."""


def program(**more: Any) -> typer.Typer:
    """Return a program without commands, set up as all are; ``more`` goes to Typer."""
    return typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False, **more)


def unnamed(meant: Callable[[Sequence[str]], str]) -> type[TyperGroup]:
    """Return the class of a program whose subcommand need not be named.

    Parameters
    ----------
    meant : Callable[[Sequence[str]], str]
        Words after the program, of which the first is no subcommand -> the subcommand.
    """

    class Group(TyperGroup):
        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            return list(super().parse_args(ctx, self.whole(args)))

        def whole(self, args: list[str]) -> list[str]:
            """Return the arguments with the subcommand before them."""
            named = not args or args[0] in self.commands or args[0] == "--help"
            return args if named else [meant(args), *args]

    return Group


def with_options(*without: str) -> Callable[[Command], Command]:
    """Return what gives a command the options of `Options`, for its parameter ``options``, after its own.

    Parameters
    ----------
    without : str
        Fields of `Options` that are no options of the command.
    """
    hints = get_type_hints(Options, include_extras=True)
    chosen = {one.name: one.default for one in fields(Options) if one.name not in without}
    shared = [Parameter(name, Parameter.KEYWORD_ONLY, default=chosen[name], annotation=hints[name]) for name in chosen]

    def made(work: Command) -> Command:
        def command(**given: Any) -> None:
            options = Options(**{name: given.pop(name) for name in chosen})
            work(**given, options=options)

        own = [one for one in signature(work, eval_str=True).parameters.values() if one.name != "options"]
        return with_parameters(wraps(work)(command), [*own, *shared])

    return made


def with_parameters(command: Command, parameters: Sequence[Parameter]) -> Command:
    """Return a command that takes its arguments by name, with the parameters of which Typer makes them."""
    command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {one.name: one.annotation for one in parameters}
    return command


def end_strictly(errors: Console, numbers: Any) -> None:
    """End with the exit code of a result whose sigmas do not hold.

    Parameters
    ----------
    errors : Console
        Where the negative verdicts are named.
    numbers : Any
        Of the result, plain data.

    Raises
    ------
    typer.Exit
        a verdict is negative, see `twin.framework.provenance.negative_verdicts`.
    """
    from twin.framework.owned_files import first_names
    from twin.framework.provenance import negative_verdicts

    if negative := negative_verdicts(numbers):
        print_error(errors, f"--strict: not to be relied on, false in the result: {first_names(negative)}")
        raise typer.Exit(DOUBTFUL)


class InputErrorText(Exception):
    """Bad input that has no file to point at."""


class Incomplete(Exception):
    """Work that could not be completed although nothing is wrong with what was asked; the message says why.

    Attributes
    ----------
    trace
        Traceback of a fault of the program in another process, as text.
    """

    def __init__(self, message: str, trace: str = "") -> None:
        super().__init__(message)
        self.trace = trace


def require_one_of(option: str, value: str, allowed: Collection[str]) -> None:
    """Complain about a format that an option does not have.

    Raises
    ------
    InputErrorText
        The value is none of those allowed.
    """
    if value not in allowed:
        near = nearest(value, allowed)
        meant = f"; did you mean {near!r}?" if near else ";"
        raise InputErrorText(f"{option}: no such format, {value!r}{meant} allowed: {', '.join(allowed)}")


def check_backend(name: str) -> None:
    """Complain about an unknown backend before anything is started.

    Raises
    ------
    InputErrorText
        There is none of that name.
    """
    if name not in NAMES:
        raise InputErrorText(f"unknown backend {name!r}; choose {' or '.join(NAMES)}")


def nothing_kept() -> str:
    """What is left of most commands that are broken off."""
    return "nothing was kept"


@contextmanager
def explained(errors: Console, left: Callable[[], str] = nothing_kept) -> Iterator[None]:
    """Turn the errors that a user can cause into one sentence on ``errors`` and the command's exit code.

    Parameters
    ----------
    errors : Console
        Where it is said.
    left : Callable[[], str]
        What is left of the work when it is broken off.
    """
    try:
        yield
    except (InputError, InputErrorText) as error:
        print_error(errors, str(error))
        raise typer.Exit(BAD_INPUT) from None
    except KeyboardInterrupt:
        _say_broken(errors, f"interrupted: {left()}")
        raise typer.Exit(INTERRUPTED) from None
    except SystemExit:
        if left is not nothing_kept:
            _say_broken(errors, f"terminated: {left()}")
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
        # the work that failed has imported these; help and a bad file do not wait for them
        from optics.numerics.array_math import PhysicalError, UnphysicalError
        from optics.numerics.backend import BackendUnavailable
        from optics.numerics.extension_table import EntryPointError
        from optics.numerics.llvm import LibraryMissing
        from twin.framework.run_folder import RunFolderError

        # a number that cannot be is a fault of the program; light that a state loses is one of what was asked for
        asked = isinstance(error, RunFolderError | PhysicalError) and not isinstance(error, UnphysicalError)
        if not asked and not isinstance(error, BackendUnavailable | EntryPointError | LibraryMissing):
            raise
        print_error(errors, str(error))
        raise typer.Exit(code_of(error.__cause__) if asked else FAILURE) from None


def _say_broken(errors: Console, text: str) -> None:
    errors.print(text, style="bold red", markup=False, highlight=False, soft_wrap=True)


TICK_SECONDS = 8.0
"""From one line of progress to the next where there is no terminal: nobody waits longer than 10 s for a word."""


@contextmanager
def heartbeat(console: Console, says: Callable[[], str], silent: bool, seconds: float | None = None) -> Iterator[None]:
    """Inside the block a line now and then says how far a command is, where no terminal shows it.

    Parameters
    ----------
    console : Console
        Where it is said; nothing is where it is a terminal, which shows progress itself.
    says : Callable[[], str]
        One line.
    silent : bool
        Whether nothing shall be said.
    seconds : float | None
        From one line to the next, None for TICK_SECONDS.
    """
    if silent or console.is_terminal:
        yield
        return
    ended, pause = threading.Event(), TICK_SECONDS if seconds is None else seconds

    def beat() -> None:
        while not ended.wait(pause):
            console.print(f"progress: {says()}", markup=False, highlight=False, soft_wrap=True)

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()  # no line comes after the block


LONG = 300.0
"""Seconds of work above which it is said once how long it takes."""
_TELLING = 5.0
"""Seconds of a part that tell its pace: the first ones also compile."""


@dataclass
class Standing:
    """How far a piece of work is; ``advance`` is what it calls."""

    part: str = "start"
    done: int = 0
    total: int = 1
    begun: float = field(default_factory=time.monotonic)
    before: int = 0

    def advance(self, part: str, done: int, total: int) -> None:
        """So many of so many parts of this are done."""
        if part != self.part or done < self.done:
            self.begun, self.before = time.monotonic(), done
        self.part, self.done, self.total = part, done, total

    @property
    def left(self) -> float:
        """Seconds that the part still takes, by the pieces that were done since it began; 0 where none tells it."""
        spent, pieces = time.monotonic() - self.begun, self.done - self.before
        return spent * (self.total - self.done) / pieces if pieces > 0 else 0.0

    @property
    def long(self) -> bool:
        """Whether the part still takes long, as far as it can be told."""
        return time.monotonic() - self.begun > _TELLING and self.left > LONG

    def __str__(self) -> str:
        text = f"{self.part}: {self.done} of {self.total}" if self.total > 1 else self.part
        text += f", {time_text(time.monotonic() - self.begun)} so far"
        if self.left:
            text += f", about {time_text(self.left)} left"
        return text


def time_text(seconds: float | None) -> str:
    """A time in the unit that suits it."""
    if seconds is None:
        return "an unknown time"
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


def progress_columns(width: int) -> tuple[progress.ProgressColumn, ...]:
    """Columns of a progress display: what is done, in ``width`` letters, how far, since when and for how long."""
    return (
        progress.SpinnerColumn(),
        progress.TextColumn(f"{{task.description:{width}}}", markup=False),
        progress.BarColumn(),
        progress.TimeElapsedColumn(),
        progress.TextColumn("left"),
        progress.TimeRemainingColumn(),
    )


def result_table(title: str | None = None) -> Table:
    """An empty table for a result in the terminal."""
    return Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)


def print_whole(console: Console, table: Table) -> None:
    """A table with all its digits: a number that is cut is worse than a line that wraps."""
    console.width = max(console.width, console.measure(table, options=console.options.update(width=1000)).maximum)
    console.print(table)


def print_place(console: Console, target: Path) -> None:
    """Where the run folder and its report are."""
    console.print(f"run folder: {target}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"report:     {target / 'report.html'}", markup=False, highlight=False, soft_wrap=True)


def print_verdict(console: Console, verdict: str) -> None:
    """The sentence that a result begins with."""
    console.print(verdict, style="bold", markup=False, highlight=False, soft_wrap=True)
