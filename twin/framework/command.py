"""Shared course of the commands that make a run folder: options, progress, run folder, result in the terminal."""

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
from twin.framework.durable import first_names
from twin.framework.procedure import Advance, Session, performed, seeded

if TYPE_CHECKING:
    from twin.framework.report import Report
    from twin.framework.run_folder import KeptWork, RunFolder


@dataclass(frozen=True, eq=False)
class Result:
    """Output of a command in the terminal when its run folder is complete.

    Attributes
    ----------
    numbers : mapping
        Plain data, for ``--json``.
    show : callable
        Prints the result for a reader.
    problem : str
        Reason why a requested file is missing from the run folder, empty if none is; the exit code is then 1.
    code : int
        Exit code that the result itself asks for.
    """

    numbers: Mapping[str, Any]
    show: Callable[[Console], None]
    problem: str = ""
    code: int = 0


def finished(session: Session, kind: str, report: Report, numbers: Mapping[str, Any], **facts: Any) -> Result:
    """Write the run folder of a command that makes a report, and return its output for the terminal.

    Parameters
    ----------
    session : Session
        Session of the command.
    kind : str
        Kind of the run; its numbers go into KIND.json.
    report : Report
        Report of the run, with the exit code that it asks for.
    numbers : mapping
        Numbers of the run; the verdict and warnings of the report are added to them.
    facts : Any
        Fields of `twin.framework.page.RunFacts` beside those known from the session.
    """
    from twin.framework import record
    from twin.framework.page import RunFacts, write_test

    complete = report.with_verdict(numbers)
    known = {"started": session.started, "seconds": session.seconds, "backend": session.backend.name}
    known["checks"] = report.checks
    write_test(kind, complete, report, RunFacts(**{**known, **facts}), session.folder)
    return Result(record.described(kind, complete), lambda console: print_report(report, console), code=report.code)


Setup = TypeVar("Setup")


def run_command(
    stem: str,
    options: cli.Options,
    resolve: Callable[[], Setup],
    work: Callable[[Setup, Session], Result],
    storage: KeptWork | None = None,
) -> None:
    """Read the input, compute in a run folder and print the result.

    Parameters
    ----------
    stem : str
        Name of the run folder if the user chose none.
    options : cli.Options
        Options that the user chose.
    resolve : callable
        Reads the files and checks the request. Raises InputError, InputErrorText.
    work : callable
        Computes and writes all files of the run folder, the manifest last. Raises InputError.
    storage : KeptWork | None
        Folder of intermediate results for ``--resume``; it is removed when the run folder is complete.

    Raises
    ------
    typer.Exit
        The command failed; the error has been printed.
    """
    errors = Console(stderr=True)
    with cli.explained(errors, cli.no_results_kept if storage is None else storage.left), storage or nullcontext():
        cli.check_backend(options.backend)
        request = resolve()
        # imported here, so that an error in the file is reported without delay
        from optics.numerics.backend import load_backend
        from twin.framework import provenance, run_folder

        folder = run_folder.RunFolder(run_folder.chosen(options.out, stem), options.force)
        started, clock = time.time(), time.monotonic()
        tracer = load_backend(options.backend)
        provenance.program_digest()  # now, since the source files may change before the run ends
        with durable.exit_on_terminate(), folder, progress_shown(errors, options.silent) as advance:
            result = work(request, Session(folder, tracer, advance, started, clock))
        if storage is not None:
            storage.finish()
    with to_stdout(errors, f"the run is complete in {folder.target}"):
        if options.as_json:
            print_json(result.numbers)
        elif not options.quiet:
            console = Terminal()
            result.show(console)
            cli.print_paths(console, folder.target)
    if result.problem:
        print_error(errors, f"{result.problem}; everything else is in {folder.target}")
        raise typer.Exit(FAILURE)
    if result.code:
        raise typer.Exit(result.code)
    if options.strict:
        cli.end_strictly(errors, result.numbers)


@contextmanager
def progress_shown(errors: Console, silent: bool) -> Iterator[Advance]:
    """Show the progress of each part of the work inside the block.

    A terminal shows progress bars; elsewhere a line is printed at intervals. The expected duration of a long part is
    printed once in any case.

    Parameters
    ----------
    errors : Console
        Console for the progress.
    silent : bool
        True to show nothing.
    """
    state, disabled = cli.WorkProgress(), silent or not errors.is_terminal

    def print_line(text: str) -> None:
        if not silent:
            errors.print(text, markup=False, highlight=False, soft_wrap=True)

    with (
        Progress(*cli.progress_columns(28), console=errors, disable=disabled, transient=True) as bar,
        cli.heartbeat(errors, state.__str__, silent),
    ):
        yield _advance(bar, state, print_line)


def _advance(bar: Progress, state: cli.WorkProgress, print_line: Callable[[str], None]) -> Advance:
    """Return a progress function (``Advance``) that shows every part of the work as a bar in the terminal."""
    parts: dict[str, TaskID] = {}
    long: set[str] = set()

    def advance(part: str, done: int, total: int) -> None:
        if part not in parts:
            parts[part] = bar.add_task(part, total=total)
        bar.update(parts[part], completed=done, total=total)
        state.advance(part, done, total)
        if part not in long and state.long:
            long.add(part)
            print_line(f"note: {part}: about {cli.time_text(state.left)} left")

    return advance


