"""``python -m twin.orbit``: the camera in orbit (papers 000 and 003)."""

from __future__ import annotations

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

from collections.abc import Mapping
from typing import Any

import typer

from scenes.specs.measured.orbit_data_setup import resolve_any_angle, resolve_any_calibration
from scenes.specs.measured.pass_files_setup import resolve_check, resolve_match
from scenes.specs.orbit_setup import resolve_monitor, resolve_simulate
from twin.orbit.orbit_tests import ORBIT_TESTS
from twin.run.command import add_test

PROGRAM = "twin.orbit"


def simulation_export(run: Any) -> Mapping[str, str]:
    """What was measured in simulated images, as files."""
    from twin.orbit.calibration.calibration_export import simulation_exported

    return simulation_exported(run)


def calibration_export(run: Any) -> Mapping[str, str]:
    """What a calibration measured, as files."""
    from twin.orbit.calibration.calibration_export import exported

    return exported(run)


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
    against those of the laboratory.

    angle.json holds the angles with sigmas, the truth, planes minus resection, and the sensitivity to errors of the
    station and of the points.

    Example: `python -m twin.orbit angle scenes/orbit/angle.yaml`
    """,
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


if __name__ == "__main__":
    app()
