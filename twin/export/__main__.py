"""Command ``python -m twin.export``: frames and tables of a run folder in the formats of other programs."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scenes.yaml.yaml_file import dump_yaml
from twin.framework import cli
from twin.framework.command import Result, finished, run_command
from twin.framework.procedure import Session

if TYPE_CHECKING:
    from twin.framework.run_folder import Manifest

PROGRAM = "twin.export"

app = cli.program()


@app.command()
@cli.with_options("seed", "export", "backend", "strict")
def main(
    run: Annotated[Path, typer.Argument(readable=False, help="Run folder of any command.")],
    options: cli.Options,
    frames: Annotated[str, typer.Option(help="Recorded frames and expected images: fits or none.")] = "fits",
    tables: Annotated[str, typer.Option(help="Tables: csv, parquet, fits or none.")] = "csv",
) -> None:
    """Write frames and results of a run folder as files for other programs: FITS, CSV and Parquet.

    Frames become FITS cubes, images/NAME.fits, whose headers name every quantity with its unit (pixel pitch, exposure,
    gain, noise, saturation) and hold no world coordinates; expected images become expected_photons.fits. `python -m
    twin.recover` reads these frames and recovers the same numbers as from the run's own.

    Tables are written into tables/: spots, readings by camera and estimator, true changes, matched points, every table
    of the run, and numbers, with every number of its JSON files. Every column has a unit and a description: in the head
    of a CSV, in the metadata of Parquet's fields, as TUNITn and TCOMMn in FITS.

    For example:

        python -m twin.export runs/perturb-001 --tables parquet --out perturb-files

    The folder also gets files.json, which lists files and columns, and a report.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """

    def read() -> Manifest:
        from twin.export.export_run import FRAMES, NONE, read_source
        from twin.framework.data_files import TABLE_FORMATS

        for option, value, allowed in (("--frames", frames, FRAMES), ("--tables", tables, (*TABLE_FORMATS, NONE))):
            cli.require_one_of(option, value, allowed)
        if frames == tables == NONE:
            raise cli.InputErrorText("--frames none with --tables none exports nothing")
        return read_source(run)

    def work(manifest: Manifest, session: Session) -> Result:
        from twin.export.export_run import KIND, export, export_report

        done = export(run, manifest, frames, tables, session.folder, session.advance)
        again = (PROGRAM, str(run), "--frames", frames, "--tables", tables)
        config = dump_yaml({"run": str(run), "frames": frames, "tables": tables})
        facts = {"config": config, "again": again, "input_paths": (run,)}
        return finished(session, KIND, export_report(done), done.numbers(), backend="", program=PROGRAM, **facts)

    run_command(f"{run.resolve().name}-files", options, read, work)


if __name__ == "__main__":
    app()