def add_tests(app: typer.Typer, program: str, apart: Collection[str] = ()) -> None:
    """Add all tests of a program in `PROCEDURES` to it, ``lab focus`` to ``lab``, with the shared options.

    A test that can export has the option ``--export``.

    Parameters
    ----------
    app : typer.Typer
        Application of the program.
    program : str
        First word of the tests' names.
    apart : collection of str
        Commands with options of their own, which the program adds itself.
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
    """Add a placeholder for a test of another package that cannot be loaded, with the reason as its help text."""

    @app.command(command, help=str(error), context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
    def unusable() -> None:
        with cli.explained(Console(stderr=True)):
            raise error


def _test(name: str, file: cli.File, options: cli.Options) -> None:
    """Run a test (an entry of `PROCEDURES`) with the options that all tests share."""
    run_test(name, file, options)


def run_test(
    name: str,
    file: Path,
    options: cli.Options,
    storage: KeptWork | None = None,
    read: Callable[[], Any] | None = None,
    words: tuple[str, ...] = (),
    **changes: Any,
) -> None:
    """Read a test, run it, write its run folder and print the result.

    Parameters
    ----------
    name : str
        Name of the test in `PROCEDURES`: program and subcommand.
    file : Path
        File of the test; the run folder is named after it.
    options : cli.Options
        Options that the user chose.
    storage : KeptWork | None
        Folder of intermediate results, see `run_command`.
    read : callable | None
        Reads the set-up, if the test has options that change it; None to read it from the file. Raises InputError.
    words : tuple of str
        Further command-line options that are needed to repeat the run from its config.yaml.
    changes : Any
        Attributes of the `Procedure` that options of this test replace.

    Raises
    ------
    typer.Exit
        The command failed; the error has been printed.
    """
    procedure = replace(PROCEDURES[name], **changes)
    called = f"twin.{name}"
    program, _, command = called.partition(" ")

    def work(setup: Any, session: Session) -> Result:
        from twin.framework.report import numbers_only, with_warnings
        from twin.framework.run_folder import write_manifest

        # a folder that cannot be made is reported before the run
        exported = ""
        folder = None if options.export is None else _export_folder(setup, options.export, options.force)
        setup, number, facts = seeded(procedure, setup, options.seed)
        run, input_warnings = performed(procedure, setup, session.backend, number, session.advance)
        if folder is not None:
            with folder:
                contents = procedure.export(run)
                exported = f"exported:   {options.export}: {first_names(list(contents))}"
                for name, content in contents.items():
                    folder.write_bytes(name, content if isinstance(content, bytes) else content.encode())
                facts_of_export = {"test": procedure.kind, "backend": session.backend.name, "seed": number}
                write_manifest(folder, program, session.started, session.seconds, **facts_of_export)
        try:
            made, problem = procedure.report(run), ""
        except Exception as error:  # hours of computing must not be lost because of a figure
            problem = "the report could not be made"
            made = numbers_only(called, f"{procedure.kind}.json", error)
            Console(stderr=True).print(traceback.format_exc(), markup=False, highlight=False, soft_wrap=True)
        shown, numbers = with_warnings(made, input_warnings), procedure.numbers(run)
        facts |= {"program": program, "command": command, "options": words}
        result = replace(finished(session, procedure.kind, shown, numbers, **facts), problem=problem)

        def show(console: Console) -> None:
            result.show(console)
            console.print(exported, markup=False, highlight=False, soft_wrap=True)

        return replace(result, show=show) if exported else result

    run_command(file.stem, options, read or partial(read_for, called, file, procedure.resolve), work, storage)


def _export_folder(setup: Any, target: Path, force: bool) -> RunFolder:
    """Return the folder of ``--export``, checked before anything is computed.

    Raises
    ------
    InputError
        The test reads measurements, which are files already.
    RunFolderError
        The folder cannot be made.
    """
    if "measured" in type(setup.test).model_fields:
        text = "--export writes the measurements of a simulated bench; this test reads measurements from files"
        raise setup.test.error(text, ("measured",), allowed="the file of a simulated test")
    from twin.framework.run_folder import RunFolder, RunFolderError

    try:
        return RunFolder(target, force)
    except RunFolderError as error:
        raise RunFolderError(str(error).replace("--out", "--export")) from None


def print_report(report: Report, console: Console) -> None:
    """Print the verdict, the main table, the lead and the warnings of a report."""
    from twin.framework.artefact import RESIDUALS, Marked, cell_text

    cli.print_verdict(console, report.verdict, report.unmet, bool(report.warnings))
    summary = report.summary
    table = cli.result_table(report.title)
    for k, head in enumerate(summary.heads):
        text = all(isinstance(row[k], str) for row in summary.rows)
        table.add_column(escape(head), justify="left" if text else "right", no_wrap=text)
    for k, row in enumerate(summary.shown()):
        if k in summary.bands:
            table.add_row(f"[bold]{escape(summary.bands[k])}[/]")
        below = (f" {cell.below}" if isinstance(cell, Marked) and cell.look in RESIDUALS else "" for cell in row)
        # escaped, since [m] is a unit and no markup
        table.add_row(*(escape(cell_text(cell) + more) for cell, more in zip(row, below, strict=True)))
    cli.print_whole(console, table)
    for line in report.lead:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    print_warnings(console, report.warnings)


def print_warnings(console: Console, warnings: Sequence[str]) -> None:
    """Print the warnings about a result in the terminal, one line each."""
    for warning in warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
