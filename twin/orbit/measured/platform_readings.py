"""Orbit and attitude as files and the columns of own tables hold them, with what is known of the numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from analysis.arrays import Array
from scenes.specs.orbit.measurements import ConventionsSpec, body_axes_matrix
from scenes.yaml.csv_table import Table
from scenes.yaml.errors import InputError, Issue, names_text, shown
from twin.orbit.flight.light_effects import carried_with_earth
from twin.orbit.flight.platform_table import PlatformTable
from twin.orbit.measured.clock import Readings

Frame = Literal["ITRS", "GCRS", "EME2000", "TEME"]
Scalar = Literal["last", "first"]
Turns = Literal["body_to_frame", "frame_to_body"]
FRAMES: tuple[str, ...] = get_args(Frame)


@dataclass(frozen=True, eq=False)
class Segment:
    """Part of an orbit that is joined by itself, as between two manoeuvres.

    Attributes:
        first, last: of its readings, counted from 0.
        usable: two clock readings between which the file says that it may be used; None for all of it.
    """

    first: int
    last: int
    usable: Readings | None = None


@dataclass(frozen=True, eq=False)
class OrbitReadings:
    """An orbit as a file holds it.

    Attributes:
        file: where it is from.
        clock: N readings, rising.
        position: (N, 3) metres.
        velocity: (N, 3) m/s in axes and against axes of the same frame; None where the file has none.
        frame: in which; None where the file does not say.
        scale: of the clock; None where the file does not say.
        segments: parts that no interpolation may join; empty for one.
    """

    file: str
    clock: Readings
    position: np.ndarray
    velocity: np.ndarray | None
    frame: str | None = None
    scale: str | None = None
    segments: tuple[Segment, ...] = ()


@dataclass(frozen=True, eq=False)
class AttitudeReadings:
    """An attitude as a file holds it.

    Attributes:
        file: where it is from.
        clock: M readings, rising.
        quaternion: (M, 4) components as they stand in the file; None for angles.
        angles: (M, 3) roll, pitch, yaw, radians; None for quaternions.
        frame: that the body is turned against; None where the file does not say.
        scale: of the clock; None where the file does not say.
        scalar: where the scalar part stands; None where the file does not say.
        turns: what the quaternion turns into what; None where the file does not say.
    """

    file: str
    clock: Readings
    quaternion: np.ndarray | None
    angles: np.ndarray | None = None
    frame: str | None = None
    scale: str | None = None
    scalar: Scalar | None = None
    turns: Turns | None = None


def known_frame(name: str, file: str, line: int | None = None, key: str = "REF_FRAME") -> str:
    """The frame of this name as files of others spell it.

    Every ITRF and WGS 84 counts as ITRS: realisations since 1992 agree to some centimetres. GCRF and ICRF are GCRS, and
    J2000 is EME2000, which is turned against it by 0.02 arcsec.

    Raises:
        InputError: another one.
    """
    word = name.strip().upper().replace("-", "").replace("_", "")
    # SP3 has five letters: ITR97, IER97 of the IERS, IGS14, IGb08, and ECF where a realisation is not said
    if word.startswith(("ITRF", "ITRS", "ITR", "IER", "IGS", "IGB", "IGC", "WGS84", "WGS", "SLR", "ECEF", "ECF")):
        return "ITRS"
    found = {"GCRF": "GCRS", "ICRF": "GCRS", "GCRS": "GCRS", "J2000": "EME2000", "EME2000": "EME2000", "TEME": "TEME"}
    if word not in found:
        allowed = f"{names_text(FRAMES)}, or names of them as ITRF2014, ICRF, J2000"
        raise InputError(Issue("a frame that cannot be read", file, line, (key,), shown(name), allowed))
    return found[word]


def require_orbit(file: str, position: np.ndarray, lines: list[int]) -> None:
    """InputError unless positions (N, 3), metres, on these lines lie between the Earth's surface and 100 000 km: what
    fails has the wrong unit.
    """
    radius = np.linalg.norm(position, axis=1)
    far = (radius < 6.3e6) | (radius > 1e8)
    if np.any(far):
        row = int(np.argmax(far))
        found = f"{radius[row] / 1e3:.6g} km from the Earth's centre"
        raise InputError(Issue("no place of a satellite", file, lines[row], (), found, "6300 km to 100 000 km; units?"))


def require_unit(file: str, quaternion: np.ndarray, lines: list[int]) -> None:
    """InputError unless quaternions (M, 4) on these lines have length 1 to a thousandth."""
    length = np.linalg.norm(quaternion, axis=1)
    far = np.abs(length - 1.0) > 1e-3
    if np.any(far):
        row = int(np.argmax(far))
        found = f"length {length[row]:.6g}"
        raise InputError(Issue("not a quaternion of a rotation", file, lines[row], (), found, "length 1"))


_LEAST_RADIUS, _MOST_RADIUS = 6.45e6, 5.0e7
"""Metres from the Earth's centre: of satellites that map the Earth."""
SPEED_TOLERANCE = 0.02
"""Relative tolerance of a velocity. Positions of 1 m noise 1 s apart differ by less, and the velocity against the stars
differs by 6 % and more."""
_UNIT_TOLERANCE = 1e-3
_FALL, _JUMP = 12.0, 0.05
"""Largest acceleration, m/s^2, and share of the speed by which readings one interval apart may change it by noise."""
_LEAST_TURN, _FASTEST_TURN = np.radians(2.0), np.radians(10.0)
"""Between two readings, radians, and radians for each second: more than agile satellites turn."""


