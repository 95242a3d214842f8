"""Tables of a pass's measurements: reading with explicit conventions, writing without loss of digits.

Rows may be in any order, columns in any order and unit. Conventions that cannot be inferred from the numbers, such as
the order of a quaternion's components, are specified in the test's file; inconsistencies in the numbers, such as a
velocity that is not the rate of change of the positions, are reported as errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from analysis.orbit.calibration_parameters import level_covariance
from optics.numerics.array_math import in_span
from scenes.specs.orbit import measurements
from scenes.specs.orbit.setup import DATA_FILE
from scenes.specs.orbit.three_line_camera import ThreeLineCameraSpec
from scenes.yaml.csv_table import Column, Table, read_table
from scenes.yaml.errors import InputError, Issue, names_text, nearest, shown
from scenes.yaml.spec import TitledSpec
from scenes.yaml.units import LENGTH, SPEED, TIME
from scenes.yaml.yaml_file import dump_yaml
from twin.framework.procedure import Advance, silent
from twin.orbit.flight.line_camera import LineTimes
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.measured.maps import MOST_HEIGHT
from twin.orbit.measured.orbit_files import EARTH_FIXED_VELOCITY, INERTIAL_VELOCITY, SPEED_TOLERANCE, velocity_misfit
from twin.orbit.measured.pass_measurements import GroundPoints, ImagePoints, PassMeasurements

_FAR, _FAST, _LATE, _MANY = 1e9, 1e5, 1e10, 1e9
"""Largest accepted absolute values of coordinates (metres), velocities (m/s), times (seconds) and line numbers; sums of
their squares do not overflow.
"""
_TIME = Column("time", TIME, least=-_LATE, most=_LATE)
_POSITION = tuple(Column(axis, LENGTH, least=-_FAR, most=_FAR) for axis in "xyz")
_SPEED = tuple(Column(f"v{axis}", SPEED, needed=False, least=-_FAST, most=_FAST) for axis in "xyz")
_QUATERNION = tuple(Column(f"q{k}", least=-1.001, most=1.001) for k in range(1, 5))
_LARGE = 1e6
"""Largest accepted sigma of a ground coordinate, in metres."""
_CORRELATIONS = ("correlation_xy", "correlation_xz", "correlation_yz")
COLUMNS: Mapping[str, tuple[Column, ...]] = {
    "platform": (_TIME, *_POSITION, *_SPEED, *_QUATERNION),
    "orbit": (_TIME, *_POSITION, *_SPEED),
    "attitude": (_TIME, *_QUATERNION),
    "lines": (Column("camera", text=True), Column("line", least=-_MANY, most=_MANY), _TIME),
    "ground": (
        Column("point", text=True),
        Column("role", text=True),
        *_POSITION,
        Column("sigma", LENGTH, needed=False, least=0.0, most=_LARGE),
        *(Column(f"{axis}_sigma", LENGTH, needed=False, least=0.0, most=_LARGE) for axis in ("plan", "height", *"xyz")),
        *(Column(name, needed=False, least=-1.0, most=1.0) for name in _CORRELATIONS),
    ),
    "image_points": (
        Column("point", text=True),
        Column("camera", text=True),
        Column("line", least=-_MANY, most=_MANY),
        Column("pixel", least=-_MANY, most=_MANY),
        Column("line_sigma", least=1e-6, most=1e3),
        Column("pixel_sigma", least=1e-6, most=1e3),
        Column("correlation", needed=False, least=-0.999999, most=0.999999),
    ),
}
"""Columns that each table of a pass must have, by the table's key; `tie_points` has those of `image_points`."""
_SIGMAS = (("sigma",), ("plan_sigma", "height_sigma"), ("x_sigma", "y_sigma", "z_sigma"))
"""Alternative sets of columns for the sigmas of ground coordinates."""
_EARTH_AXES = np.array([6_378_137.0, 6_378_137.0, 6_356_752.314])
"""Semi-axes of the WGS84 ellipsoid, in metres."""
CALIBRATING: Mapping[str, int] = {"control": 1, "check": 2}
"""Number of line cameras that must see at least one of the ground points for a calibration, by role of the points."""


