"""Orbit and attitude from files of any format: a table of readings in the ITRS, and the sensor of a DIMAP scene.

Reading the files and interpreting them are separate steps: `PlatformReadings` holds the numbers of the files,
`Conventions` specifies their meaning (frames, time scales, order of quaternion elements), and `platform_table` makes
the table from both, so that the same readings can be interpreted under other conventions.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from optics.numerics.array_math import in_span
from scenes.specs.orbit.measurements import body_axes_matrix
from scenes.yaml.csv_table import Column, Table, read_table
from scenes.yaml.errors import InputError, Issue, Problem
from scenes.yaml.units import ANGLE, DISTANCE, SPEED, TIME
from twin.orbit.flight.earth import Earth
from twin.orbit.flight.line_camera import polynomial_line
from twin.orbit.flight.platform_table import PlatformTable, TabulatedTrajectory
from twin.orbit.flight.sensor import NO_EFFECTS, LightEffects, Sensor
from twin.orbit.flight.trajectory import Attitude
from twin.orbit.measured import earth_orientation, orbit_files
from twin.orbit.measured.dimap_file import DimapPass, is_dimap, read_dimap
from twin.orbit.measured.xml_file import first_lines

if TYPE_CHECKING:
    from scenes.specs.orbit.measurements import AttitudeFileSpec, LineTimesFileSpec, OrbitFileSpec, PlatformFilesSpec

_ORBIT = tuple(Column(name, DISTANCE) for name in "xyz") + tuple(Column(f"v{n}", SPEED, needed=False) for n in "xyz")
_CLOCK = (Column("time", TIME, needed=False), Column("date_time", text=True, needed=False))
_NAMED = ("qx", "qy", "qz", "qw")
_PLACED = ("q1", "q2", "q3", "q4")
_ANGLES = ("roll", "pitch", "yaw")
_ATTITUDE_COLUMNS = (
    *(Column(name, needed=False) for name in (*_NAMED, *_PLACED)),
    *(Column(name, ANGLE, needed=False) for name in _ANGLES),
)
_LARGEST_ERROR = 0.01
"""Largest interpolation error of positions between readings that is accepted, in metres."""
_EME2000_FROM_GCRS = np.asarray(erfa.bp06(2451545.0, 0.0)[0])
"""Frame bias, rotation GCRS -> EME2000 (IERS Conventions 2010, section 5.5.4)."""


@dataclass(frozen=True)
class Conventions:
    """Conventions of orbit and attitude files, with the values of the corresponding keys of test files.

    Attributes
    ----------
    orbit_frame, attitude_frame : str
        Reference frames.
    orbit_scale, attitude_scale : str
        Time scales.
    orbit_offset, attitude_offset : float
        Seconds to be added to the times.
    scalar : str
        Position of a quaternion's scalar part.
    sense : str
        Direction of a quaternion's rotation.
    body_axes : tuple of str
        Axes of the body whose attitude the file gives.
    sequence : str
        Sequence of rotation angles.
    law : Attitude
        Definition of the orbital frame.
    """

    orbit_frame: str
    orbit_scale: str
    attitude_frame: str
    attitude_scale: str
    orbit_offset: float = 0.0
    attitude_offset: float = 0.0
    scalar: str = "last"
    sense: str = "body_to_frame"
    body_axes: tuple[str, str, str] = ("forward", "right", "down")
    sequence: str = "xyz"
    law: Attitude = field(default_factory=Attitude)


@dataclass(frozen=True, eq=False)
class PlatformReadings:
    """Orbit and attitude as read from their files, before interpretation.

    Attributes
    ----------
    orbit : OrbitReadings
        Readings of the orbit.
    attitude : AttitudeReadings
        Readings of the attitude.
    earth : EarthOrientation or None
        Table of Earth orientation; None where there is none.
    """

    orbit: orbit_files.OrbitReadings
    attitude: orbit_files.AttitudeReadings
    earth: earth_orientation.EarthOrientation | None


def read_platform(spec: PlatformFilesSpec, folder: Path) -> tuple[PlatformReadings, Conventions]:
    """Read the files of a platform, with the conventions of their numbers.

    Parameters
    ----------
    spec : PlatformFilesSpec
        Paths of the files, and the conventions that they do not specify themselves.
    folder : Path
        Folder to which relative paths refer.

    Raises
    ------
    InputError
        A file cannot be read, or a convention is specified neither by the file nor by `spec`, or differently by both.
    """
    orbit, attitude = _orbit(spec.orbit, folder), _attitude(spec.attitude, folder)
    quaternions = attitude.quaternion is not None
    spec_of = spec.attitude
    frame = _of_file_or_test(spec_of, "frame", spec_of.frame, attitude.frame, "the reference frame of the attitude")
    if frame == "orbital" and (spec_of.nadir is None or spec_of.steering is None):
        problem = "the orbital frame is not specified"
        raise spec_of.error(problem, (), allowed="nadir: geodetic or geocentric, and steering: none or yaw")
    conventions = Conventions(
        _of_file_or_test(spec.orbit, "frame", spec.orbit.frame, orbit.frame, "the frame of the positions"),
        _of_file_or_test(spec.orbit, "time_scale", spec.orbit.time_scale, orbit.scale, "the time scale of the orbit"),
        frame,
        _of_file_or_test(spec_of, "time_scale", spec_of.time_scale, attitude.scale, "the time scale of the attitude"),
        spec.orbit.offset,
        spec_of.offset,
        _of_file_or_test(spec_of, "scalar", spec_of.scalar, attitude.scalar, "the position of the scalar")
        if quaternions
        else "last",
        _of_file_or_test(spec_of, "direction", spec_of.direction, attitude.sense, "the direction of the rotation")
        if quaternions
        else "body_to_frame",
        spec_of.body_axes,
        "xyz"
        if quaternions
        else _of_file_or_test(spec_of, "sequence", spec_of.sequence, None, "the sequence of the angles"),
        Attitude(spec_of.nadir != "geocentric", spec_of.steering == "yaw"),
    )
    if conventions.orbit_frame == "ITRS":
        orbit_files.require_earth_fixed_velocity(orbit)
    return PlatformReadings(orbit, attitude, _earth(spec, folder, orbit, conventions)), conventions


def platform_table(readings: PlatformReadings, conventions: Conventions, epoch: str | None = None) -> PlatformTable:
    """Convert readings of orbit and attitude to a table in the ITRS, under given conventions.

    Parameters
    ----------
    readings : PlatformReadings
        Readings of the files.
    conventions : Conventions
        Conventions of the readings.
    epoch : str or None
        Instant from which times count, UTC, ISO 8601; None for the first orbit reading, rounded down to a second.

    Raises
    ------
    InputError
        A leap second does not exist, Earth orientation for an inertial frame is missing, or the attitude relative to an
        orbital frame has times without orbit.
    """
    orbit, attitude = readings.orbit, readings.attitude
    usable: earth_orientation.Instants | None = None
    if orbit.segments:
        orbit, usable = _single_segment(readings, conventions)
    fixes = _instants(orbit.file, orbit.clock, conventions.orbit_scale, conventions.orbit_offset)
    looks = _instants(attitude.file, attitude.clock, conventions.attitude_scale, conventions.attitude_offset)
    epoch = epoch or earth_orientation.epoch_before(fixes)
    time, attitude_time = fixes.since(epoch), looks.since(epoch)
    inertial = {conventions.orbit_frame, conventions.attitude_frame} - {"ITRS", "orbital"}
    rotation = None
    if inertial:
        if readings.earth is None:
            what = f"{' and '.join(sorted(inertial))} without Earth orientation"
            allowed = "`earth_orientation:` with a table, or `earth:` with UT1 - UTC and the pole"
            raise InputError(Issue(what, orbit.file, None, (), None, allowed))
        first, last = min(time[0], attitude_time[0]), max(time[-1], attitude_time[-1])
        rotation = readings.earth.rotation(epoch, float(first), float(last))
    position, velocity = _in_itrs(orbit, conventions.orbit_frame, time, rotation)
    matrix = _body(attitude, conventions)
    if conventions.attitude_frame == "orbital":
        unit = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
        flown = TabulatedTrajectory(
            PlatformTable.of(epoch, time, position, velocity, time[[0, -1]], unit), conventions.law
        )
        known = flown.covers(attitude_time)
        if np.sum(known) < 2:
            value = f"{attitude_time[0]:.9g} s to {attitude_time[-1]:.9g} s, and orbit from {flown.first:.9g} s"
            allowed = "two or more attitude readings within the time span of the orbit, which defines their frame"
            raise InputError(Issue("attitude at times without orbit", attitude.file, None, (), value, allowed))
        attitude_time = attitude_time[known]
        matrix = flown.orbital_to_itrs(attitude_time) @ matrix[known]
    elif rotation is not None and conventions.attitude_frame != "ITRS":
        matrix = to_itrs(conventions.attitude_frame, rotation)(attitude_time) @ matrix
    quaternion = Rotation.from_matrix(matrix).as_quat(canonical=False)
    try:
        table = PlatformTable.of(epoch, time, position, velocity, attitude_time, quaternion)
    except ValueError as error:
        raise InputError(Issue(str(error), orbit.file)) from None
    between = TabulatedTrajectory(table).interpolation_error
    if between > _LARGEST_ERROR:
        step = float(np.median(np.diff(time)))
        value = f"{between:.2g} m with {step:g} s between readings"
        allowed = f"{_LARGEST_ERROR:g} m: readings closer together"
        raise InputError(
            Issue("positions between the readings are too uncertain", orbit.file, None, (), value, allowed)
        )
    if usable is None:
        return table
    first, last = usable.since(epoch)
    return replace(table, usable=(float(first), float(last)))


def _single_segment(
    readings: PlatformReadings, conventions: Conventions
) -> tuple[orbit_files.OrbitReadings, earth_orientation.Instants | None]:
    """Return the orbit segment that covers most attitude readings, and the instants between which it may be used."""
    orbit, attitude = readings.orbit, readings.attitude
    looks = _instants(attitude.file, attitude.clock, conventions.attitude_scale, conventions.attitude_offset)
    fixes = _instants(orbit.file, orbit.clock, conventions.orbit_scale, conventions.orbit_offset)
    start = earth_orientation.epoch_before(fixes)
    time, attitude_time = fixes.since(start), looks.since(start)
    best, best_count, best_usable = orbit.segments[0], -1, None
    for segment in orbit.segments:
        usable = (
            None
            if segment.usable is None
            else _instants(orbit.file, segment.usable, conventions.orbit_scale, conventions.orbit_offset)
        )
        first, last = (time[segment.first], time[segment.last]) if usable is None else usable.since(start)
        count = int(np.sum(in_span(attitude_time, first, last)))
        if count > best_count:
            best, best_count, best_usable = segment, count, usable
    return replace(orbit.taken(slice(best.first, best.last + 1)), segments=()), best_usable


def _in_itrs(
    orbit: orbit_files.OrbitReadings, frame: str, time: np.ndarray, rotation: earth_orientation.TableRotation | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return N positions, in metres, and velocities, in m/s, of an orbit in the ITRS, (N, 3) each."""
    if frame == "ITRS" or rotation is None:
        return orbit.position, orbit.velocity
    to_earth = to_itrs(frame, rotation)
    matrix = to_earth(time)
    position = np.einsum("nij,nj->ni", matrix, orbit.position)
    if orbit.velocity is None:
        return position, None
    carried = np.cross(earth_orientation.angular_velocity(to_earth, time), position)
    return position, np.einsum("nij,nj->ni", matrix, orbit.velocity) - carried