def platform_of(epoch: str, orbit: Table, attitude: Table, conventions: ConventionsSpec) -> PlatformTable:
    """Orbit and attitude.

    Args:
        epoch: UTC.
        orbit: its table.
        attitude: its table, which may be the same.
        conventions: of both.

    Raises:
        InputError: a time twice, a place where no satellite is, a velocity that is not that of the places, a
            quaternion that is not of unit length.
    """
    order, looks = _rising(orbit), _rising(attitude)
    time, place = orbit["time"][order], orbit.stacked("x", "y", "z")[order]
    radius = np.linalg.norm(place, axis=1)
    wrong = np.flatnonzero((radius < _LEAST_RADIUS) | (radius > _MOST_RADIUS))
    if len(wrong):
        found = f"{radius[wrong[0]] / 1e3:.6g} km from the Earth's centre"
        allowed = f"{_LEAST_RADIUS / 1e3:g} to {_MOST_RADIUS / 1e3:g} km; is the unit in the head right?"
        raise orbit.error(int(order[wrong[0]]), "x", "no place of a satellite", found, allowed)
    _check_jumps(orbit, order, time, place)
    speed = None
    given = [name for name in ("vx", "vy", "vz") if name in orbit]
    if given:
        missing = [name for name in ("vx", "vy", "vz") if name not in orbit]
        if missing:
            raise InputError(
                Issue(f"no column {missing[0]!r}", orbit.file, found=names_text(given), allowed="all three or none")
            )
        speed = orbit.stacked("vx", "vy", "vz")[order]
        _check_velocity(orbit, order, time, place, speed)
    numbers = attitude.stacked("q1", "q2", "q3", "q4")[looks]
    norm = np.linalg.norm(numbers, axis=1)
    far = np.flatnonzero(np.abs(norm - 1.0) > _UNIT_TOLERANCE)
    if len(far):
        found = f"a norm of {norm[far[0]]:.6g}"
        raise attitude.error(int(looks[far[0]]), "q1", "no unit quaternion", found, "four numbers of norm 1")
    quaternion = _quaternions_of(numbers, conventions)
    _check_turns(attitude, looks, quaternion)
    return PlatformTable.of(epoch, time, place, speed, attitude["time"][looks], quaternion)


def _quaternions_of(numbers: Array, conventions: ConventionsSpec) -> Array:
    """Quaternions x, y, z, w that turn the project's body axes into those of the frame.

    Args:
        numbers: (n, 4) q1 to q4 as the file has them.
        conventions: what they mean.
    """
    said = conventions.quaternion
    assert said is not None
    assert conventions.body_axes is not None
    xyzw = numbers if said.scalar == "last" else np.roll(numbers, -1, axis=1)
    if said.turns == "frame_to_body":
        xyzw = xyzw * np.array([-1.0, -1.0, -1.0, 1.0])
    axes = np.array(body_axes_matrix(conventions.body_axes), np.float64)
    if np.array_equal(axes, np.eye(3)):
        return np.asarray(xyzw, np.float64)
    from scipy.spatial.transform import Rotation

    # v_frame = R(q) v_file, v_file = axes @ v_project
    return np.asarray((Rotation.from_quat(xyzw) * Rotation.from_matrix(axes)).as_quat(canonical=False))