def read_pass(
    name: str,
    spec: measurements.PassFilesSpec,
    conventions: measurements.ConventionsSpec,
    camera: ThreeLineCameraSpec,
    needed: Mapping[str, int] = CALIBRATING,
) -> PassMeasurements:
    """Read the tables of a pass.

    Parameters
    ----------
    name : str
        Name of the pass.
    spec : PassFilesSpec
        Epoch and files, with paths relative to the working directory.
    conventions : ConventionsSpec
        Conventions of all tables.
    camera : ThreeLineCameraSpec
        Payload whose lines the tables name.
    needed : mapping of str to int
        Role of points (such as control) -> smallest number of line cameras that must see at least one of them.

    Raises
    ------
    InputError
        A table cannot be read, does not have the columns of `COLUMNS`, or holds impossible values; with file, line and
        column.
    """
    files = spec.files
    platform = _platform(spec, conventions)
    # Without a need for control, tie points are enough.
    least = 0 if "tie_points" in files and not needed else 1
    lines = read_table(files["lines"], COLUMNS["lines"])
    known, pixels = (read_table(files[key], COLUMNS[key], least) for key in ("ground", "image_points"))
    times, origins = _line_times_of(lines, conventions, camera, platform)
    ground = ground_of(known)
    number = {name: k for k, name in enumerate(ground.ids.tolist())}
    tables = [(pixels, number)]
    if "tie_points" in files:
        ties = read_table(files["tie_points"], COLUMNS["image_points"])
        for row in np.flatnonzero([name in number for name in ties["point"]])[:1]:
            allowed = "a point without coordinates, or another name"
            raise ties.error(int(row), "point", f"this point has coordinates in {known.file}", allowed=allowed)
        names = list(dict.fromkeys(ties["point"].tolist()))
        tables.append((ties, {name: len(ground) + k for k, name in enumerate(names)}))
        ground = ground.with_ties(names)
    trajectory = TabulatedTrajectory(platform)
    parts: dict[str, list[ImagePoints]] = {line: [] for line in times}
    for table, numbers in tables:
        for line, row in _image_points_of(table, numbers, times, origins, conventions, camera, trajectory).items():
            parts[line].append(row)
    images = {line: ImagePoints.joined(rows) for line, rows in parts.items() if any(len(r.point) for r in rows)}
    rays = np.zeros(len(ground), int)
    for row in images.values():
        np.add.at(rays, row.point, 1)
    for role, least in needed.items():
        if not np.any((ground.role == role) & (rays >= least)):
            seen = "one line camera" if least == 1 else "two line cameras"
            allowed = f"{role} points in the ground table whose image points are measured"
            raise InputError(Issue(f"no {role} point is seen by {seen}", pixels.file, allowed=allowed))
    if len(images) < 2:
        value = f"of {names_text(tuple(images)) or 'none'}"
        allowed = "image points of two line cameras or more"
        raise InputError(Issue("too few line cameras", pixels.file, value=value, allowed=allowed))
    return PassMeasurements(name, platform, {line: times[line] for line in images}, ground, images)


def _platform(spec: measurements.PassFilesSpec, conventions: measurements.ConventionsSpec) -> PlatformTable:
    """Return orbit and attitude of a pass, from tables or from files of other formats."""
    if isinstance(spec.platform, measurements.PlatformFilesSpec):
        # Import only here, because tables do not need these libraries.
        from twin.orbit.measured.platform_files import platform_table, read_platform

        return platform_table(*read_platform(spec.platform, Path()), spec.epoch)
    keys = ("platform",) if "platform" in spec.files else ("orbit", "attitude")
    tables = [read_table(spec.files[key], COLUMNS[key], 2) for key in keys]
    return platform_of(spec.epoch, tables[0], tables[-1], conventions)


