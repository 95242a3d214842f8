"""``python -m twin.orbit``: the camera in orbit (papers 000 and 003)."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from scenes.specs.orbit.sensors import SENSORS
from scenes.specs.procedures import PROCEDURES
from scenes.yaml.errors import Problem
from scenes.yaml.units import DISTANCE, parse_quantity
from twin.run.cli import AsJson, BackendName, File, Force, InputErrorText, Options, Out, Quiet, Seed
from twin.run.command import Result, add_tests, finished, run_command, run_test
from twin.run.procedure import Session

if TYPE_CHECKING:
    from scenes.specs.measured.adjust_setup import AnyAdjust
    from twin.orbit.export.export_run import ExportSource

PROGRAM = "twin.orbit"


app = typer.Typer(
    add_completion=False, rich_markup_mode="markdown", pretty_exceptions_enable=False, no_args_is_help=True
)


@app.callback()
def main() -> None:
    """Calibrate a line camera in orbit from points on the ground.

    Examples are in scenes/orbit. The run folder gets config.yaml, the numbers as JSON, a self-contained report.html,
    figures and tables in artefacts/.

    Example: `python -m twin.orbit angle scenes/orbit/angle.yaml`

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """


add_tests(app, "orbit", apart=("adjust",))


@app.command("adjust", help=PROCEDURES["orbit adjust"].about)
def adjust(
    file: File,
    without: Annotated[
        list[str] | None,
        typer.Option("--without", metavar="SENSOR", help=f"A sensor that is not used: {', '.join(SENSORS)}."),
    ] = None,
    out: Out = None,
    seed: Seed = None,
    backend: BackendName = "llvm",
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Adjust a block of scenes; its help is that of the test."""
    procedure = PROCEDURES["orbit adjust"]

    def resolve(path: Path) -> AnyAdjust:
        from scenes.specs.measured.adjust_setup import resolve_any_adjust, without_sensors

        return without_sensors(resolve_any_adjust(path), without or ())

    options = Options(out, seed, backend, force, as_json, quiet)
    run_test(PROGRAM, "adjust", replace(procedure, resolve=resolve), file, options)


@app.command("export")
def export(
    source: Annotated[
        Path,
        typer.Argument(
            readable=False,
            help="Run folder of a simulation, or the YAML file of a simulation or of a test of intersection angles.",
        ),
    ],
    lowest: Annotated[
        str | None,
        typer.Option(
            "--lowest",
            help="Lowest ground above the ellipsoid, '-50 m'. Default: of the run's elevation model, or 0 m.",
        ),
    ] = None,
    highest: Annotated[
        str | None, typer.Option("--highest", help="Highest ground, '2500 m'. Default likewise, or 2000 m.")
    ] = None,
    truth: Annotated[
        bool, typer.Option("--truth", help="Camera and orbit as they are, not as the user of the images knows them.")
    ] = False,
    out: Out = None,
    seed: Seed = None,
    backend: BackendName = "llvm",
    force: Force = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Line cameras for other photogrammetric software: image support data (ISD) of the community sensor model for Ames
    Stereo Pipeline and ISIS, and rational polynomials (RPC00B).

        python -m twin.orbit simulate scenes/orbit/simulate.yaml --out runs/patch

        python -m twin.orbit export runs/patch

    models/LINE.json and LINE_RPC.TXT describe each line; of a run folder LINE.tif is its image with the polynomials
    inside. Of a YAML file the models are those of whole images. export.json says how far each model is from the
    rigorous sensor, which neither can carry in full.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """

    def resolve() -> tuple[ExportSource, tuple[float, float] | None]:
        from twin.orbit.export.export_run import read_source

        return read_source(source, seed), _ground(lowest, highest)

    def work(given: tuple[ExportSource, tuple[float, float] | None], session: Session) -> Result:
        from scenes.yaml.errors import InputError
        from twin.orbit.export import export_report
        from twin.orbit.export.export_run import run_export
        from twin.run.procedure import BenchError

        read, heights = given
        try:
            run = run_export(read, session.backend, heights, truth, session.advance)
        except BenchError as error:
            raise InputError(*read.setup.test.error(str(error), error.key, allowed=error.remedy).issues) from error
        for name, content in export_report.export_files(run).items():
            session.folder.write_bytes(name, content)
        ends = () if heights is None else ("--lowest", f"{heights[0]!r} m", "--highest", f"{heights[1]!r} m")
        name = session.backend.name
        options = (*ends, *(("--truth",) if truth else ()), "--seed", str(read.seed))
        again = (PROGRAM, "export", str(source), *options, *(() if name == "llvm" else ("--backend", name)))
        facts = {"config": read.config, "seed": read.seed, "again": again, "given": (source,)}
        shown, numbers = export_report.export_report(run), export_report.EXPORT(run)
        return finished(session, "export", shown, numbers, program=PROGRAM, **facts)

    stem = source.resolve().name if source.is_dir() else source.stem
    run_command(f"{stem}-export", Options(out, seed, backend, force, as_json, quiet), resolve, work)


def _ground(lowest: str | None, highest: str | None) -> tuple[float, float] | None:
    """Heights that were asked for, metres; None where none were.

    Raises:
        InputErrorText: they are no heights, or only one of them is given.
    """
    if lowest is None and highest is None:
        return None
    if lowest is None or highest is None:
        raise InputErrorText("give both --lowest and --highest, or neither")
    try:
        low, high = (parse_quantity(text, DISTANCE) for text in (lowest, highest))
    except Problem as problem:
        raise InputErrorText(f"--lowest, --highest: {problem}; for example '0 m' and '2000 m'") from None
    if not _DEEPEST <= low < high <= _TOP:
        raise InputErrorText(f"--lowest must be below --highest, both within {_DEEPEST:g} and {_TOP:g} m")
    return low, high


_DEEPEST, _TOP = -500.0, 9000.0
"""Metres: of land."""


if __name__ == "__main__":
    app()
