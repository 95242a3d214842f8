"""Command line program ``python -m twin.tolerance``: tolerance budget of a camera with compensators."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from pathlib import Path
from typing import Annotated, Any

import typer

from scenes.specs.file_kinds import read_for
from scenes.specs.procedures import PROCEDURES
from twin.framework import cli
from twin.framework.command import run_test

app = cli.program()


@app.command()
@cli.with_options("export", "strict")
def main(
    file: Annotated[Path, typer.Argument(readable=False, help="YAML file of the budget, or the config.yaml of a run.")],
    options: cli.Options,
    samples: Annotated[
        int | None, typer.Option(min=20, help="Number of cameras to draw; overrides the file's.")
    ] = None,
    workers: cli.Workers = None,
    scheduler: cli.Scheduler = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an interrupted run.")] = False,
) -> None:
    """Find out how accurately a camera has to be made.

    The program computes the effect of each tolerance after all adjustments, the yield, and the limits that reach a
    required yield at the least cost.

    The file names a camera or an instrument and lists tolerances, compensators and requirements:

        instrument: gf7

        tolerances: {M2_despace: {motion: M2 shift z, limit: 20 um}}

        compensators: {focus: {motion: focal_plane shift z, range: 1 mm, step: 2 um}}

        merits: {sharp: {kind: wavefront, at_most: 0.07}}

    Every camera of the Monte Carlo run is traced exactly and adjusted individually. Models of the first and the second
    order are compared with the exact traces; a warning says where they would mislead.

    The run folder gets tolerance.json, report.html, config.yaml, tables as CSV and the worst cameras as jobs in
    artefacts/. During the run, finished work is kept in OUT.samples beside it; with --resume the same command continues
    from there. The results depend neither on the number of workers nor on interruptions.

    Example: `python -m twin.tolerance scenes/examples/tolerance_gf7.yaml`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    from twin.framework.run_folder import KeptWork

    procedure = PROCEDURES["tolerance"]

    def read() -> Any:
        setup = read_for("twin.tolerance", file, procedure.resolve)
        return setup if samples is None else setup.with_test(samples=samples)

    def run(*arguments: Any) -> Any:
        from twin.tolerance.samples import Workforce

        return procedure.run(*arguments, Workforce(workers, scheduler, store.begin()))

    store = KeptWork(options.out, file.stem, "samples", resume)
    run_test("tolerance", file, options, store, read, run=run)


if __name__ == "__main__":
    app()
