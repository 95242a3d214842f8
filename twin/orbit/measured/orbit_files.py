"""Orbit and attitude files of other programs: CCSDS messages (OEM 502.0-B, AEM 504.0-B), SP3-c and SP3-d.

CCSDS: an attitude's quaternion q = (e sin(a/2), cos(a/2)) is the rotation by an angle a about a unit vector e that
takes frame A to frame B. Where B is the body, the body's axes are those of A rotated by q, and R(q) converts components
in the body to those in A: the convention is body_to_frame. It is the opposite for ATTITUDE_DIR B2A, or where frame A is
the body. In version 1 QUATERNION_TYPE gives the position of the scalar; version 2 has it last.

SP3: positions are in kilometres, velocities in dm/s, both Earth-fixed; the time system is in the header. A position of
zeros means a missing value. A file without its last line EOF is complete where it has as many epochs as its header
says.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from analysis.arrays import Array
from scenes.yaml.errors import InputError, Issue, Problem, names_text, nearest, shown
from twin.orbit.flight.sensor import earth_rotation_velocity
from twin.orbit.measured.earth_orientation import Readings, known_scale, readings, require_increasing
from twin.orbit.measured.xml_file import numbers, parsed_xml, text_lines

Frame = Literal["ITRS", "GCRS", "EME2000", "TEME"]
Scalar = Literal["last", "first"]
RotationDirection = Literal["body_to_frame", "frame_to_body"]
FRAMES: tuple[str, ...] = get_args(Frame)
"""Names of the reference frames that can be read."""


@dataclass(frozen=True, eq=False)
class Segment:
    """Part of an orbit that is interpolated separately, such as between two manoeuvres.

    Attributes
    ----------
    first, last : int
        First and last of its readings, counted from 0.
    usable : Readings or None
        Two clock readings between which the file allows the use of the segment; None for all of it.
    """

    first: int
    last: int
    usable: Readings | None = None


@dataclass(frozen=True, eq=False)
class OrbitReadings:
    """Orbit as read from a file, in the file's frame and time scale.

    Attributes
    ----------
    file : str
        Path of the file.
    clock : Readings
        N readings of the clock, increasing.
    position : (N, 3) ndarray
        Positions, metres.
    velocity : (N, 3) ndarray or None
        Velocities, m/s, in and relative to the axes of the same frame; None where the file has none.
    frame : str or None
        Reference frame; None where the file does not specify it.
    scale : str or None
        Time scale of the clock; None where the file does not specify it.
    segments : tuple of Segment
        Parts between which no interpolation is allowed; empty for a single part.
    """

    file: str
    clock: Readings
    position: np.ndarray
    velocity: np.ndarray | None
    frame: str | None = None
    scale: str | None = None
    segments: tuple[Segment, ...] = ()

    def taken(self, part: slice) -> OrbitReadings:
        """Return the orbit readings that a slice of their indices selects, with the segments cut accordingly."""
        begin, end, _ = part.indices(len(self.clock))
        here = (segment for segment in self.segments if segment.first < end and segment.last >= begin)
        segments = (
            replace(segment, first=max(segment.first - begin, 0), last=min(segment.last, end - 1) - begin)
            for segment in here
        )
        velocity, clock = None if self.velocity is None else self.velocity[part], self.clock.taken(part)
        return replace(self, clock=clock, position=self.position[part], velocity=velocity, segments=tuple(segments))


@dataclass(frozen=True, eq=False)
class AttitudeReadings:
    """Attitude as read from a file, in the file's conventions.

    Attributes
    ----------
    file : str
        Path of the file.
    clock : Readings
        M readings of the clock, increasing.
    quaternion : (M, 4) ndarray or None
        Components in the file's order; None for angles.
    angles : (M, 3) ndarray or None
        Roll, pitch, yaw, radians; None for quaternions.
    frame : str or None
        Frame relative to which the body is rotated; None where the file does not specify it.
    scale : str or None
        Time scale of the clock; None where the file does not specify it.
    scalar : Scalar or None
        Position of the quaternion's scalar part, first or last; None where the file does not specify it.
    sense : RotationDirection or None
        Direction of the rotation, body to frame or frame to body; None where the file does not specify it.
    """

    file: str
    clock: Readings
    quaternion: np.ndarray | None
    angles: np.ndarray | None = None
    frame: str | None = None
    scale: str | None = None
    scalar: Scalar | None = None
    sense: RotationDirection | None = None

    def taken(self, part: slice) -> AttitudeReadings:
        """Return the attitude readings that a slice of their indices selects."""
        quaternion, angles = (None if values is None else values[part] for values in (self.quaternion, self.angles))
        return replace(self, clock=self.clock.taken(part), quaternion=quaternion, angles=angles)


def known_frame(name: str, file: str, line: int | None = None, key: str = "REF_FRAME") -> str:
    """Return the reference frame for a name as files spell it.

    Every ITRF, and WGS 84, is treated as ITRS: realisations since 1992 agree to some centimetres. GCRF and ICRF are
    treated as GCRS, and J2000 as EME2000, which is rotated relative to GCRS by 0.02 arcsec.

    Raises
    ------
    InputError
        The frame is not supported.
    """
    word = name.strip().upper().replace("-", "").replace("_", "")
    # SP3 has five letters: ITR97, IER97 of the IERS, IGS14, IGb08, and ECF for an unspecified realisation.
    if word.startswith(("ITRF", "ITRS", "ITR", "IER", "IGS", "IGB", "IGC", "WGS84", "WGS", "SLR", "ECEF", "ECF")):
        return "ITRS"
    frames = {"GCRF": "GCRS", "ICRF": "GCRS", "GCRS": "GCRS", "J2000": "EME2000", "EME2000": "EME2000", "TEME": "TEME"}
    if word not in frames:
        allowed = f"{names_text(FRAMES)}, or names of them as ITRF2014, ICRF, J2000"
        raise InputError(Issue("unknown reference frame", file, line, (key,), shown(name), allowed))
    return frames[word]


def require_orbit(file: str, position: np.ndarray, lines: list[int]) -> None:
    """Raise InputError unless N positions (N, 3), in metres, lie between the Earth's surface and 100 000 km.

    Other positions probably have the wrong unit. `lines` are the line numbers of the positions in the file.
    """
    radius = np.linalg.norm(position, axis=1)
    for row in np.flatnonzero((radius < 6.3e6) | (radius > 1e8))[:1]:
        value = f"{radius[row] / 1e3:.6g} km from the Earth's centre"
        raise InputError(
            Issue("not a satellite position", file, lines[row], (), value, "6300 km to 100 000 km; units?")
        )


def require_unit(file: str, quaternion: np.ndarray, lines: list[int]) -> None:
    """Raise InputError unless M quaternions (M, 4), read from these lines of a file, have length 1 to a thousandth."""
    length = np.linalg.norm(quaternion, axis=1)
    for row in np.flatnonzero(np.abs(length - 1.0) > 1e-3)[:1]:
        value = f"length {length[row]:.6g}"
        raise InputError(Issue("not a unit quaternion", file, lines[row], (), value, "length 1"))


SPEED_TOLERANCE = 0.02
"""Largest relative difference between a velocity and the rate of change of the positions.