def _rising(table: Table) -> NDArray[np.intp]:
    """Rows in the order of time. InputError for a time twice."""
    order = np.argsort(table["time"], kind="stable")
    twice = np.flatnonzero(np.diff(table["time"][order]) == 0.0)
    if len(twice):
        row = int(order[twice[0] + 1])
        raise table.error(row, "time", "this time stands twice", f"{table['time'][row]:.9g} s", "each time once")
    return np.asarray(order, np.intp)


def _check_jumps(table: Table, order: NDArray[np.intp], time: Array, place: Array) -> None:
    """InputError for a place that no orbit passes between its neighbours."""
    step = np.diff(time)
    with np.errstate(over="ignore", invalid="ignore"):  # of times that all but coincide
        rate = np.diff(place, axis=0) / step[:, None]
        change = np.linalg.norm(np.diff(rate, axis=0), axis=1)
        speed = np.median(np.linalg.norm(rate, axis=1))
        jump = np.flatnonzero(~(change <= _FALL * (step[1:] + step[:-1]) + _JUMP * speed))
    if len(jump):
        row = int(order[jump[0] + 1])
        found = f"the velocity changes by {change[jump[0]]:.4g} m/s"
        raise table.error(
            row, "x", "a jump of the orbit", found, "one pass without manoeuvre; leave out wrong readings"
        )


def _check_turns(table: Table, order: NDArray[np.intp], quaternion: Array) -> None:
    """InputError for a turn from one reading to the next that no satellite makes."""
    step = np.diff(table["time"][order])
    turn = 2.0 * np.arccos(np.clip(np.abs(np.sum(quaternion[1:] * quaternion[:-1], axis=1)), 0.0, 1.0))
    jump = np.flatnonzero(turn > _LEAST_TURN + _FASTEST_TURN * step)
    if len(jump):
        row, found = int(order[jump[0] + 1]), f"{np.degrees(turn[jump[0]]):.4g} deg in {step[jump[0]]:.4g} s"
        raise table.error(row, "q1", "a jump of the attitude", found, "leave out wrong readings")


def velocity_misfit(time: Array, place: Array, speed: Array) -> tuple[Array, bool]:
    """Return by how much velocities differ from the change of Earth-fixed places, and whether they are recognised as
    those against the stars, which are larger by omega x P.

    Args:
        time: (N,), seconds.
        place: (N, 3), ITRS, metres.
        speed: (N, 3), in axes of the ITRS, m/s.

    Returns:
        Relative differences (N - 1,), and whether the velocities less omega x P fit while they themselves do not.
    """
    rate = np.diff(place, axis=0) / np.diff(time)[:, None]
    # across a long step the chord is shorter than the arc, and lies to its side; that is no error of the velocity
    own, turning = (
        np.linalg.norm(rate - 0.5 * (v[1:] + v[:-1]), axis=1) / np.linalg.norm(rate, axis=1).clip(1.0)
        for v in (speed, speed - carried_with_earth(place))
    )
    return own, bool(np.median(own) > SPEED_TOLERANCE >= np.median(turning))


def require_own_velocity(orbit: OrbitReadings) -> None:
    """InputError if velocities of Earth-fixed positions are those against the stars."""
    time = (orbit.clock.day - orbit.clock.day[0]) * 86400.0 + orbit.clock.second
    if orbit.velocity is not None and velocity_misfit(time, orbit.position, orbit.velocity)[1]:
        raise InputError(Issue(INERTIAL, orbit.file, None, (), None, _AGAINST_EARTH))


INERTIAL = "the velocities are against the stars, larger than those of the Earth-fixed positions by omega x P"
_AGAINST_EARTH = "velocities against the same axes as the positions, or none"


def _check_velocity(table: Table, order: NDArray[np.intp], time: Array, place: Array, speed: Array) -> None:
    """InputError unless the velocity is the rate of change of the places."""
    far, inertial = velocity_misfit(time, place, speed)
    if np.median(far) > SPEED_TOLERANCE:
        row = int(order[int(np.argsort(far)[len(far) // 2])])
        found = f"they differ by {100.0 * np.median(far):.3g} % in the median"
        problem = INERTIAL if inertial else "not the velocity of these positions"
        raise table.error(row, "vx", problem, found, _AGAINST_EARTH)
