"""``python -m twin.lab``: laboratory tests of a camera, rendered and measured (paper 004)."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from optics.backend import Backend, load_backend
from scenes.errors import InputError
from scenes.lab_setup import resolve_distortion, resolve_focus, resolve_turntable
from twin.cli import BACKEND_HELP, LARGEST_SEED, check_backend, exit_on_terminate, explained
from twin.laboratory.bench_error import BenchError
from twin.laboratory.distortion import run_distortion
from twin.laboratory.focus_result import run_focus
from twin.laboratory.output import RunFacts, write_lab
from twin.laboratory.result import Advance, LabResult
from twin.laboratory.turntable_result import run_turntable_test
from twin.report.page import cell_text
from twin.run_folder import RunFolder, next_free

File = Annotated[Path, typer.Argument(readable=False, help="YAML file of the test, or the config.yaml of a run.")]
Out = Annotated[Path | None, typer.Option(readable=False, help="Run folder to make. Default: runs/TEST-001, -002, ...")]
Seed = Annotated[
    int | None, typer.Option(min=0, max=LARGEST_SEED, help="Seed of everything drawn; overrides the file's.")
]
BackendName = Annotated[str, typer.Option("--backend", help=BACKEND_HELP)]
Force = Annotated[bool, typer.Option("--force", help="Replace the run folder if it exists.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout, and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]

app = typer.Typer(
    add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False, no_args_is_help=True
)


@app.callback()
def main() -> None:
    """Test a camera in the laboratory as paper 004 does: every image is rendered through the traced camera, noise
    included, and only images and readings reach the analysis.

    Examples of all three files are in scenes/lab. The run folder gets config.yaml, the numbers as JSON, a
    self-contained report.html, figures and tables in artefacts/ and recorded frames in images/.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """


@app.command()
def focus(
    file: File,
    out: Out = None,
    seed: Seed = None,
    backend: BackendName = "llvm",
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Align a mis-set focal plane: through-focus MTF of a slanted edge in every field and band, a weighted plane,
    shims, and the same again.

    focus.json holds, for every round, the confocal error, the line's level, MTF at Nyquist by band and the shims,
    and under `truth` what the exact trace says.
    """
    options = _Options(out, seed, backend, force, as_json, quiet)
    _command("focus", file, resolve_focus, run_focus, options)


@app.command()
def distortion(
    file: File,
    out: Out = None,
    seed: Seed = None,
    backend: BackendName = "llvm",
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Measure principal distance, principal point and distortion: a pinhole's spots on the line CCD while a turntable
    turns the camera, with raw and with compensated angles.
    """
    options = _Options(out, seed, backend, force, as_json, quiet)
    _command("distortion", file, resolve_distortion, run_distortion, options)


@app.command()
def turntable(
    file: File,
    out: Out = None,
    seed: Seed = None,
    backend: BackendName = "llvm",
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Calibrate a turntable's dividing error by regional comparison and compare five fits of it on held-out angles."""
    _command(
        "turntable", file, resolve_turntable, run_turntable_test, _Options(out, seed, backend, force, as_json, quiet)
    )


@dataclass(frozen=True)
class _Options:
    out: Path | None
    seed: int | None
    backend: str
    force: bool
    as_json: bool
    quiet: bool


def _command(
    kind: str,
    file: Path,
    resolve: Callable[[Path], Any],
    run: Callable[[Any, Backend, int, Advance], LabResult],
    options: _Options,
) -> None:
    errors = Console(stderr=True)
    with explained(errors):
        check_backend(options.backend)
        setup = resolve(file)
        number = setup.test.seed if options.seed is None else options.seed
        folder = RunFolder(
            options.out if options.out is not None else next_free(Path("runs"), file.stem), options.force
        )
        tracer = load_backend(options.backend)
        started, clock = time.time(), time.monotonic()
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description:28}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        hidden = options.as_json or options.quiet or not errors.is_terminal
        with exit_on_terminate(), folder, Progress(*columns, console=errors, disable=hidden, transient=True) as bar:
            parts: dict[str, TaskID] = {}

            def advance(part: str, done: int, total: int) -> None:
                if part not in parts:
                    parts[part] = bar.add_task(part, total=total)
                bar.update(parts[part], completed=done, total=total)

            try:
                result = run(setup, tracer, number, advance)
            except BenchError as error:
                raise _explained_at(setup.test, error) from error
            facts = RunFacts(
                setup.with_seed(number).to_yaml(), str(file), tracer.name, number, started, time.monotonic() - clock
            )
            write_lab(result, facts, folder)
    if options.as_json:
        json.dump(dict(result.data), sys.stdout, allow_nan=False)
        sys.stdout.write("\n")
    elif not options.quiet:
        _print_result(result, folder.target)


def _explained_at(test: Any, error: BenchError) -> InputError:
    """What went wrong in the test, at the line of its file that can change it."""
    result = test.error(str(error), error.key, allowed=error.remedy)
    assert isinstance(result, InputError)
    return result


def _print_result(result: LabResult, target: Path) -> None:
    summary = result.summary
    table = Table(title=result.title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for k, head in enumerate(summary.heads):
        text = all(isinstance(row[k], str) for row in summary.rows)
        table.add_column(head, justify="left" if text else "right", no_wrap=text)
    for row in summary.shown():
        table.add_row(*(cell_text(cell) for cell in row))
    console = Console()
    # a number that is cut is worse than a line that wraps
    console.width = max(console.width, console.measure(table, options=console.options.update(width=1000)).maximum)
    console.print(table)
    for line in result.lead:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    for warning in result.warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
    console.print(f"run folder: {target}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"report:     {target / 'report.html'}", markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    app()