def to_itrs(frame: str, rotation: earth_orientation.TableRotation) -> Any:
    """Return a function from N times, in seconds, to rotations (N, 3, 3) from an inertial frame to the ITRS."""
    if frame == "TEME":
        return rotation.teme_to_itrs
    if frame == "EME2000":
        return lambda seconds: rotation.matrix(seconds) @ _EME2000_FROM_GCRS.T
    return rotation.matrix


def _body(attitude: orbit_files.AttitudeReadings, conventions: Conventions) -> np.ndarray:
    """Return rotations (M, 3, 3) from the body to the attitude's frame at M readings."""
    if attitude.quaternion is not None:
        q = attitude.quaternion if conventions.scalar == "last" else np.roll(attitude.quaternion, -1, axis=1)
        matrix = np.asarray(Rotation.from_quat(q).as_matrix())
        if conventions.sense == "frame_to_body":
            matrix = np.swapaxes(matrix, 1, 2)
    else:
        assert attitude.angles is not None
        order = ["xyz".index(axis) for axis in conventions.sequence]
        matrix = np.asarray(Rotation.from_euler(conventions.sequence.upper(), attitude.angles[:, order]).as_matrix())
    return matrix @ np.array(body_axes_matrix(conventions.body_axes), dtype=np.float64)


