"""Command ``python -m twin.validate``: checks formulas and numbers of the source papers against the simulation."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Column
from rich.text import Text

from scenes.yaml.standard_output import FAILURE, Terminal, print_json, to_stdout
from twin.framework import cli
from twin.framework.durable import exit_on_terminate

if TYPE_CHECKING:  # modules that compute are imported on use
    from twin.framework.run_folder import RunFolder
    from twin.validation.registry import Selection
    from twin.validation.runner import Validation

LISTED = (
    "id", "paper", "equation", "statement", "also", "printed", "unit", "comparison", "tolerance", "because", "tells",
    "against", "basis", "expected",
)  # fmt: skip
"""Attributes of a row that ``--list --json`` prints."""

app = cli.program()


@app.command()
def main(
    only: Annotated[
        str | None,
        typer.Option(help="Check ids or their beginnings, separated by commas, e.g. 001.eq1,001.table1. Default: all."),
    ] = None,
    real: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            readable=False,
            help="Folder of measured data of others: runs the rows `real` instead of the papers'. Default of --only "
            "real: TWIN_REAL, or ../shared/real beside the checkout.",
        ),
    ] = None,
    fast: Annotated[
        bool,
        typer.Option(
            "--fast", help="Fewer trials, larger sigmas, the same verdicts: a few minutes in place of thirteen."
        ),
    ] = False,
    list_checks: Annotated[
        bool, typer.Option("--list", help="Print the ids with their statements and approximate times; run nothing.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", readable=False, help="Run folder to make. Default: nothing is written."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=cli.LARGEST_SEED, help="Seed of all noise.")] = 1,
    backend: cli.BackendName = "llvm",
    force: cli.Force = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print validation.json (or the list) on stdout, and nothing else.")
    ] = False,
) -> None:
    """Check the formulas and numbers of the source papers one by one against the simulation.

    Every check has a dotted id that begins with the paper's number, a tolerance that is fixed beforehand, and a
    verdict that follows from the numbers:

    - **confirmed**: the simulation gives the printed value, or the printed statement holds, within the tolerance plus
    three sigma, with inputs that were not chosen for it.

    - **reproduced**: the same, with inputs that the paper does not print and that were chosen here; they are listed
    with their allowed ranges.

    - **consistent**: the paper prints no value; the simulation agrees with the theory that the row names.

    - **confirmed with correction**: the simulation does not give the printed value, but the one that follows when a
    named fault, gap or ambiguity of the paper is corrected.

    - **refuted**: the simulation does not give the printed value, and no correction of the paper would change that.

    - **undecided**: it agrees, but tolerance plus three sigma is larger than the effect that the row is to detect.

    - **not checkable**: the paper does not print what a comparison needs.

    - **failed**: the check could not be computed; this says nothing about the paper.

    A row is two-sided, or it checks a claim of **at most** or **at least** and agrees with any value below or above:
    the column *sides*.

    The run folder gets validation.json, a self-contained validation.html, a summary in summary/, and figures and
    tables in artefacts/.

    - **skipped**: a row on measured data of others that are not in the folder.

    Examples: `python -m twin.validate --list` and `python -m twin.validate --only 004.eq2 --fast`

    Exit codes: 0 every verdict is as expected; 1 a verdict differs, a check failed, or the backend cannot be used; 2
    bad input; 130 interrupted, 143 terminated. After 2, 130 and 143 nothing is written.
    """
    errors = Console(stderr=True)
    with cli.explained(errors):
        cli.check_backend(backend)
        from twin.validation import registry
        from twin.validation.row_names import REAL

        if real is not None and not real.is_dir():
            raise cli.InputErrorText(f"--real {real}: no such folder; docs/real_data.md says what it contains")
        only = REAL if only is None and real is not None else only
        data = real or Path(os.environ.get("TWIN_REAL", Path(__file__).parents[2] / "shared" / "real"))
        try:
            registry.require_known(only)
            selections = registry.select(registry.GROUPS, only)
        except registry.UnknownCheck as error:
            raise cli.InputErrorText(str(error)) from error
        if list_checks:
            with to_stdout(errors):
                _print_list(selections, fast, as_json)
            return
        from twin.framework.run_folder import RunFolder
        from twin.validation.check import FAILED

        folder = None if out is None else RunFolder(out, force)
        with exit_on_terminate():
            validation = _run(selections, backend, seed, only, fast, folder, errors, data)
    with to_stdout(errors, "" if folder is None else f"the report is complete in {folder.target}"):
        if as_json:
            from twin.validation.validation_report import verdict

            print_json({**validation.to_dict(), "verdict": verdict(validation)})
        else:
            _print_result(validation, None if folder is None else folder.target)
    for result, expected in validation.unexpected:
        text = f"{result.id} is {result.verdict}, expected {expected}: {result.how}"
        if result.verdict == FAILED:
            text = f"{result.id} failed: {result.how}"
        errors.print(text, style="red", markup=False, highlight=False, soft_wrap=True)
    if validation.unexpected:
        raise typer.Exit(FAILURE)


def _run(
    selections: Sequence[Selection],
    backend: str,
    seed: int,
    only: str | None,
    fast: bool,
    folder: RunFolder | None,
    errors: Console,
    real: Path,
) -> Validation:
    """Run the selected checks with a progress bar, and write the run folder if there is one."""
    from optics.numerics.backend import load_backend
    from twin.framework.provenance import program_digest
    from twin.validation.runner import rough_seconds, run_checks
    from twin.validation.validation_report import write_validation

    text = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
    tracer = load_backend(backend)
    program_digest()  # computed now, because the program's files may change before the checks end
    total = rough_seconds(selections, fast)
    if total > cli.LONG:
        errors.print(f"note: this takes about {cli.time_text(total)}", highlight=False)
    columns = (SpinnerColumn(), text, BarColumn(bar_width=14), TimeElapsedColumn())
    with Progress(*columns, console=errors, disable=not errors.is_terminal, transient=True) as bar:
        task = bar.add_task("start", total=total)

        started, status = time.monotonic(), "start"

        def show(done: float, text: str) -> None:
            """Update the progress bar."""
            nonlocal status
            remaining = (time.monotonic() - started) * (total - done) / done if done > 0.05 * total else total - done
            status = f"{text}, about {cli.time_text(remaining)} left"
            bar.update(task, completed=done, description=status)

        beat = cli.heartbeat(errors, lambda: status, silent=False)

        if folder is None:
            with beat:
                return run_checks(selections, tracer, seed, only, fast, show, real=real)
        with folder, beat:
            validation = run_checks(selections, tracer, seed, only, fast, show, folder.path, real)
            show(total, "write the run folder")
            write_validation(validation, folder)
        return validation


def _print_list(selections: Sequence[Selection], fast: bool, as_json: bool) -> None:
    """Print ids, statements and approximate times of the selected checks."""
    groups = [
        (selection.group, [c for c in selection.group.checks if c.id in selection.ids]) for selection in selections
    ]
    if as_json:
        rows = [
            {
                **{name: getattr(check, name) for name in LISTED},
                "group": group.prefix,
                "group_seconds": group.rough_seconds(fast),
            }
            for group, checks in groups
            for check in checks
        ]
        print_json({"checks": rows})
        return
    console = Terminal()
    plainly: Any = {"markup": False, "highlight": False, "soft_wrap": True}
    for group, checks in groups:
        seconds = f"together about {group.rough_seconds(fast):g} s"
        console.print(f"{group.prefix}: {group.title} ({seconds})", style="bold", **plainly)
        for check in checks:
            console.print(f"  {check.id}  {check.equation}: {check.statement}", **plainly)


def _print_result(validation: Validation, target: Path | None) -> None:
    """Print a line for every check, and the path of the report."""
    from twin.validation import check
    from twin.validation.validation_report import claim_text, comparison_text, measured_text, sigma_text, verdict

    colours = ("green", "dark_sea_green4", "blue", "yellow", "cyan", "magenta", "dim", "bold red", "dim")
    styles = dict(zip(check.VERDICTS, colours, strict=True))
    table = cli.result_table()
    for head in ("check", "claim", "sides", "measured", "sigma", "unit", "verdict"):
        justify: Any = "right" if head in ("claim", "measured", "sigma") else "left"
        table.add_column(head, justify=justify, no_wrap=True)
    for r in validation.results:
        unit = "" if r.unit == "1" else r.unit
        cells = (r.id, claim_text(r), comparison_text(r), measured_text(r), sigma_text(r), unit)
        table.add_row(*(Text(cell) for cell in cells), Text(r.verdict, style=styles[r.verdict]))
    console = Terminal()
    cli.print_verdict(console, verdict(validation))
    cli.print_whole(console, table)
    if target is None:
        console.print("For details, --out DIR writes a report and --json prints them.", style="dim", soft_wrap=True)
    else:
        console.print(f"report: {target / 'validation.html'}", markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    app()