def read_measurements(
    data: measurements.OrbitDataSpec,
    camera: ThreeLineCameraSpec,
    advance: Advance = silent,
    needed: Mapping[str, int] = CALIBRATING,
) -> tuple[PassMeasurements, ...]:
    """Read all passes of a test.

    Parameters
    ----------
    data : OrbitDataSpec
        Conventions and files.
    camera : ThreeLineCameraSpec
        Payload whose lines the tables name.
    advance : Advance
        Callback that reports progress.
    needed : mapping of str to int
        Role of points (such as control) -> smallest number of line cameras that must see at least one of them.

    Raises
    ------
    InputError
        A table cannot be read or holds impossible values; with file, line and column.
    """
    passes = []
    for name, files in data.passes.items():
        passes.append(read_pass(name, files, data.conventions, camera, needed))
        advance("read", len(passes), len(data.passes))
    return tuple(passes)


def _line_times_of(
    table: Table, conventions: measurements.ConventionsSpec, camera: ThreeLineCameraSpec, platform: PlatformTable
) -> tuple[dict[str, LineTimes], dict[str, float]]:
    """Return each line camera's line times, with lines counted from its first, and the file's number of that line.

    Parameters
    ----------
    table : Table
        Times of the lines of all cameras.
    conventions : ConventionsSpec
        Conventions, which specify to which moment of an exposure its time refers.
    camera : ThreeLineCameraSpec
        Payload with the lines.
    platform : PlatformTable
        Readings of orbit and attitude, which must cover the lines.

    Raises
    ------
    InputError
        A camera is unknown, a line occurs twice, times do not increase, or lines lie outside the readings.
    """
    require_known(table, "camera", tuple(camera.lines))
    path = TabulatedTrajectory(platform)
    times_of, origins = {}, {}
    for name in dict.fromkeys(table["camera"].tolist()):
        rows = np.flatnonzero(table["camera"] == name)
        rows = rows[np.argsort(table["line"][rows], kind="stable")]
        line, time = table["line"][rows], table["time"][rows]
        if len(rows) < 2:
            raise table.error(int(rows[0]), "line", f"one line of {name} gives no line time", allowed="two or more")
        for row in rows[1:][np.diff(line) == 0.0][:1]:
            raise table.error(int(row), "line", f"this line of {name} occurs twice", f"{table['line'][row]:g}")
        for row in rows[1:][np.diff(time) <= 0.0][:1]:
            allowed = "a later time than that of the line before; number the lines as they were exposed"
            raise table.error(int(row), "time", "times do not increase with the lines", allowed=allowed)
        step = np.gradient(time, line)
        time = time + {"start": 0.5, "middle": 0.0, "end": -0.5}[conventions.line_moment] * step
        at = LineTimes.of(line - line[0], time)
        ends = at.at(np.array([-0.5, at.line[-1] + 0.5]))
        for end, row in zip(ends, (rows[0], rows[-1]), strict=True):
            if not in_span(end, path.first, path.last):
                allowed = f"within orbit and attitude, {path.first:.9g} s to {path.last:.9g} s; leave out other lines"
                raise table.error(int(row), "time", "a line outside the readings", f"{end:.9g} s", allowed)
        times_of[name], origins[name] = at, float(line[0])
    return times_of, origins