Noise of 1 m in positions 1 s apart causes a smaller difference, and inertial velocities differ by at least 6 % from
those relative to the Earth.
"""


def velocity_misfit(time: Array, position: Array, speed: Array) -> tuple[Array, bool]:
    """Return the misfit of velocities to Earth-fixed positions, and whether the velocities are inertial.

    Inertial velocities are larger by omega x P, with the Earth's rotation vector omega and the position P.

    Parameters
    ----------
    time : (N,) ndarray for N readings
        Times, seconds.
    position : (N, 3) ndarray
        Positions in the ITRS, metres.
    speed : (N, 3) ndarray
        Velocities in axes of the ITRS, m/s.

    Returns
    -------
    tuple of (N - 1,) ndarray and bool
        Relative differences between velocities and rates of change of positions, and True if the velocities fit only
        after subtraction of omega x P.
    """
    rate = np.diff(position, axis=0) / np.diff(time)[:, None]
    # Across a long step the chord is shorter than the arc and lies to its side, which is not an error of the velocity.
    earth_fixed, inertial = (
        np.linalg.norm(rate - 0.5 * (v[1:] + v[:-1]), axis=1) / np.linalg.norm(rate, axis=1).clip(1.0)
        for v in (speed, speed - earth_rotation_velocity(position))
    )
    return earth_fixed, bool(np.median(earth_fixed) > SPEED_TOLERANCE >= np.median(inertial))


def require_earth_fixed_velocity(orbit: OrbitReadings) -> None:
    """Raise InputError if Earth-fixed positions come with inertial velocities."""
    time = (orbit.clock.day - orbit.clock.day[0]) * 86400.0 + orbit.clock.second
    if orbit.velocity is not None and velocity_misfit(time, orbit.position, orbit.velocity)[1]:
        raise InputError(Issue(INERTIAL_VELOCITY, orbit.file, None, (), None, EARTH_FIXED_VELOCITY))


INERTIAL_VELOCITY = "the velocities are inertial, larger than those of the Earth-fixed positions by omega x P"
"""Error text for inertial velocities given with Earth-fixed positions."""
EARTH_FIXED_VELOCITY = "velocities relative to the same axes as the positions, or none"
"""Error text that says which velocities are allowed."""


_COVARIANCE = ("COVARIANCE_START", "COVARIANCE_STOP")


@dataclass
class _Segment:
    """Metadata and data of a segment of a CCSDS message, with their line numbers in the file."""

    keys: dict[str, tuple[str, int]] = field(default_factory=dict)
    rows: list[list[str]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)


def message_kind(lines: list[str]) -> str | None:
    """Return OEM or AEM for a message's first lines; None for another file."""
    text = "\n".join(lines[:20])
    for kind in ("OEM", "AEM"):
        if f"CCSDS_{kind}_VERS" in text or f"<{kind.lower()}" in text:
            return kind
    return None


