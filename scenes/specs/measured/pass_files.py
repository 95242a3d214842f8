"""Files of other people's formats that tell of a pass, with what the files themselves do not say of their numbers."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.flight import EarthSpec
from scenes.yaml.errors import Problem, names_text
from scenes.yaml.quantity import Quantity
from scenes.yaml.spec import Reference, Spec, SpecType, Text, Whole
from scenes.yaml.units import ANGLE, LENGTH, TIME

Toward = Literal["forward", "back", "right", "left", "up", "down"]
_TOWARD: Mapping[str, tuple[int, int, int]] = {
    "forward": (1, 0, 0),
    "back": (-1, 0, 0),
    "right": (0, 1, 0),
    "left": (0, -1, 0),
    "down": (0, 0, 1),
    "up": (0, 0, -1),
}
"""In the project's body axes: X forward, Y right, Z down."""


def body_axes_matrix(axes: tuple[str, str, str]) -> tuple[tuple[int, int, int], ...]:
    """Rows: the file's body x, y and z in the project's body axes, so that v_file = matrix @ v_project."""
    return tuple(_TOWARD[axis] for axis in axes)


def _right_handed(axes: tuple[Toward, Toward, Toward]) -> tuple[Toward, Toward, Toward]:
    (a, b, c), (d, e, f), (g, h, i) = body_axes_matrix(axes)
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) != 1:
        allowed = "three directions square to each other, z = x × y, as [forward, right, down]"
        raise Problem("no right-handed axes", names_text(axes), allowed)
    return axes


BodyAxes = Annotated[tuple[Toward, Toward, Toward], AfterValidator(_right_handed)]

TimeScale = Literal["UTC", "GPS", "TAI", "TT", "GAL", "QZS", "BDT"]
OrbitFrame = Literal["ITRS", "GCRS", "EME2000", "TEME"]
TurnFrame = Literal["ITRS", "GCRS", "EME2000", "TEME", "orbital"]
Sequence = Literal["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"]
Satellite = Annotated[str, Field(strict=True, min_length=1, max_length=100)]
ClockOffset = Annotated[float, Quantity(TIME, largest="1000 s")]
PointSigma = Annotated[float, Quantity(LENGTH, smallest="0 m", largest="10 km")]
AngleSigma = Annotated[float, Quantity(ANGLE, smallest="0 arcsec", largest="10 deg")]


def _reading(value: Any) -> str:
    """What a clock read at 0 s; its form is checked where it is used."""
    if not isinstance(value, str) or not 10 < len(value) < 40:
        allowed = "a date and time such as '2011-03-05T03:05:00', in the file's time scale"
        raise Problem("not a date and time", repr(value), allowed)
    return value


ClockReading = Annotated[str, BeforeValidator(_reading)]


class OrbitFileSpec(Spec):
    """An orbit in a file: SP3-c or d, CCSDS OEM, DIMAP, or CSV. What a file says itself may be left out here; else both
    agree.

    Attributes:
        file: path.
        satellite: which of the file's, where there are several.
        frame: axes of positions and velocities; inertial ones need Earth orientation.
        time_scale: what the clock shows.
        epoch: reading of that clock at 0 s, for tables with `time [s]`.
        leap_seconds: whether `time [s]` of a UTC clock counts those since its epoch; asked for where there are some.
        offset: seconds to be added to the times.
    """

    file: Reference
    satellite: Satellite | None = None
    frame: OrbitFrame | None = None
    time_scale: TimeScale | None = None
    epoch: ClockReading | None = None
    leap_seconds: Literal["counted", "skipped"] | None = None
    offset: ClockOffset = 0.0


