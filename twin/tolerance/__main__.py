"""``python -m twin.tolerance``: tolerances of a camera with compensators."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scenes.specs.file_kinds import read_for
from scenes.yaml.named import Named
from twin.framework.cli import AsJson, BackendName, Force, Options, Out, Quiet, Seed
from twin.framework.command import Result, finished, run_command
from twin.framework.procedure import Session

if TYPE_CHECKING:
    from scenes.specs.tolerance import ToleranceSetup

PROGRAM = "twin.tolerance"

app = typer.Typer(add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False)


@app.command()
def main(
    file: Annotated[Path, typer.Argument(readable=False, help="YAML file of the budget, or the config.yaml of a run.")],
    out: Out = None,
    samples: Annotated[
        int | None, typer.Option(min=20, help="Number of cameras to draw; overrides the file's.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=1024, help="Number of worker processes. Default: one for each core.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Use a running Dask cluster, as of `python -m twin.study --scheduler`.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run that was broken off.")] = False,
    seed: Seed = None,
    backend: BackendName = "llvm",
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Find out how well a camera has to be made: what each tolerance does after all adjustments, which share of the
    cameras meets the requirements, and which limits reach a yield at the least cost.

    The file names a camera or an instrument and says in words what varies, what is adjusted, and what is asked:

        instrument: gf7

        tolerances: {M2_despace: {motion: M2 shift z, limit: 20 um}}

        compensators: {focus: {motion: focal_plane shift z, range: 1 mm, step: 2 um}}

        merits: {sharp: {kind: wavefront, at_most: 0.07}}

    Every camera is traced exactly and adjusted by itself; derivatives of the first and the second order stand beside
    it, with a warning where they would mislead.

    The run folder gets tolerance.json, report.html, config.yaml, tables as CSV and the worst cameras as jobs in
    artefacts/. While it runs, what is done is kept in OUT.samples beside it; with --resume the same command goes on
    from there. The numbers depend neither on the number of workers nor on where it was broken off.

    Example: `python -m twin.tolerance scenes/examples/tolerance_gf7.yaml`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    from twin.framework.run_folder import KeptWork

    def resolve() -> ToleranceSetup:
        setup: ToleranceSetup = read_for(PROGRAM, file, Named("scenes.specs.tolerance:ToleranceSetup.read"))
        changed = {name: value for name, value in (("samples", samples), ("seed", seed)) if value is not None}
        return setup.model_copy(update={"test": setup.test.model_copy(update=changed)}) if changed else setup

    def work(setup: ToleranceSetup, session: Session) -> Result:
        from twin.tolerance.samples import Workforce
        from twin.tolerance.tolerance_run import TOLERANCE, run_tolerance

        force = Workforce(workers, scheduler, kept.begin())
        run = run_tolerance(setup, session.backend, setup.test.seed, session.advance, force)
        from twin.tolerance.tolerance_report import tolerance_report

        facts = {"config": setup.to_yaml(), "named": setup.plain(), "seed": setup.test.seed}
        return finished(session, "tolerance", tolerance_report(run), TOLERANCE(run), program=PROGRAM, **facts)

    kept = KeptWork(out, file.stem, "samples", resume)
    run_command(file.stem, Options(out, seed, backend, force, as_json, quiet), resolve, work, kept)


if __name__ == "__main__":
    app()
