"""Command line of ``python -m twin.orbit``: tests of a camera in orbit (papers 000, 003), export of camera models."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from scenes.specs.file_kinds import read_for
from scenes.specs.procedures import PROCEDURES, SENSORS
from scenes.yaml.errors import Problem
from scenes.yaml.units import ANGLE, DISTANCE, parse_quantity
from twin.framework import cli
from twin.framework.cli import InputErrorText
from twin.framework.command import Result, add_tests, finished, print_warnings, run_command, run_test
from twin.framework.procedure import Advance, Session

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.setup import AnyAdjust
    from twin.orbit.export.export_run import ControlPoints, ExportSource, SceneSource
    from twin.orbit.export.ground_accuracy import CameraUncertainty
    from twin.orbit.export.quality_run import PolynomialSource

    Exportable = ExportSource | SceneSource | PolynomialSource

PROGRAM = "twin.orbit"


class Correction(StrEnum):
    """Choices of the option `--correction`: image correction that is fitted to the control points."""

    shift = "shift"
    affine = "affine"


app = cli.program(no_args_is_help=True)


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
@cli.with_options()
def adjust(
    file: cli.File,
    options: cli.Options,
    without: Annotated[
        list[str] | None,
        typer.Option("--without", metavar="SENSOR", help=f"A sensor that is not used: {', '.join(SENSORS)}."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, max=1024, help="Number of worker processes that reduce the points. Default: this process alone."
        ),
    ] = None,
    scheduler: cli.Scheduler = None,
) -> None:
    """Run the command `adjust`: block adjustment of scenes from many passes."""
    procedure = PROCEDURES["orbit adjust"]

    def reduced() -> AnyAdjust:
        from scenes.specs.orbit.setup import without_sensors

        return without_sensors(read_for(f"{PROGRAM} adjust", file, procedure.resolve), without or ())

    def run(setup: AnyAdjust, backend: Backend, seed: int, advance: Advance) -> Any:
        from twin.orbit.block.block_run import point_workers

        with point_workers(workers, scheduler, lambda text: print_warnings(errors, (text,))) as pool:
            return procedure.run(setup, backend, seed, advance, pool)

    errors = Console(stderr=True)
    run_test("orbit adjust", file, options, read=reduced, run=run)


@app.command("export")
@cli.with_options("export", "strict")
def export(
    source: Annotated[
        Path,
        typer.Argument(
            readable=False,
            help="Run folder or YAML file of a simulation or of a test of intersection angles, "
            "the DIMAP file of a scene, DIM_NAME.XML, or a file of rational polynomials.",
        ),
    ],
    options: cli.Options,
    lowest: Annotated[
        str | None,
        typer.Option(
            "--lowest",
            help="Lowest ground above the ellipsoid, '-50 m'. Default: that of the run's elevation model, or 0 m.",
        ),
    ] = None,
    highest: Annotated[
        str | None,
        typer.Option("--highest", help="Highest ground above the ellipsoid, '2500 m'. Default: likewise, or 2000 m."),
    ] = None,
    truth: Annotated[
        bool,
        typer.Option("--truth", help="Export the true camera and orbit, not those that a user of the images knows."),
    ] = False,
    band: Annotated[
        str | None,
        typer.Option("--band", help="Band to export, for a scene whose bands have different lines of sight."),
    ] = None,
    control: Annotated[
        Path | None,
        typer.Option(
            "--control",
            readable=False,
            help="File of control points with their image positions, .gcp; they correct the polynomials.",
        ),
    ] = None,
    correction: Annotated[
        Correction, typer.Option("--correction", help="Correction in the image that control points determine.")
    ] = Correction.affine,
    position_sigma: Annotated[
        str | None,
        typer.Option(
            "--position-sigma",
            help="Sigma of the orbit along each axis, '1 m'. Any sigma option writes a map of the accuracy.",
        ),
    ] = None,
    attitude_sigma: Annotated[
        str | None, typer.Option("--attitude-sigma", help="Sigma of the attitude about each axis, '2 arcsec'.")
    ] = None,
    interior_sigma: Annotated[
        float | None,
        typer.Option(
            "--interior-sigma", min=0.0, max=1e4, help="Sigma of each line's position in the focal plane, pixels."
        ),
    ] = None,
    image_sigma: Annotated[
        float | None,
        typer.Option("--image-sigma", min=0.0, max=1e3, help="Sigma of a position measured in an image, pixels."),
    ] = None,
    height_sigma: Annotated[
        str | None, typer.Option("--height-sigma", help="Sigma of the heights of points seen in a single line, '3 m'.")
    ] = None,
) -> None:
    """Export line cameras for other photogrammetric software.

    Formats: image support data (ISD) of the community sensor model, for Ames Stereo Pipeline and ISIS, and rational
    polynomials (RPC00B).

        python -m twin.orbit simulate scenes/orbit/simulate.yaml --out runs/patch

        python -m twin.orbit export runs/patch

    The files models/LINE.json and LINE_RPC.TXT describe each line. From a run folder, LINE.tif is also written: the
    line's image with the polynomials inside. From a YAML file, the models are those of whole images. export.json
    gives the largest difference of each model from the rigorous sensor, which neither format can represent in full.

        python -m twin.orbit export DIM_SCENE.XML --control points.gcp --attitude-sigma '2 arcsec'

    From a scene of Pléiades or SPOT 6 and 7, the rigorous model of its DIMAP file is exported. Control points
    correct the polynomials and give ERR_BIAS by their covariance; they also correct a NAME_RPC.TXT, an RPC_NAME.XML
    or a GeoTIFF alone. Sigmas of camera and orbit make a map of CE90 and LE90.

    Exit codes: 0 success, 2 bad input (nothing is written), 1 anything else.
    """
    sigmas = {
        "position": position_sigma,
        "attitude": attitude_sigma,
        "interior": interior_sigma,
        "image": image_sigma,
        "height": height_sigma,
    }
    extra = [word for name, sigma in sigmas.items() if sigma is not None for word in (f"--{name}-sigma", str(sigma))]
    extra += [] if band is None else ["--band", band]
    extra += [] if control is None else ["--control", str(control), "--correction", correction.value]

    def resolve() -> tuple[Exportable, tuple[float, float] | None, CameraUncertainty | None, ControlPoints | None]:
        from twin.orbit.export.export_run import read_control, read_exportable
        from twin.orbit.export.ground_accuracy import CameraUncertainty
        from twin.orbit.export.quality_run import read_polynomial_source

        values = {name: _sigma(name, sigma) for name, sigma in sigmas.items() if sigma is not None}
        uncertainty = CameraUncertainty.of(**values) if values else None
        points = None if control is None else read_control(control, correction.value)
        read = read_polynomial_source(source, band) or read_exportable(source, options.seed, band)
        return read, _ground(lowest, highest), uncertainty, points

    def work(parsed: tuple[Any, ...], session: Session) -> Result:
        from scenes.yaml.errors import InputError, Issue
        from twin.framework.procedure import BenchError
        from twin.orbit.export import export_report, quality_run
        from twin.orbit.export.export_run import SceneSource, run_export
        from twin.orbit.export.quality_run import PolynomialSource, run_polynomial_export, with_quality

        read, heights, uncertainty, points = parsed
        contents: dict[str, bytes]
        if isinstance(read, PolynomialSource):
            alone = run_polynomial_export(read, uncertainty, points)
            contents, drawn = quality_run.polynomial_files(alone), 0
            shown, numbers = quality_run.polynomial_report(alone), quality_run.POLYNOMIALS(alone)
        else:
            try:
                run = run_export(read, session.backend, heights, truth, session.advance)
                run = with_quality(run, uncertainty, points)
            except BenchError as error:
                if isinstance(read, SceneSource):
                    raise InputError(Issue(str(error), read.scene.read.file, allowed=error.remedy)) from error
                raise InputError(*read.setup.test.error(str(error), error.key, allowed=error.remedy).issues) from error
            contents, drawn = export_report.export_files(run), read.seed
            shown, numbers = export_report.export_report(run), export_report.EXPORT(run)
        for name, content in contents.items():
            session.folder.write_bytes(name, content)
        ends = () if heights is None else ("--lowest", f"{heights[0]!r} m", "--highest", f"{heights[1]!r} m")
        name = session.backend.name
        words = (*ends, *(["--truth"] if truth else []), *extra, "--seed", str(drawn))
        again = (PROGRAM, "export", str(source), *words, *(() if name == "llvm" else ("--backend", name)))
        inputs = (source,) if control is None else (source, control)
        facts = {"config": read.config, "seed": drawn, "again": again, "input_paths": inputs}
        return finished(session, "export", shown, numbers, program=PROGRAM, **facts)

    stem = source.resolve().name if os.path.isdir(source) else source.stem
    run_command(f"{stem}-export", options, resolve, work)


def _sigma(name: str, text: str | float) -> float:
    """Return the standard deviation that an option gives, in SI units or, if given in pixels, in pixels.

    Raises
    ------
    InputErrorText
        The text is not a standard deviation with a unit, or the value is too large.
    """
    if not isinstance(text, str):
        return float(text)
    (kind, largest, example), option = _SIGMAS[name], f"--{name}-sigma"
    try:
        value = parse_quantity(text, kind)
    except Problem as problem:
        raise InputErrorText(f"{option}: {problem}; for example '{example}'") from None
    if not 0.0 <= value <= largest:
        raise InputErrorText(f"{option} must lie between 0 and {largest:g} in SI units; for example '{example}'")
    return value


_SIGMAS = {"position": (DISTANCE, 1e5, "1 m"), "attitude": (ANGLE, 0.1, "2 arcsec"), "height": (DISTANCE, 1e4, "3 m")}
"""Kind of quantity, largest accepted value in SI units, and an example for error messages, by name of the option."""


def _ground(lowest: str | None, highest: str | None) -> tuple[float, float] | None:
    """Return the lowest and highest ground above the ellipsoid, in metres; None where neither option is given.

    Raises
    ------
    InputErrorText
        A height cannot be read, only one of the two is given, or they are not in order and on land.
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
"""Lowest and highest ground height that the options accept, in metres above the ellipsoid: the range of land."""


if __name__ == "__main__":
    app()