def _instants(file: str, clock: earth_orientation.Readings, scale: str, offset: float) -> earth_orientation.Instants:
    """Return the instants of clock readings, shifted by the offset in seconds."""
    try:
        return clock.instants(scale).later(offset)
    except Problem as problem:
        raise InputError(problem.at(file)) from None


def _of_file_or_test(spec: Any, key: str, in_spec: str | None, in_file: str | None, what: str) -> str:
    """Return the value of a convention; raise InputError if neither test file nor data file gives it or they differ."""
    if in_spec is None and in_file is None:
        raise spec.error(f"{what} is not specified, neither by the file nor here", (key,), allowed=f"`{key}:` here")
    if in_spec is not None and in_file is not None and in_spec != in_file:
        raise spec.error(f"{what} differs from the file", (key,), value=in_spec, allowed=f"{in_file}, as the file says")
    return str(in_spec or in_file)


def _earth(
    spec: PlatformFilesSpec, folder: Path, orbit: orbit_files.OrbitReadings, conventions: Conventions
) -> earth_orientation.EarthOrientation | None:
    """Return the Earth orientation from a table or from constant values; None where neither is given."""
    if spec.earth_orientation is not None:
        return earth_orientation.read_earth_orientation(folder / spec.earth_orientation)
    if spec.earth is not None:
        first = earth_orientation.epoch_before(
            _instants(orbit.file, orbit.clock, conventions.orbit_scale, conventions.orbit_offset)
        )
        return earth_orientation.constant_orientation(first, spec.earth.ut1_utc, spec.earth.polar_motion)
    return None


