"""``python -m twin.orbit``: the camera in orbit (papers 000 and 003)."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from scenes.specs.measured.orbit_data_setup import (
    resolve_any_angle,
    resolve_any_calibration,
    resolve_check,
    resolve_match,
)
from scenes.specs.orbit.setup import resolve_monitor, resolve_simulate
from scenes.yaml.errors import Problem
from scenes.yaml.units import DISTANCE, parse_quantity
from twin.orbit.orbit_tests import ORBIT_TESTS
from twin.run.cli import AsJson, BackendName, Force, InputErrorText, Options, Out, Quiet, Seed
from twin.run.command import Result, Session, add_test, print_report, run_command
from twin.run.reference_frames import described

if TYPE_CHECKING:
    from twin.orbit.export.export_run import ExportSource

PROGRAM = "twin.orbit"


def simulation_export(run: Any) -> Mapping[str, str]:
    """What was measured in simulated images, as files."""
    from twin.orbit.calibration.calibration_export import simulation_exported

    return simulation_exported(run)


def calibration_export(run: Any) -> Mapping[str, str]:
    """What a calibration measured, as files."""
    from twin.orbit.calibration.calibration_export import exported

    return exported(run)


def angle_export(run: Any) -> Mapping[str, str]:
    """What a measurement of angles was made from, as files."""
    from twin.orbit.angle.angle_export import angle_exported

    return angle_exported(run)


def match_export(run: Any) -> Mapping[str, str]:
    """Points that were matched, with the pass, as files."""
    from twin.orbit.matching.match_numbers import exported

    return exported(run)


def check_export(run: Any) -> Mapping[str, str]:
    """A pass whose conventions stand, in the project's own."""
    from twin.orbit.conventions.check_export import exported

    return exported(run)


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


add_test(
    app,
    PROGRAM,
    "angle",
    resolve_any_angle,
    ORBIT_TESTS["angle"],
    """Intersection angles of a three-line camera by planes through the station and ground points (paper 000), with
    space resection as the second method.

    A file with `data: DIR` runs on the measurements of that folder, as `calibrate` does: the angles of every pass,
    against those of the laboratory. `--export DIR` writes such a folder of what a simulation measured, with a test file
    angle.yaml.

    angle.json holds the angles with sigmas, the truth, planes minus resection, and the sensitivity to errors of the
    station and of the points.

    Example: `python -m twin.orbit angle scenes/orbit/angle.yaml`
    """,
    angle_export,
)

add_test(
    app,
    PROGRAM,
    "calibrate",
    resolve_any_calibration,
    ORBIT_TESTS["calibrate"],
    """Interior orientation and attitude biases of a three-line camera over test fields, and schemes of averaged
    parameters tested on all fields without ground control (paper 003); simulated, or on measured passes.

    A file with `data: DIR` runs on the measurements of that folder: orbit, attitude, line times, ground and image
    points. `--export DIR` writes such a folder of what the run measured, with a test file calibrate.yaml.

    calibration.json holds the parameters with sigmas and truth, correlations, null vectors and gauge, and the errors in
    plan and height of every field before calibration and by each scheme.

    Example: `python -m twin.orbit calibrate scenes/orbit/calibrate.yaml`
    """,
    calibration_export,
)

add_test(
    app,
    PROGRAM,
    "check",
    resolve_check,
    ORBIT_TESTS["check"],
    """Conventions of a pass in files: every reading of what is mistaken for one another (order and sense of the
    quaternion, frames, time scales, an offset of the line times, origins and axes of pixels and lines), alone and two
    at once, is tried on the ground points and ranked.

    check.json holds the readings with residuals and likelihoods, what the points tell of each convention and what they
    cannot, and where the first points would fall under each reading. Exit codes: 0 the stated reading stands, 3 another
    one does, 4 none explains the points. With `--export DIR` a pass whose conventions stand goes into a folder that
    `twin.orbit calibrate` reads.

    Example: `python -m twin.orbit check scenes/orbit/measured/check.yaml`
    """,
    check_export,
)

add_test(
    app,
    PROGRAM,
    "match",
    resolve_match,
    ORBIT_TESTS["match"],
    """Points measured in a user's line images: distinct places of an orthophoto with heights of an elevation model, and
    tie points, are sought in every image by least squares matching, as in a simulated patch.

    match.json holds for every line how many points were matched and what by. With `--export DIR` the points go with
    orbit, attitude and line times into a folder that `twin.orbit calibrate` reads.

    Example: `python -m twin.orbit match scenes/orbit/measured/match.yaml`
    """,
    match_export,
)

add_test(
    app,
    PROGRAM,
    "monitor",
    resolve_monitor,
    ORBIT_TESTS["monitor"],
    """Height errors of a stereo pair along its orbit with and without on-board monitoring of its cameras (paper 001's
    monitor, heights as in papers 000 and 003).

    monitor.json holds the true and the monitored changes, errors in plan and height as calibrated, monitored at every
    time and at an interval, the interval's table, metres per arcsecond, and where the rest comes from.

    Example: `python -m twin.orbit monitor scenes/orbit/monitor.yaml`
    """,
)

add_test(
    app,
    PROGRAM,
    "simulate",
    resolve_simulate,
    ORBIT_TESTS["simulate"],
    """Images of a patch of ground by every line of a camera, physically rendered, with an orthophoto, an elevation
    model and the measured orbit and attitude: all that an in-orbit calibration from images needs.

    simulate.json holds for every line where its window lies, grey values, ground sample distance and MTF. What only the
    truth knows is in artefacts/truth.json. `--export DIR` writes points, orbit and attitude as tables that `calibrate`
    reads.

    Example: `python -m twin.orbit simulate scenes/orbit/simulate.yaml`
    """,
    simulation_export,
)


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
        from twin.orbit.export.export_report import export_files, export_numbers, export_report
        from twin.orbit.export.export_run import run_export
        from twin.run.page import RunFacts, write_test
        from twin.run.procedure import BenchError

        read, heights = given
        try:
            run = run_export(read, session.backend, heights, truth, session.advance)
        except BenchError as error:
            raise InputError(*read.setup.test.error(str(error), error.key, allowed=error.remedy).issues) from error
        shown = export_report(run)
        numbers = {**export_numbers(run), "verdict": shown.verdict}
        for name, content in export_files(run).items():
            session.folder.write_bytes(name, content)
        ends = () if heights is None else ("--lowest", f"{heights[0]!r} m", "--highest", f"{heights[1]!r} m")
        name = session.backend.name
        options = (*ends, *(("--truth",) if truth else ()), "--seed", str(read.seed))
        again = (PROGRAM, "export", str(source), *options, *(() if name == "llvm" else ("--backend", name)))
        times = session.started, session.seconds
        facts = RunFacts(*(read.config, str(source), name, read.seed, *times, PROGRAM, "", again), given=(source,))
        write_test("export", numbers, shown, facts, session.folder)
        return Result(described("export", numbers), lambda console: print_report(shown, console))

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
