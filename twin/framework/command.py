"""The one way of the commands that make a run folder: options, progress, the folder, the result in the terminal."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, TaskID

from optics.numerics.extension_table import EntryPointError
from scenes.specs.file_kinds import read_for
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.standard_output import FAILURE, Terminal, print_error, print_json, to_stdout
from twin.framework import cli, durable
from twin.framework.procedure import Advance, Session, performed, seeded

if TYPE_CHECKING:
    from twin.framework.report import Report
    from twin.framework.run_folder import KeptWork, RunFolder


@dataclass(frozen=True, eq=False)
class Result:
    """What a command tells in the terminal when its run folder is complete.

    Attributes
    ----------
    numbers : Mapping[str, Any]
        Plain data, for ``--json``.
    show : Callable[[Console], None]
        Prints the result for a reader.
    problem : str
        Why something asked for is not in the run folder, empty for nothing; the exit code is then 1.
    code : int
        Exit code that the result itself asks for, of a command whose answer it is.
    """

    numbers: Mapping[str, Any]
    show: Callable[[Console], None]
    problem: str = ""
    code: int = 0


def finished(session: Session, kind: str, report: Report, numbers: Mapping[str, Any], **facts: Any) -> Result:
    """Write the run folder of a command that shows a report, and what it tells in the terminal.

    Parameters
    ----------
    session : Session
        The command at work.
    kind : str
        Of the numbers, which stand in KIND.json.
    report : Report
        Of the run, with the exit code that it asks for.
    numbers : Mapping[str, Any]
        Of the run; the report's verdict is added to them.
    facts : Any
        How it was run, as `twin.framework.page.RunFacts` takes them, beside what the session knows.
    """
    from twin.framework import reference_frames
    from twin.framework.page import RunFacts, write_test

    told = report.told(numbers)
    known = {"started": session.started, "seconds": session.seconds, "backend": session.backend.name}
    known["checks"] = report.checks
    write_test(kind, told, report, RunFacts(**{**known, **facts}), session.folder)
    return Result(
        reference_frames.described(kind, told), lambda console: print_report(report, console), code=report.code
    )


Given = TypeVar("Given")


def run_command(
    stem: str,
    options: cli.Options,
    resolve: Callable[[], Given],
    work: Callable[[Given, Session], Result],
    kept: KeptWork | None = None,
) -> None:
    """Read what is asked for, do it in a run folder and print what it gave.

    Parameters
    ----------
    stem : str
        Of the run folder's name where the user chose none.
    options : cli.Options
        What the user chose.
    resolve : Callable[[], Given]
        Reads the files and checks what is asked for. Raises InputError, InputErrorText.
    work : Callable[[Given, Session], Result]
        Computes and writes all files of the run folder, the manifest last. Raises InputError.
    kept : KeptWork | None
        Where the work is kept meanwhile; it goes when the run folder is complete.

    Raises
    ------
    typer.Exit
        With the exit code of a failure, which has been told.
    """
    errors = Console(stderr=True)
    with cli.explained(errors, cli.nothing_kept if kept is None else kept.left), kept or nullcontext():
        cli.check_backend(options.backend)
        given = resolve()
        # a bad file is told before these are imported
        from optics.numerics.backend import load_backend
        from twin.framework import provenance, run_folder

        folder = run_folder.RunFolder(run_folder.chosen(options.out, stem), options.force)
        started, clock = time.time(), time.monotonic()
        tracer = load_backend(options.backend)
        provenance.program_digest()  # of the files that compute, which may be others when the run ends
        with durable.exit_on_terminate(), folder, progress_shown(errors, options.silent) as advance:
            result = work(given, Session(folder, tracer, advance, started, clock))
        if kept is not None:
            kept.finish()
    with to_stdout(errors, f"the run is complete in {folder.target}"):
        if options.as_json:
            print_json(result.numbers)
        elif not options.quiet:
            console = Terminal()
            result.show(console)
            cli.print_place(console, folder.target)
    if result.problem:
        print_error(errors, f"{result.problem}; all else is in {folder.target}")
        raise typer.Exit(FAILURE)
    if result.code:
        raise typer.Exit(result.code)
    if options.strict:
        cli.end_strictly(errors, result.numbers)


@contextmanager
def progress_shown(errors: Console, silent: bool) -> Iterator[Advance]:
    """Inside the block a terminal shows how far each part of the work is and how long it still takes; elsewhere a line
    now and then says it. Of a part that takes long it is said once in any case.

    Parameters
    ----------
    errors : Console
        Where it is shown.
    silent : bool
        Whether nothing shall be.
    """
    standing, hidden = cli.Standing(), silent or not errors.is_terminal

    def say(text: str) -> None:
        if not silent:
            errors.print(text, markup=False, highlight=False, soft_wrap=True)

    with (
        Progress(*cli.progress_columns(28), console=errors, disable=hidden, transient=True) as bar,
        cli.heartbeat(errors, standing.__str__, silent),
    ):
        yield _advance(bar, standing, say)


def _advance(bar: Progress, standing: cli.Standing, say: Callable[[str], None]) -> Advance:
    """Shows every part of the work as a line, from its beginning on."""
    parts: dict[str, TaskID] = {}
    long: set[str] = set()

    def advance(part: str, done: int, total: int) -> None:
        if part not in parts:
            parts[part] = bar.add_task(part, total=total)
        bar.update(parts[part], completed=done, total=total)
        standing.advance(part, done, total)
        if part not in long and standing.long:
            long.add(part)
            say(f"note: {part}: about {cli.time_text(standing.left)} left")

    return advance


def add_tests(app: typer.Typer, program: str, apart: Collection[str] = ()) -> None:
    """Add to a program all its tests of `PROCEDURES`, ``lab focus`` to ``lab``, with the options that all have.

    A test that exports has an option ``--export``.

    Parameters
    ----------
    app : typer.Typer
        Of the program.
    program : str
        First word of the tests' names.
    apart : Collection[str]
        Commands that have options of their own and are added by the program itself.
    """
    for name in PROCEDURES:
        of, _, command = name.partition(" ")
        if of == program and command not in apart:
            try:
                procedure = PROCEDURES[name]
            except EntryPointError as error:
                _add_unusable(app, command, error)
                continue
            without = ("export",) if procedure.export is None else ()
            test = cli.with_options(*without)(partial(_test, name))
            app.command(command, help=procedure.about)(test)


def _add_unusable(app: typer.Typer, command: str, error: EntryPointError) -> None:
    """Add a test of another distribution that cannot be used: its help says why, and the others work."""

    @app.command(command, help=str(error), context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
    def unusable() -> None:
        with cli.explained(Console(stderr=True)):
            raise error


def _test(name: str, file: cli.File, options: cli.Options) -> None:
    run_test(name, file, options)


def run_test(
    name: str,
    file: Path,
    options: cli.Options,
    kept: KeptWork | None = None,
    read: Callable[[], Any] | None = None,
    words: tuple[str, ...] = (),
    **changes: Any,
) -> None:
    """Read a test, run it, write its run folder and print what it gave.

    Parameters
    ----------
    name : str
        Of the test in `PROCEDURES`: program and subcommand.
    file : Path
        Of the test; the run folder is called like it.
    options : cli.Options
        What the user chose.
    kept : KeptWork | None
        See `run_command`.
    read : Callable[[], Any] | None
        Reads the set-up, by options that this test alone has; None for that of the file. Raises InputError.
    words : tuple[str, ...]
        Further options with which the run is made again from its config.yaml.
    changes : Any
        Attributes of the `Procedure` that are others by options that this test alone has.

    Raises
    ------
    typer.Exit
        With the exit code of a failure, which has been told.
    """
    procedure = replace(PROCEDURES[name], **changes)
    called = f"twin.{name}"
    program, _, command = called.partition(" ")

    def work(setup: Any, session: Session) -> Result:
        from twin.framework.report import numbers_only, with_warnings
        from twin.framework.run_folder import write_manifest

        # a folder that cannot be made is told before the run
        folder = None if options.export is None else _export_folder(setup, options.export, options.force)
        setup, number, facts = seeded(procedure, setup, options.seed)
        run, given = performed(procedure, setup, session.backend, number, session.advance)
        if folder is not None:
            with folder:
                for name, content in procedure.export(run).items():
                    folder.write_bytes(name, content if isinstance(content, bytes) else content.encode())
                said = {"test": procedure.kind, "backend": session.backend.name, "seed": number}
                write_manifest(folder, program, session.started, session.seconds, **said)
        try:
            made, problem = procedure.report(run), ""
        except Exception as error:  # minutes or hours of computing are not thrown away for a figure
            problem = "the report could not be made"
            made = numbers_only(called, f"{procedure.kind}.json", error)
            Console(stderr=True).print(traceback.format_exc(), markup=False, highlight=False, soft_wrap=True)
        shown, numbers = with_warnings(made, given), procedure.numbers(run)
        facts |= {"program": program, "command": command, "options": words}
        return replace(finished(session, procedure.kind, shown, numbers, **facts), problem=problem)

    run_command(file.stem, options, read or partial(read_for, called, file, procedure.resolve), work, kept)


def _export_folder(setup: Any, target: Path, force: bool) -> RunFolder:
    """The folder of ``--export``, checked before anything is computed.

    Raises
    ------
    InputError
        The test names measurements, which are files already.
    RunFolderError
        The folder cannot be made.
    """
    if "measured" in type(setup.test).model_fields:
        text = "measurements are files already; --export writes those of a simulated bench"
        raise setup.test.error(text, ("measured",), allowed="the file of a simulated test")
    from twin.framework.run_folder import RunFolder, RunFolderError

    try:
        return RunFolder(target, force)
    except RunFolderError as error:
        raise RunFolderError(str(error).replace("--out", "--export")) from None


def print_report(report: Report, console: Console) -> None:
    """The verdict, the main table of a report, and what else was found."""
    from twin.framework.artefact import cell_text

    cli.print_verdict(console, report.verdict)
    summary = report.summary
    table = cli.result_table(report.title)
    for k, head in enumerate(summary.heads):
        text = all(isinstance(row[k], str) for row in summary.rows)
        table.add_column(escape(head), justify="left" if text else "right", no_wrap=text)
    for row in summary.shown():
        table.add_row(*(escape(cell_text(cell)) for cell in row))  # [m] is a unit
    cli.print_whole(console, table)
    for line in report.lead:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    print_warnings(console, report.warnings)


def print_warnings(console: Console, warnings: Sequence[str]) -> None:
    """What the user should know before using the numbers."""
    for warning in warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
