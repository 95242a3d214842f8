"""Orbit and attitude as a file holds them, before anything is read into them: clock readings and numbers, with the
frame and the time scale that the file itself states.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from scenes.yaml.errors import InputError, Issue, names_text, shown
from twin.orbit.measured.clock import Readings

Frame = Literal["ITRS", "GCRS", "EME2000", "TEME"]
AttitudeFrame = Literal["ITRS", "GCRS", "EME2000", "TEME", "orbital"]
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