def ground_of(table: Table) -> GroundPoints:
    """Return the ground points of a table with coordinates.

    Parameters
    ----------
    table : Table
        Table of control and check points.

    Raises
    ------
    InputError
        A name occurs twice, a role is unknown, a point is far from the Earth's surface, or sigmas are missing, given in
        two ways, or not a covariance.
    """
    _once(table, "point")
    require_known(table, "role", ("control", "check"))
    position = table.stacked("x", "y", "z")
    radius = np.linalg.norm(position, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        height = radius - radius / np.linalg.norm(position / _EARTH_AXES, axis=1)
    for row in np.flatnonzero(~(np.abs(height) < MOST_HEIGHT))[:1]:
        value = f"{height[row] / 1e3:.6g} km above the ellipsoid"
        allowed = "Earth-centred, Earth-fixed coordinates of the ground, not geodetic ones; and is the unit right?"
        raise table.error(int(row), "x", "not a position on the ground", value, allowed)
    return GroundPoints.of(table["point"], position, _covariance(table, position), table["role"])


def _covariance(table: Table, position: Array) -> Array:
    """Return the covariances of n points in axes of the ITRS, (n, 3, 3), in m^2."""
    sets = [names for names in _SIGMAS if any(name in table for name in names)]
    allowed = "or ".join(", ".join(f"{name} [m]" for name in names) + " " for names in _SIGMAS).strip()
    if len(sets) != 1:
        problem = "sigmas are given in two ways" if sets else "no sigmas of the coordinates"
        raise InputError(Issue(problem, table.file, int(table.lines[0]) - 1, allowed=allowed))
    missing = [name for name in sets[0] if name not in table]
    if missing:
        raise InputError(Issue(f"no column {missing[0]!r}", table.file, int(table.lines[0]) - 1, allowed=allowed))
    correlated = [name for name in _CORRELATIONS if name in table]
    if correlated and sets[0] != _SIGMAS[2]:
        text = "correlations go with x_sigma, y_sigma and z_sigma"
        raise InputError(Issue(text, table.file, int(table.lines[0]) - 1, (table.heads[correlated[0]],)))
    for name in sets[0]:
        zero = (table[name] == 0.0) & (table["role"] == "control") & np.any(table[name] > 0.0)
        for row in np.flatnonzero(zero)[:1]:
            raise table.error(int(row), name, "some sigmas are zero", "0", "all positive, or all zero for exact")
    if sets[0] == ("sigma",):
        return np.asarray(table["sigma"][:, None, None] ** 2 * np.eye(3))
    if sets[0] == _SIGMAS[1]:
        return level_covariance(position, *(table[name] for name in sets[0]))
    sigma = table.stacked(*sets[0])
    like = np.broadcast_to(np.eye(3), (len(table), 3, 3)).copy()
    for name, (i, j) in zip(_CORRELATIONS, ((0, 1), (0, 2), (1, 2)), strict=True):
        if name in table:
            like[:, i, j] = like[:, j, i] = table[name]
    for row in np.flatnonzero(np.linalg.eigvalsh(like)[:, 0] < -1e-9)[:1]:
        allowed = "correlations that a covariance can have"
        raise table.error(int(row), correlated[0], "these correlations contradict each other", allowed=allowed)
    return np.asarray(sigma[:, :, None] * like * sigma[:, None, :])


def _image_points_of(
    table: Table,
    names: Mapping[str, int],
    times: Mapping[str, LineTimes],
    origins: Mapping[str, float],
    conventions: measurements.ConventionsSpec,
    camera: ThreeLineCameraSpec,
    trajectory: TabulatedTrajectory,
) -> dict[str, ImagePoints]:
    """Return the image points of each line camera, with the numbers of their ground points.

    Parameters
    ----------
    table : Table
        Image points of all cameras.
    names : mapping of str to int
        Number of each ground point.
    times : mapping of str to LineTimes
        Line times of each line camera.
    origins : mapping of str to float
        Number of each line camera's first line in the file.
    conventions : ConventionsSpec
        Conventions of pixel coordinates.
    camera : ThreeLineCameraSpec
        Payload with the lines.
    trajectory : TabulatedTrajectory
        Orbit and attitude, which must cover the exposures of the points.

    Raises
    ------
    InputError
        A point or camera is unknown, a point occurs twice in a camera, lies outside the image, or was exposed when
        orbit or attitude are not known.
    """
    require_known(table, "camera", tuple(times))
    number = np.array([names.get(name, -1) for name in table["point"].tolist()])
    for row in np.flatnonzero(number < 0)[:1]:
        name, problem = str(table["point"][row]), "this point has no coordinates"
        allowed = "a point of the ground table; points without coordinates belong into `tie_points`"
        raise table.error(int(row), "point", problem, shown(name), allowed, nearest(name, names))
    points = {}
    half = 0.5 if conventions.centre == "half" else 0.0
    for name in times:
        rows = np.flatnonzero(table["camera"] == name)
        order = rows[np.argsort(number[rows], kind="stable")]
        for row in order[1:][np.diff(number[order]) == 0][:1]:
            point = str(table["point"][row])
            raise table.error(int(row), "point", f"this point occurs twice in {name}", shown(point))
        pixels, last = camera.pixels_of(name), times[name].line[-1]
        line = table["line"][order] - half - origins[name]
        pixel = table["pixel"][order] - half - conventions.first_pixel
        for what, value, most, first in (
            ("line", line, last, origins[name]),
            ("pixel", pixel, pixels - 1, conventions.first_pixel),
        ):
            for row in order[~in_span(value, -0.5, most + 0.5)][:1]:
                low, high = (v + half + first for v in (-0.5, most + 0.5))
                where = f"{low:.10g} to {high:.10g}, the {what}s of {name}"
                raise table.error(int(row), what, "outside the image", f"{table[what][row]:.10g}", where)
        for row in order[~trajectory.covers(times[name].at(line))][:1]:
            problem = "exposed in a gap of the readings of orbit or attitude"
            raise table.error(int(row), "line", problem, allowed="points where readings are at most 5 intervals apart")
        spread = image_covariance(table, order)
        if conventions.first_pixel_sees == "left":
            # A mirrored axis changes the sign of the correlation.
            pixel, spread = pixels - 1.0 - pixel, spread * np.array([[1.0, -1.0], [-1.0, 1.0]])
        points[name] = ImagePoints.of(number[order], line, pixel, spread)
    return points


def image_covariance(table: Table, rows: NDArray[np.intp]) -> Array:
    """Return the covariances of line and pixel of n rows of a table of image points, (n, 2, 2), in pixels squared."""
    a, b = table["line_sigma"][rows], table["pixel_sigma"][rows]
    c = a * b * (table["correlation"][rows] if "correlation" in table else 0.0)
    return np.stack([np.stack([a * a, c], -1), np.stack([c, b * b], -1)], axis=1)


def require_known(table: Table, column: str, names: tuple[str, ...]) -> None:
    """Raise InputError unless every cell of a table's column is one of the given names."""
    for row in np.flatnonzero(~np.isin(table[column].astype(str), names))[:1]:
        cell = str(table[column][row])
        raise table.error(int(row), column, f"no such {column}", shown(cell), names_text(names), nearest(cell, names))


def _once(table: Table, column: str) -> None:
    """Raise InputError if a name occurs twice in a column of a table."""
    seen: dict[str, int] = {}
    for row, name in enumerate(table[column].tolist()):
        if name in seen:
            problem = f"occurs twice, first on line {int(table.lines[seen[name]])}"
            raise table.error(row, column, problem, shown(name), "each once")
        seen[name] = row


CONVENTIONS: Mapping[str, Any] = {
    "frame": "itrs",
    "quaternion": {"scalar": "last", "direction": "body_to_frame"},
    "body_axes": ["forward", "right", "down"],
    "time_scale": "utc",
    "line_moment": "middle",
    "centre": "integer",
    "first_pixel": 0,
    "first_pixel_sees": "right",
}
"""Conventions (frames, quaternion order, pixel origin) of the files that are written, those of the project."""
CAMERA_FILE = "camera.yaml"
TEST_FILE = "calibrate.yaml"
LINES_SEE_POINTS = (
    "an attitude whose lines see the points: `scalar` first or last, `direction`, `body_axes`, frame and times of the"
    " attitude file (`twin.orbit check` finds which agree with the ground points); names, images and coordinates that"
    " belong together"
)
"""Remedy for measured passes whose lines see no ground, or ground far from their points; the likeliest cause first."""


def campaign_files(passes: Sequence[PassMeasurements], camera: Mapping[str, Any]) -> dict[str, str]:
    """Return the files of a folder of measurements, path -> text: ``data.yaml``, tables of each pass, camera.

    Parameters
    ----------
    passes : sequence of PassMeasurements
        Passes with different names.
    camera : mapping
        Content of the payload's file, plain data.
    """
    files, listed = {CAMERA_FILE: dump_yaml(camera)}, {}
    for measured in passes:
        tables = _pass_tables(measured)
        files |= {f"{measured.name}/{key}.csv": text for key, text in tables.items()}
        listed[measured.name] = {
            "epoch": measured.platform.epoch,
            **{key: f"{measured.name}/{key}.csv" for key in tables},
        }
    files[DATA_FILE] = dump_yaml({"conventions": dict(CONVENTIONS), "passes": listed})
    return files


def tested_files(
    passes: Sequence[PassMeasurements], camera: Mapping[str, Any], spec: TitledSpec, file: str, **keys: Any
) -> dict[str, str]:
    """Return the files of a folder of measurements with a test file that reads them back, path -> text.

    Parameters
    ----------
    passes : sequence of PassMeasurements
        Passes with different names.
    camera : mapping
        Content of the payload's file, plain data.
    spec : TitledSpec
        Test from which the measurements come; the test file gets its name and description.
    file : str
        Name of the test file.
    keys : Any
        Further keys of the test file, plain data.
    """
    test = {"name": spec.name, "description": spec.description, "camera": f"./{CAMERA_FILE}", "data": ".", **keys}
    return campaign_files(passes, camera) | {file: dump_yaml(test)}


def _pass_tables(measured: PassMeasurements) -> dict[str, str]:
    """Return the text of each table of a pass, by the table's key, with all digits of its numbers."""
    platform = measured.platform
    orbit = {"time [s]": platform.orbit_time, **_columns(("x [m]", "y [m]", "z [m]"), platform.position)}
    if platform.velocity is not None:
        orbit |= _columns(("vx [m/s]", "vy [m/s]", "vz [m/s]"), platform.velocity)
    attitude = {"time [s]": platform.attitude_time, **_columns(("q1", "q2", "q3", "q4"), platform.quaternion)}
    times = measured.line_times
    lines = {
        "camera": np.repeat(list(times), [len(of.line) for of in times.values()]),
        "line": np.concatenate([of.line for of in times.values()]),
        "time [s]": np.concatenate([of.time for of in times.values()]),
    }
    known = measured.ground.role != "tie"
    tables = {
        "orbit": csv_text(orbit),
        "attitude": csv_text(attitude),
        "lines": csv_text(lines),
        "ground": csv_text(_ground(measured.ground.taken(known))),
        "image_points": csv_text(_images(measured.images, measured.ground, known)),
    }
    if np.any(~known):
        tables["tie_points"] = csv_text(_images(measured.images, measured.ground, ~known))
    return tables


def _ground(points: GroundPoints) -> dict[str, Any]:
    """Return the columns of the table of ground points."""
    sigma = np.sqrt(np.diagonal(points.covariance, axis1=1, axis2=2))
    columns: dict[str, Any] = {
        "point": points.ids,
        "role": points.role,
        **_columns(("x [m]", "y [m]", "z [m]"), points.itrs),
    }
    alike = np.array_equal(points.covariance, sigma[:, 0, None, None] ** 2 * np.eye(3))
    if alike:
        return columns | {"sigma [m]": sigma[:, 0]}
    columns |= _columns(("x_sigma [m]", "y_sigma [m]", "z_sigma [m]"), sigma)
    scale = np.where(sigma > 0.0, sigma, 1.0)
    like = points.covariance / scale[:, :, None] / scale[:, None, :]
    pairs = {"correlation_xy": (0, 1), "correlation_xz": (0, 2), "correlation_yz": (1, 2)}
    return columns | {name: like[:, i, j] for name, (i, j) in pairs.items()}


def _images(images: Mapping[str, ImagePoints], ground: GroundPoints, chosen: np.ndarray) -> dict[str, Any]:
    """Return the columns of a table of image points, of the ground points that the mask `chosen` selects."""
    parts = {name: row.taken(chosen[row.point]) for name, row in images.items()}
    rows = ImagePoints.joined(list(parts.values()))
    sigma = np.sqrt(np.diagonal(rows.covariance, axis1=1, axis2=2))
    columns: dict[str, Any] = {
        "point": ground.ids[rows.point],
        "camera": np.repeat(list(parts), [len(row.point) for row in parts.values()]),
        "line": rows.line,
        "pixel": rows.pixel,
        **_columns(("line_sigma", "pixel_sigma"), sigma),
    }
    correlation = rows.covariance[:, 0, 1] / sigma[:, 0] / sigma[:, 1]
    return columns | ({"correlation": correlation} if np.any(correlation) else {})


def _columns(names: Sequence[str], values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of an array as a mapping, name -> column."""
    return dict(zip(names, values.T, strict=True))


def csv_text(columns: Mapping[str, Any]) -> str:
    """Return a table as CSV text, each number with the fewest digits that reproduce it exactly."""
    cells = [[str(v) for v in np.asarray(c, dtype=object).tolist()] for c in columns.values()]
    rows = [", ".join(columns), *map(",".join, zip(*cells, strict=True))]
    return "\n".join(rows) + "\n"


_LEAST_RADIUS, _MOST_RADIUS = 6.45e6, 5.0e7
"""Range of geocentric distances of mapping satellites, in metres."""
_UNIT_TOLERANCE = 1e-3
"""Largest accepted deviation of a quaternion's norm from 1."""
_FALL, _JUMP = 12.0, 0.05
"""Largest accepted acceleration of a satellite, in m/s^2, and largest change of velocity that the noise of readings may
cause, as a share of the speed.
"""
_LEAST_ROTATION, _FASTEST_ROTATION = np.radians(2.0), np.radians(10.0)
"""Limit of the rotation between two readings: a constant, in radians, plus a rate, in radians per second, which is
higher than that of agile satellites.
"""


def platform_of(epoch: str, orbit: Table, attitude: Table, conventions: measurements.ConventionsSpec) -> PlatformTable:
    """Return orbit and attitude from their tables.

    Parameters
    ----------
    epoch : str
        Instant from which times count, UTC, ISO 8601.
    orbit : Table
        Table of the orbit.
    attitude : Table
        Table of the attitude, which may be the same.
    conventions : ConventionsSpec
        Conventions of both tables.

    Raises
    ------
    InputError
        A time occurs twice, a position is impossible for a satellite, a velocity is not the rate of change of the
        positions, or a quaternion is not of unit length.
    """
    order, looks = _rising(orbit), _rising(attitude)
    time, position = orbit["time"][order], orbit.stacked("x", "y", "z")[order]
    radius = np.linalg.norm(position, axis=1)
    for k in np.flatnonzero((radius < _LEAST_RADIUS) | (radius > _MOST_RADIUS))[:1]:
        value = f"{radius[k] / 1e3:.6g} km from the Earth's centre"
        allowed = f"{_LEAST_RADIUS / 1e3:g} to {_MOST_RADIUS / 1e3:g} km; is the unit in the head right?"
        raise orbit.error(int(order[k]), "x", "not a satellite position", value, allowed)
    _check_jumps(orbit, order, time, position)
    speed = None
    columns = [name for name in ("vx", "vy", "vz") if name in orbit]
    if columns:
        missing = [name for name in ("vx", "vy", "vz") if name not in orbit]
        if missing:
            raise InputError(
                Issue(f"no column {missing[0]!r}", orbit.file, value=names_text(columns), allowed="all three or none")
            )
        speed = orbit.stacked("vx", "vy", "vz")[order]
        _check_velocity(orbit, order, time, position, speed)
    numbers = attitude.stacked("q1", "q2", "q3", "q4")[looks]
    norm = np.linalg.norm(numbers, axis=1)
    for k in np.flatnonzero(np.abs(norm - 1.0) > _UNIT_TOLERANCE)[:1]:
        raise attitude.error(
            int(looks[k]), "q1", "not a unit quaternion", f"a norm of {norm[k]:.6g}", "four numbers of norm 1"
        )
    quaternion = _quaternions_of(numbers, conventions)
    _check_rotations(attitude, looks, quaternion)
    return PlatformTable.of(epoch, time, position, speed, attitude["time"][looks], quaternion)


def _quaternions_of(numbers: Array, conventions: measurements.ConventionsSpec) -> Array:
    """Return quaternions x, y, z, w that rotate the project's body axes into those of the frame.

    Parameters
    ----------
    numbers : (n, 4) ndarray
        Components q1 to q4 of n quaternions, in the file's order.
    conventions : ConventionsSpec
        Conventions of the file.
    """
    convention = conventions.quaternion
    assert convention is not None
    assert conventions.body_axes is not None
    xyzw = numbers if convention.scalar == "last" else np.roll(numbers, -1, axis=1)
    if convention.direction == "frame_to_body":
        xyzw = xyzw * np.array([-1.0, -1.0, -1.0, 1.0])
    axes = np.array(measurements.body_axes_matrix(conventions.body_axes), np.float64)
    if np.array_equal(axes, np.eye(3)):
        return np.asarray(xyzw, np.float64)
    from scipy.spatial.transform import Rotation

    # v_frame = R(q) v_file, v_file = axes @ v_project
    return np.asarray((Rotation.from_quat(xyzw) * Rotation.from_matrix(axes)).as_quat(canonical=False))


def _rising(table: Table) -> NDArray[np.intp]:
    """Return the indices that sort the rows by time; raise InputError if a time occurs twice."""
    order = np.argsort(table["time"], kind="stable")
    for row in order[1:][np.diff(table["time"][order]) == 0.0][:1]:
        raise table.error(int(row), "time", "this time occurs twice", f"{table['time'][row]:.9g} s", "each time once")
    return np.asarray(order, np.intp)


def _check_jumps(table: Table, order: NDArray[np.intp], time: Array, position: Array) -> None:
    """Raise InputError for a position that is impossible on an orbit through its neighbours in time."""
    step = np.diff(time)
    with np.errstate(over="ignore", invalid="ignore"):  # times can almost coincide
        rate = np.diff(position, axis=0) / step[:, None]
        change = np.linalg.norm(np.diff(rate, axis=0), axis=1)
        speed = np.median(np.linalg.norm(rate, axis=1))
        jump = ~(change <= _FALL * (step[1:] + step[:-1]) + _JUMP * speed)
    for k in np.flatnonzero(jump)[:1]:
        value, allowed = f"the velocity changes by {change[k]:.4g} m/s", "one pass without manoeuvre"
        raise table.error(int(order[k + 1]), "x", "a jump of the orbit", value, f"{allowed}; exclude wrong readings")


def _check_rotations(table: Table, order: NDArray[np.intp], quaternion: Array) -> None:
    """Raise InputError for a rotation between two readings that is too fast for a satellite."""
    step = np.diff(table["time"][order])
    rotation = 2.0 * np.arccos(np.clip(np.abs(np.sum(quaternion[1:] * quaternion[:-1], axis=1)), 0.0, 1.0))
    for k in np.flatnonzero(rotation > _LEAST_ROTATION + _FASTEST_ROTATION * step)[:1]:
        value = f"{np.degrees(rotation[k]):.4g} deg in {step[k]:.4g} s"
        raise table.error(int(order[k + 1]), "q1", "a jump of the attitude", value, "exclude wrong readings")


def _check_velocity(table: Table, order: NDArray[np.intp], time: Array, position: Array, speed: Array) -> None:
    """Raise InputError unless the velocity is the rate of change of the positions."""
    far, inertial = velocity_misfit(time, position, speed)
    if np.median(far) > SPEED_TOLERANCE:
        row = int(order[int(np.argsort(far)[len(far) // 2])])
        value = f"they differ by {100.0 * np.median(far):.3g} % in the median"
        problem = INERTIAL_VELOCITY if inertial else "not the velocity of these positions"
        raise table.error(row, "vx", problem, value, EARTH_FIXED_VELOCITY)
