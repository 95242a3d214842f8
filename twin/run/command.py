"""What the commands that run one test have in common: options, progress, the run folder, the result in the terminal."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from optics.numerics.backend import load_backend
from scenes.yaml.errors import InputError
from scenes.yaml.standard_output import Terminal, print_json, to_stdout
from twin.run.cli import (
    BACKEND_HELP,
    LARGEST_SEED,
    check_backend,
    exit_on_terminate,
    explained,
    print_place,
    print_whole,
    progress_columns,
)
from twin.run.page import RunFacts, cell_text, write_test
from twin.run.procedure import BenchError, Procedure, Run
from twin.run.reference_frames import described
from twin.run.report import Report
from twin.run.run_folder import RunFolder, chosen

File = Annotated[Path, typer.Argument(readable=False, help="YAML file of the test, or the config.yaml of a run.")]
Out = Annotated[Path | None, typer.Option(readable=False, help="Run folder to make. Default: runs/TEST-001, -002, ...")]
Seed = Annotated[
    int | None, typer.Option(min=0, max=LARGEST_SEED, help="Seed of everything drawn; overrides the file's.")
]
BackendName = Annotated[str, typer.Option("--backend", help=BACKEND_HELP)]
Force = Annotated[bool, typer.Option("--force", help="Replace the run folder if it exists.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout, and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]


@dataclass(frozen=True)
class Options:
    """What the user chose.

    Attributes:
        out: run folder, None for the next free one.
        seed: None for the file's.
        backend: where to trace.
        force: replace the run folder.
        as_json: print the numbers as JSON.
        quiet: print nothing.
    """

    out: Path | None
    seed: int | None
    backend: str
    force: bool
    as_json: bool
    quiet: bool


def add_test(
    app: typer.Typer,
    program: str,
    command: str,
    procedure: Procedure[Any, Run],
    report: Callable[[Run], Report],
    about: str,
) -> None:
    """Add a test to a program as a subcommand with the options that all tests have.

    Args:
        app: of the program.
        program: as the user calls it, ``twin.lab``.
        command: the subcommand, ``focus``.
        procedure: the test.
        report: of its run.
        about: what ``--help`` says of it, in Markdown; its first paragraph stands in the list of subcommands.
    """

    @app.command(command, help=about)
    def test(
        file: File,
        out: Out = None,
        seed: Seed = None,
        backend: BackendName = "llvm",
        force: Force = False,
        as_json: AsJson = False,
        quiet: Quiet = False,
    ) -> None:
        run_test(program, command, file, procedure, report, Options(out, seed, backend, force, as_json, quiet))


def run_test(
    program: str,
    command: str,
    file: Path,
    procedure: Procedure[Any, Run],
    report: Callable[[Run], Report],
    options: Options,
) -> None:
    """Read a test, run it, write its run folder and print what it gave.

    Args:
        program: as the user calls it, ``twin.lab``.
        command: its subcommand, ``focus``.
        file: of the test.
        procedure: the test; ``test`` of its set-up has a ``seed``.
        report: of its run.
        options: what the user chose.

    Raises:
        typer.Exit: with the exit code of a failure, which has been told.
    """
    errors = Console(stderr=True)
    with explained(errors):
        check_backend(options.backend)
        setup = procedure.resolve(file)
        number = setup.test.seed if options.seed is None else options.seed
        folder = RunFolder(chosen(options.out, file.stem), options.force)
        tracer = load_backend(options.backend)
        started, clock = time.time(), time.monotonic()
        hidden = options.as_json or options.quiet or not errors.is_terminal
        with (
            exit_on_terminate(),
            folder,
            Progress(*progress_columns(28), console=errors, disable=hidden, transient=True) as bar,
        ):
            parts: dict[str, TaskID] = {}

            def advance(part: str, done: int, total: int) -> None:
                if part not in parts:
                    parts[part] = bar.add_task(part, total=total)
                bar.update(parts[part], completed=done, total=total)

            try:
                run = procedure.run(setup, tracer, number, advance)
            except BenchError as error:
                raise _explained_at(setup.test, error) from error
            numbers, shown = procedure.numbers(run), report(run)
            config = setup.with_seed(number).to_yaml()
            seconds = time.monotonic() - clock
            facts = RunFacts(config, str(file), tracer.name, number, started, seconds, program, command)
            write_test(procedure.kind, numbers, shown, facts, folder)
    with to_stdout(errors, f"the run is complete in {folder.target}"):
        if options.as_json:
            print_json(described(procedure.kind, numbers))
        elif not options.quiet:
            _print_report(shown, folder.target)


def _explained_at(test: Any, error: BenchError) -> InputError:
    """What went wrong in the test, at the line of its file that can change it."""
    result = test.error(str(error), error.key, allowed=error.remedy)
    assert isinstance(result, InputError)
    return result


def _print_report(report: Report, target: Path) -> None:
    summary = report.summary
    table = Table(title=report.title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for k, head in enumerate(summary.heads):
        text = all(isinstance(row[k], str) for row in summary.rows)
        table.add_column(head, justify="left" if text else "right", no_wrap=text)
    for row in summary.shown():
        table.add_row(*(cell_text(cell) for cell in row))
    console = Terminal()
    print_whole(console, table)
    for line in report.lead:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    for warning in report.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
    print_place(console, target)