class AttitudeFileSpec(Spec):
    """An attitude in a file: CCSDS AEM, DIMAP, or CSV of quaternions or of roll, pitch and yaw.

    Attributes:
        file: path.
        satellite: which of the file's, where there are several.
        frame: that the body is turned against; `orbital` has X forward, Z down, Y = Z x X.
        time_scale: what the clock shows.
        epoch: reading of that clock at 0 s, for tables with `time [s]`.
        leap_seconds: whether `time [s]` of a UTC clock counts those since its epoch; asked for where there are some.
        offset: seconds to be added to the times.
        scalar: where a quaternion's scalar part stands, the cosine of half the turn.
        turns: what the quaternion does to the components of a vector, v' = q v q*.
        body_axes: what x, y and z of the file's body point to in flight, as [forward, right, down].
        sequence: of roll about x, pitch about y, yaw about z: `xyz` means v_frame = Rx(roll) Ry(pitch) Rz(yaw) v_body.
        nadir, steering: of the orbital frame, as in `attitude` of a simulated pass.
    """

    file: Reference
    satellite: Satellite | None = None
    frame: TurnFrame | None = None
    time_scale: TimeScale | None = None
    epoch: ClockReading | None = None
    leap_seconds: Literal["counted", "skipped"] | None = None
    offset: ClockOffset = 0.0
    scalar: Literal["last", "first"] | None = None
    turns: Literal["body_to_frame", "frame_to_body"] | None = None
    body_axes: BodyAxes
    sequence: Sequence | None = None
    nadir: Literal["geodetic", "geocentric"] | None = None
    steering: Literal["none", "yaw"] | None = None


class PlatformFilesSpec(Spec):
    """Orbit and attitude of a pass from files.

    Attributes:
        orbit: its file.
        attitude: its file.
        earth_orientation: table of the IERS (finals2000A, C04) or CSV; for inertial frames.
        earth: what takes its place, of one moment.
    """

    orbit: OrbitFileSpec
    attitude: AttitudeFileSpec
    earth_orientation: Reference | None = None
    earth: EarthSpec | None = None

    @model_validator(mode="after")
    def _is_one_earth(self) -> "PlatformFilesSpec":
        if self.earth_orientation is not None and self.earth is not None:
            problem = "the Earth's orientation is given twice"
            raise Problem(problem, None, "either earth_orientation or earth", within=("earth",))
        return self


class _HeightsFileSpec(Spec):
    """A file with heights, and what they are above."""

    file: Reference
    crs: Text | None = None
    heights: Literal["ellipsoid", "geoid"] | None = None
    geoid: Reference | None = None

    @model_validator(mode="after")
    def _has_its_geoid(self) -> Self:
        if (self.heights == "geoid") != (self.geoid is not None):
            allowed = "heights: geoid with geoid: FILE, or heights: ellipsoid"
            raise Problem("heights and geoid do not fit", None, allowed, within=("heights",))
        return self


class GroundFileSpec(_HeightsFileSpec):
    """Ground points in a file: CSV, GeoJSON or .gcp of the Ames Stereo Pipeline.

    Attributes:
        file: path.
        crs: of the coordinates, as PROJ knows it: EPSG:4979 and EPSG:4978 say all, EPSG:4326 and EPSG:32650 need
            `heights`.
        heights: above the ellipsoid, or above the geoid of `geoid`.
        geoid: grid of heights of the geoid above the ellipsoid, GeoTIFF or GTX.
        sigma: of points that the file gives none for: east and north, and up, metres.
        sigma_axes: of the three sigmas of a .gcp: Earth-fixed x, y, z as that program takes them, or east, north, up.
    """

    sigma: tuple[PointSigma, PointSigma] | None = None
    sigma_axes: Literal["xyz", "enu"] = "xyz"


class RasterFileSpec(_HeightsFileSpec):
    """An orthophoto or an elevation model as GeoTIFF.

    Attributes:
        file: path.
        crs: of a file that does not say it.
        heights: of an elevation model, above the ellipsoid, or above the geoid of `geoid`.
        geoid: as for ground points.
        band: of the file that is read, counted from 1.
    """

    band: Annotated[Whole, Field(ge=1, le=1000)] = 1


FILE_KEYS = ("file", "geoid", "earth_orientation")
"""Keys that name files of measurements."""


def with_absolute_files(spec: SpecType, folder: Path | None = None) -> SpecType:
    """Make the paths of all files of measurements that a specification names absolute.

    Args:
        spec: as it was read.
        folder: that relative paths start from; None for that of the file it was read from.
    """
    place = Path(spec.source.file).parent if folder is None else folder
    changes: dict[str, Any] = {}
    for name in type(spec).model_fields:
        value = getattr(spec, name)
        if isinstance(value, Spec):
            changes[name] = with_absolute_files(value, place)
        elif isinstance(value, Mapping) and any(isinstance(one, Spec) for one in value.values()):
            changes[name] = FrozenMap({k: with_absolute_files(one, place) for k, one in value.items()})
        elif name in FILE_KEYS and isinstance(value, str):
            changes[name] = os.path.abspath(place / value)
    return spec.model_copy(update=changes)