def read_oem(path: str | Path, satellite: str | None = None) -> OrbitReadings:
    """Read the orbit of a CCSDS OEM.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    satellite : str or None
        OBJECT_ID or OBJECT_NAME of the satellite; may be omitted where there is only one.

    Raises
    ------
    InputError
        The file cannot be read, is about another body than the Earth, or its segments do not fit together.
    """
    file = str(path)
    segments = _chosen(file, _segments(path, "OEM"), satellite)
    for segment in segments:
        centre, line = segment.keys.get("CENTER_NAME", ("", 1))
        if centre.upper() != "EARTH":
            raise InputError(Issue("an orbit about another body", file, line, ("CENTER_NAME",), shown(centre), "EARTH"))
    frame, line = _same(file, segments, "REF_FRAME")
    rows, lines = [row for s in segments for row in s.rows], [line for s in segments for line in s.lines]
    widths = {len(row) for row in rows}
    cells = [row[1:7] for row in rows] if widths <= {7, 10} else [row[1:] for row in rows]
    states = 1e3 * numbers(file, cells, lines, ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT"))
    clock = readings(file, [row[0] for row in rows], lines)
    require_orbit(file, states[:, :3], lines)
    parts = _parts(file, segments)
    for part, segment in zip(parts, segments, strict=True):
        part_of = slice(part.first, part.last + 1)
        require_increasing(file, Readings(clock.day[part_of], clock.second[part_of]), segment.lines)
    scale = _scale(file, segments)
    return OrbitReadings(file, clock, states[:, :3], states[:, 3:], known_frame(frame, file, line), scale, parts)


def read_aem(path: str | Path, satellite: str | None = None) -> AttitudeReadings:
    """Read the attitude of a CCSDS AEM of quaternions.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    satellite : str or None
        OBJECT_ID or OBJECT_NAME of the satellite; may be omitted where there is only one.

    Raises
    ------
    InputError
        The file cannot be read, or its segments do not fit together.
    """
    file = str(path)
    segments = _chosen(file, _segments(path, "AEM"), satellite)
    kind, line = _same(file, segments, "ATTITUDE_TYPE")
    if not kind.upper().startswith("QUATERNION"):
        problem = "unsupported attitude type"
        raise InputError(Issue(problem, file, line, ("ATTITUDE_TYPE",), shown(kind), "QUATERNION"))
    frames = {key: _same(file, segments, key) for key in ("REF_FRAME_A", "REF_FRAME_B")}
    body = [key for key, (name, _) in frames.items() if name.upper().startswith(("SC_", "SC", "SPACECRAFT"))]
    if len(body) != 1:
        value = names_text(name for name, _ in frames.values())
        problem = "one of the two frames must be the body's"
        allowed = "SC_BODY or another frame of the spacecraft, SC_..., and a reference frame"
        raise InputError(Issue(problem, file, frames["REF_FRAME_A"][1], ("REF_FRAME_A",), value, allowed))
    reference, at = frames["REF_FRAME_A" if body[0] == "REF_FRAME_B" else "REF_FRAME_B"]
    direction, direction_line = _same(file, segments, "ATTITUDE_DIR", "A2B")
    if direction.upper() not in ("A2B", "B2A"):
        raise InputError(
            Issue("unknown direction", file, direction_line, ("ATTITUDE_DIR",), shown(direction), "A2B, B2A")
        )
    to_body = (direction.upper() == "A2B") == (body[0] == "REF_FRAME_B")
    rotation_direction: RotationDirection = "body_to_frame" if to_body else "frame_to_body"
    first, type_line = _same(file, segments, "QUATERNION_TYPE", "LAST")
    if first.upper() not in ("FIRST", "LAST"):
        raise InputError(Issue("unknown type", file, type_line, ("QUATERNION_TYPE",), shown(first), "FIRST, LAST"))
    scalar: Scalar = "first" if first.upper() == "FIRST" else "last"
    rows, lines = _joined(segments)
    cells = [row[1:5] if len(row) >= 5 else row[1:] for row in rows]
    heads = ("QC", "Q1", "Q2", "Q3") if scalar == "first" else ("Q1", "Q2", "Q3", "QC")
    quaternion = numbers(file, cells, lines, heads)
    require_unit(file, quaternion, lines)
    clock = readings(file, [row[0] for row in rows], lines)
    require_increasing(file, clock, lines)
    frame = known_frame(reference, file, at, "REF_FRAME_A")
    return AttitudeReadings(file, clock, quaternion, None, frame, _scale(file, segments), scalar, rotation_direction)


def _segments(path: str | Path, kind: str) -> list[_Segment]:
    """Return the segments of a message that hold data."""
    file, lines = str(path), text_lines(path, f"a CCSDS {kind}")
    xml = any(line.lstrip().startswith("<") for line in lines[:20])
    segments = list(_from_xml(file, "\n".join(lines), kind) if xml else _from_text(file, lines, kind))
    if not any(segment.rows for segment in segments):
        raise InputError(Issue("no data", file, None, (), None, f"segments of a CCSDS {kind} with lines of data"))
    return [segment for segment in segments if segment.rows]


def _from_text(file: str, lines: list[str], kind: str) -> Iterator[_Segment]:
    """Parse the segments of a message in text form (KVN)."""
    segment: _Segment | None = None
    inside, skipped = "", False
    for k, raw in enumerate(lines):
        line = raw.strip()
        if not line or line.startswith("COMMENT"):
            continue
        if line == "META_START":
            if segment is not None:
                yield segment
            segment, inside = _Segment(), "meta"
        elif line == "META_STOP":
            inside = "data"
        elif line in _COVARIANCE:
            skipped = line == _COVARIANCE[0]
        elif line in ("DATA_START", "DATA_STOP") or skipped:
            inside = "data" if line == "DATA_START" else inside
        elif inside == "meta" or (segment is None and "=" in line):
            key, sign, value = line.partition("=")
            if not sign:
                raise InputError(Issue("not key = value", file, k + 1, (), shown(line), "KEY = VALUE"))
            if segment is not None:
                segment.keys[key.strip()] = (value.strip(), k + 1)
        elif segment is None or inside != "data":
            raise InputError(Issue("data before META_START", file, k + 1, (), shown(line), f"a CCSDS {kind}"))
        else:
            segment.rows.append(line.split())
            segment.lines.append(k + 1)
    if skipped or inside == "meta":
        missing = "COVARIANCE_STOP" if skipped else "META_STOP"
        raise InputError(Issue("the file ends early", file, len(lines), (), None, missing))
    if segment is not None:
        yield segment


_STATE = ("EPOCH", "X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
"""Names of the elements of a state vector (position and velocity) in XML."""
_QUATERNION_COLUMNS = {"LAST": ("EPOCH", "Q1", "Q2", "Q3", "QC"), "FIRST": ("EPOCH", "QC", "Q1", "Q2", "Q3")}
"""Names of the elements of an attitude state in XML, by QUATERNION_TYPE (position of the scalar)."""


def _from_xml(file: str, text: str, kind: str) -> Iterator[_Segment]:
    """Parse the segments of a message in XML."""
    root = parsed_xml(text, file)
    for element in root.iter("segment"):
        segment = _Segment()
        for meta in element.iter("metadata"):
            segment.keys |= {item.tag: (item.text, item.line) for item in meta.children}
        heads = (
            _STATE
            if kind == "OEM"
            else _QUATERNION_COLUMNS[segment.keys.get("QUATERNION_TYPE", ("LAST", 1))[0].upper() or "LAST"]
        )
        for state in (*element.iter("stateVector"), *element.iter("attitudeState")):
            cells = {item.tag: item.text for item in state.below()}
            if missing := [head for head in heads if not cells.get(head)]:
                number = len(segment.rows) + 1
                problem = f"state {number} has no {missing[0]}"
                raise InputError(Issue(problem, file, state.line, (), None, names_text(heads)))
            segment.rows.append([cells[head] for head in heads])
            segment.lines.append(state.line)
        yield segment


def _chosen(file: str, segments: list[_Segment], satellite: str | None) -> list[_Segment]:
    """Return the segments of one satellite."""
    names: dict[str, Mapping[str, None]] = {}
    for segment in segments:
        known = {segment.keys[k][0]: None for k in ("OBJECT_ID", "OBJECT_NAME") if k in segment.keys}
        names[segment.keys.get("OBJECT_ID", segment.keys.get("OBJECT_NAME", ("", 0)))[0]] = known
    allowed = [name for known in names.values() for name in known]
    if satellite is None:
        if len(names) > 1:
            value = names_text(names)
            raise InputError(Issue("the satellite is not specified", file, None, ("satellite",), value, "one of them"))
        return segments
    segments_of_object = [
        s for s in segments if satellite in (s.keys.get(k, ("",))[0] for k in ("OBJECT_ID", "OBJECT_NAME"))
    ]
    if not segments_of_object:
        suggestion = nearest(satellite, allowed)
        raise InputError(
            Issue("no such satellite", file, None, ("satellite",), satellite, names_text(allowed), suggestion)
        )
    return segments_of_object


def _same(file: str, segments: list[_Segment], key: str, usual: str | None = None) -> tuple[str, int]:
    """Return the value of a key, which must be the same in all segments, and its line in the file."""
    entries = [s.keys.get(key) for s in segments]
    values = {None if value is None else value[0] for value in entries}
    if values == {None} and usual is not None:
        return usual, 1
    first = next((value for value in entries if value is not None), None)
    if first is None or None in values:
        raise InputError(Issue(f"no {key}", file, None, (key,), None, "this key in the metadata of every segment"))
    if len(values) > 1:
        value = names_text(sorted(map(str, values)))
        raise InputError(Issue(f"segments with different {key}", file, first[1], (key,), value, "the same in all"))
    return first


def _scale(file: str, segments: list[_Segment]) -> str:
    """Return the time scale of the segments."""
    name, line = _same(file, segments, "TIME_SYSTEM")
    try:
        return known_scale(name)
    except Problem as problem:
        raise InputError(problem.at(file, line, ("TIME_SYSTEM",))) from None


def _parts(file: str, segments: list[_Segment]) -> tuple[Segment, ...]:
    """Return the segments of an orbit as parts that are interpolated separately.

    No interpolation is allowed from one to the next, because they meet at discontinuities such as manoeuvres, and no
    use outside of USEABLE_START_TIME and USEABLE_STOP_TIME (502.0-B, 5.2.4).
    """
    parts, first = [], 0
    for segment in segments:
        count = len(segment.rows)
        ends = [segment.keys.get(f"USEABLE_{end}_TIME", segment.keys.get(f"{end}_TIME")) for end in ("START", "STOP")]
        usable = None
        if any(f"USEABLE_{end}_TIME" in segment.keys for end in ("START", "STOP")):
            texts = [segment.rows[k][0] if limit is None else limit[0] for k, limit in zip((0, -1), ends, strict=True)]
            where = [segment.lines[k] if limit is None else limit[1] for k, limit in zip((0, -1), ends, strict=True)]
            usable = readings(file, texts, where)
        parts.append(Segment(first, first + count - 1, usable))
        first += count
    return tuple(parts)


def _joined(segments: list[_Segment]) -> tuple[list[list[str]], list[int]]:
    """Return the data rows of all segments with their line numbers; a time shared by two segments is listed once."""
    rows: list[list[str]] = []
    lines: list[int] = []
    for segment in segments:
        start = 1 if rows and segment.rows and segment.rows[0][0] == rows[-1][0] else 0
        rows += segment.rows[start:]
        lines += segment.lines[start:]
    return rows, lines


WHAT = "an SP3 file"
"""Description of the file for error messages."""


def is_sp3(first: str) -> bool:
    """Return whether a file that begins with this line is an SP3 file."""
    return first.startswith(("#a", "#b", "#c", "#d")) and not first.startswith("##")


def read_sp3(path: str | Path, satellite: str | None = None) -> OrbitReadings:
    """Read the orbit of a satellite from an SP3 file.

    Parameters
    ----------
    path : str or Path
        Path of the file.
    satellite : str or None
        Identifier of the satellite in the file, such as L51; may be omitted where there is only one.

    Raises
    ------
    InputError
        The satellite is unknown, has fewer than two positions, a line cannot be read, or the file ends early.
    """
    file, lines = str(path), text_lines(path, WHAT)
    head = lines[0]
    old = head[:2] in ("#a", "#b")
    which = _satellite(file, lines, satellite, old)
    scale = _sp3_scale(file, lines, old)
    system = head[46:51].strip()
    frame = known_frame(system, file, 1, "coordinate system") if system not in ("", "UNDEF") else None
    texts, position_cells, rows, speeds, speed_rows = [], [], [], [], []
    epoch: str | None = None
    ended = used = False
    epochs = 0
    for k, line in enumerate(lines):
        mark, cells = line[:1], [line[4:18], line[18:32], line[32:46]]
        if mark == "*":
            epoch, used, epochs = _epoch(file, k + 1, line), False, epochs + 1
        elif mark in "PV" and line[1:4].strip() == which:
            if epoch is None:
                raise InputError(Issue("a record before the first epoch", file, k + 1, (), shown(line[:20]), WHAT))
            if mark == "P":
                used = any(c.strip(" 0.-") for c in cells) or not all(c.strip() for c in cells)
            if mark == "P" and used:
                texts.append(epoch)
                position_cells.append(cells)
                rows.append(k + 1)
            elif mark == "V" and used:
                speeds.append(cells)
                speed_rows.append(k + 1)
        elif line.startswith("EOF"):
            ended = True
            break
    epoch_count = head[32:39].strip()
    if not ended and not (epoch_count.isdigit() and int(epoch_count) == epochs and used):
        value = f"{epochs} of {epoch_count} epochs" if epoch_count.isdigit() else None
        allowed = "EOF as the last line, or all epochs of the header"
        raise InputError(Issue("the file ends early", file, len(lines), (), value, allowed))
    if len(rows) < 2:
        raise InputError(Issue(f"fewer than two positions of {which}", file, None, (), str(len(rows)), "two or more"))
    clock = readings(file, texts, rows)
    require_increasing(file, clock, rows)
    position = 1e3 * numbers(file, position_cells, rows, ("x", "y", "z"))
    require_orbit(file, position, rows)
    velocity = None
    if speeds:
        if len(speeds) != len(rows):
            value = f"{len(speeds)} velocities and {len(rows)} positions"
            raise InputError(Issue("velocities are missing", file, None, (), value, "one for each position, or none"))
        velocity = 0.1 * numbers(file, speeds, speed_rows, ("vx", "vy", "vz"))
    return OrbitReadings(file, clock, position, velocity, frame, scale)


def _satellite(file: str, lines: list[str], wanted: str | None, old: bool) -> str:
    """Return the identifier of a satellite as the SP3 file writes it; in versions a and b it may be a bare number."""
    names = list(dict.fromkeys(line[1:4].strip() for line in lines if line[:1] == "P"))
    key, value = ("satellite",), names_text(names[:20]) or "none"
    if wanted is None:
        if len(names) != 1:
            raise InputError(Issue("the satellite is not specified", file, None, key, value, "the name of one"))
        return names[0]
    alike = [n for n in sorted(names) if n.lstrip("Gg").strip().lstrip("0") == wanted.lstrip("Gg").lstrip("0")]
    name = wanted if wanted in names or not (old and alike) else alike[0]
    if name not in names:
        raise InputError(Issue("no such satellite", file, None, key, wanted, value, nearest(wanted, names)))
    return name


def _sp3_scale(file: str, lines: list[str], old: bool) -> str:
    """Return the time scale of an SP3 file; files of versions a and b that do not specify one have GPS time."""
    for k, line in enumerate(lines[:400]):
        if line.startswith("%c"):
            if old and line[9:12].lower() in ("ccc", "", "   "):
                return known_scale("GPS")
            try:
                return known_scale(line[9:12])
            except Problem as problem:
                raise InputError(problem.at(file, k + 1, ("time system",))) from None
    if old:
        return known_scale("GPS")
    raise InputError(Issue("no line %c with the time system", file, None, (), None, WHAT))


def _epoch(file: str, k: int, line: str) -> str:
    """Return the calendar text of an epoch header record."""
    cells = line[1:].split()
    try:
        year, month, day, hour, minute = (int(c) for c in cells[:5])
        whole, _, part = cells[5].partition(".")
        return f"{year:04d}-{month:02d}-{day:02d}T{hour:02d}:{minute:02d}:{int(whole):02d}.{part or '0'}"
    except (ValueError, IndexError):
        allowed = "*  2011  3  5  3  5  0.00000000"
        raise InputError(Issue("not an epoch", file, k, (), shown(line), allowed)) from None