def _orbit(spec: OrbitFileSpec, folder: Path) -> orbit_files.OrbitReadings:
    """Read the orbit from a file of any format."""
    path = folder / spec.file
    head = list(first_lines(path, "an orbit: SP3, CCSDS OEM, DIMAP, or CSV"))
    if is_dimap(head):
        return read_dimap(path).spanning_orbit()
    if head and orbit_files.is_sp3(head[0]):
        return orbit_files.read_sp3(path, spec.satellite)
    if (kind := orbit_files.message_kind(head)) is not None:
        if kind != "OEM":
            raise InputError(Issue("a CCSDS message of another kind", str(path), 1, (), kind, "OEM"))
        return orbit_files.read_oem(path, spec.satellite)
    table = read_table(path, (*_CLOCK, *_ORBIT), 2)
    clock, scale = _clock(table, spec)
    have = [name for name in ("vx", "vy", "vz") if name in table]
    if len(have) in (1, 2):
        raise InputError(Issue("incomplete velocities", str(path), None, (), ", ".join(have), "vx, vy, vz or none"))
    position, lines = table.stacked("x", "y", "z"), [int(v) for v in table.lines]
    orbit_files.require_orbit(str(path), position, lines)
    velocity = table.stacked("vx", "vy", "vz") if have else None
    return orbit_files.OrbitReadings(str(path), clock, position, velocity, None, scale)


def _attitude(spec: AttitudeFileSpec, folder: Path) -> orbit_files.AttitudeReadings:
    """Read the attitude from a file of any format."""
    path = folder / spec.file
    head = list(first_lines(path, "an attitude: CCSDS AEM, DIMAP, or CSV"))
    if is_dimap(head):
        return read_dimap(path).samples()
    if (kind := orbit_files.message_kind(head)) is not None:
        if kind != "AEM":
            raise InputError(Issue("a CCSDS message of another kind", str(path), 1, (), kind, "AEM"))
        return orbit_files.read_aem(path, spec.satellite)
    table = read_table(path, (*_CLOCK, *_ATTITUDE_COLUMNS), 2)
    clock, scale = _clock(table, spec)
    sets = [names for names in (_NAMED, _PLACED, _ANGLES) if any(n in table for n in names)]
    if len(sets) != 1 or not all(name in table for name in sets[0]):
        allowed = "qx, qy, qz, qw, or q1, q2, q3, q4, or roll [deg], pitch [deg], yaw [deg]"
        value = ", ".join(table.columns)
        raise InputError(Issue("not one complete set of columns", str(path), None, (), value, allowed))
    values, lines = table.stacked(*sets[0]), [int(v) for v in table.lines]
    if sets[0] == _ANGLES:
        return orbit_files.AttitudeReadings(str(path), clock, None, values, None, scale)
    orbit_files.require_unit(str(path), values, lines)
    return orbit_files.AttitudeReadings(
        str(path), clock, values, None, None, scale, "last" if sets[0] == _NAMED else None
    )


def clock_of(table: Table, spec: OrbitFileSpec | AttitudeFileSpec | LineTimesFileSpec) -> earth_orientation.Readings:
    """Return the clock readings of a table's rows, from its column time or date_time.

    Raises
    ------
    InputError
        The table has none or both of the columns, a text is not a date and time, or seconds come without their epoch.
    """
    if ("time" in table) == ("date_time" in table):
        value, allowed = ", ".join(table.columns), "time [s] with `epoch:`, or date_time"
        raise InputError(Issue("times must be given exactly once", table.file, None, (), value, allowed))
    try:
        if "date_time" in table:
            return earth_orientation.Readings.of_texts(table["date_time"].tolist())
        if spec.epoch is None:
            raise spec.error("times in seconds without their epoch", ("epoch",), allowed="reading of the clock at 0 s")
        return earth_orientation.Readings.after(spec.epoch, table["time"])
    except Problem as problem:
        if problem.within:
            row = int(problem.within[0])
            raise table.error(row, "date_time", problem.problem, problem.value, problem.allowed) from None
        raise spec.error(problem.problem, ("epoch",), value=problem.value, allowed=problem.allowed) from None


def _clock(table: Table, spec: OrbitFileSpec | AttitudeFileSpec) -> tuple[earth_orientation.Readings, str | None]:
    """Return the clock readings of a table, checked to increase, and the scale UTC if all their texts end in Z."""
    clock = clock_of(table, spec)
    if "date_time" in table:
        if spec.epoch is not None:
            raise spec.error("an epoch with dates and times", ("epoch",), allowed="no epoch, or a column time [s]")
        zoned = "UTC" if all(text.endswith("Z") for text in table["date_time"]) else None
    else:
        zoned = "UTC" if str(spec.epoch).endswith("Z") else None
        if (spec.time_scale or zoned) == "UTC":
            clock = _counted(spec, clock)
    earth_orientation.require_increasing(table.file, clock, [int(v) for v in table.lines])
    return clock, zoned


def _counted(spec: OrbitFileSpec | AttitudeFileSpec, clock: earth_orientation.Readings) -> earth_orientation.Readings:
    """Return UTC clock readings, corrected where the file's seconds since the epoch include leap seconds."""
    try:
        days, where = np.unique(clock.day, return_inverse=True)
        start = earth_orientation.tai_minus_utc(earth_orientation.calendar_reading(str(spec.epoch))[0])
        since = np.array([earth_orientation.tai_minus_utc(int(day)) for day in days]) - start
    except Problem as problem:
        raise spec.error(problem, ("epoch",)) from None
    between = float(np.max(np.abs(since)))
    if between and spec.leap_seconds is None:
        count = f"{between:g} leap seconds lie between the epoch and the times"
        raise spec.error(count, ("leap_seconds",), allowed="counted or skipped")
    return (
        earth_orientation.Readings(clock.day, clock.second - since[where]) if spec.leap_seconds == "counted" else clock
    )


_ITRS = Conventions("ITRS", "UTC", "ITRS", "UTC", scalar="first", sense="body_to_frame")


@dataclass(frozen=True, eq=False)
class DimapScene:
    """Scene of a DIMAP file with its rigorous sensor model.

    Attributes
    ----------
    read : DimapPass
        Content of the file.
    sensor : Sensor
        Rigorous model; line 0 and pixel 0 are the format's row 1 and column 1.
    epoch : str
        UTC from which the sensor's times are counted.
    """

    read: DimapPass
    sensor: Sensor
    epoch: str


def read_scene(path: str | Path, band: str | None = None, effects: LightEffects | None = None) -> DimapScene:
    """Read the scene of a DIMAP file.

    Parameters
    ----------
    path : str or Path
        File DIM_*.XML of the product.
    band : str or None
        Band whose lines of sight are read; may be omitted where all bands have the same.
    effects : LightEffects or None
        Effects on the light; None for refraction alone, where the file specifies it.

    Raises
    ------
    InputError
        The file cannot be read, or its orbit or attitude do not cover the image.
    """
    read = read_dimap(path, band)
    readings = PlatformReadings(read.spanning_orbit(), read.samples(), None)
    table = platform_table(readings, _ITRS)
    trajectory = TabulatedTrajectory(table)
    first = float(read.first_line.instants("UTC").since(table.epoch)[0])
    if effects is None:
        effects = replace(NO_EFFECTS, refraction=read.refracted)
    camera = polynomial_line(read.name, read.pixels, read.forward, read.right)
    try:
        sensor = Sensor(camera, trajectory, Earth(), read.line_time, first, read.lines, effects)
    except ValueError as error:
        raise InputError(Issue(str(error), read.file, None, ("Refined_Model",), None, _REMEDY)) from None
    middle = 0.5 * (read.lines - 1), 0.5 * (read.pixels - 1)
    if not np.all(np.isfinite(sensor.ground(*(np.array([v]) for v in middle)))):
        problem = "the middle of the image does not look at the Earth"
        raise InputError(Issue(problem, read.file, None, ("Attitudes",), None, "quaternions with their scalar first"))
    return DimapScene(read, sensor, table.epoch)


_REMEDY = "ephemeris and attitudes from before the first line to after the last one"
"""Part of error messages: ephemeris and attitude that a file must contain."""
