"""Measurements of passes in files with explicit conventions, and the tests that use them.

For files in other formats, this specification adds the conventions that they do not contain. A convention with several
common choices has no default: a specification that does not state it is refused.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.number_tree import FrozenMap
from scenes.specs.orbit.angle import Angles, EffectsSpec, LightEffectsSpec, Moment
from scenes.specs.orbit.calibration import LaunchSpec, MapLimitsSpec
from scenes.specs.orbit.flight import EarthSpec, Interval, LengthSigmas, PayloadTestSpec, SlowErrorsSpec, UtcTime
from scenes.specs.orbit.jitter_search import JitterSearchSpec, LineNames
from scenes.specs.orbit.scene import ImagePointsSpec
from scenes.yaml.errors import KeyPath, Problem, names_text
from scenes.yaml.spec import Flag, Name, Named, Number, Reference, Spec, SpecType, Text, Whole, not_empty
from scenes.yaml.unit_fields import AngleSigmas, ClockReading, Quantity, TimeScale
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
"""Direction -> unit vector in the project's body axes: X forward, Y right, Z down."""


def body_axes_matrix(axes: tuple[str, str, str]) -> tuple[tuple[int, int, int], ...]:
    """Return the matrix that converts a vector's components from the project's body axes to those of a file.

    The project's body axes are X forward, Y right, Z down; the rows of the matrix are the file's body x, y and z in
    them.
    """
    return tuple(_TOWARD[axis] for axis in axes)


def _right_handed(axes: tuple[Toward, Toward, Toward]) -> tuple[Toward, Toward, Toward]:
    (a, b, c), (d, e, f), (g, h, i) = body_axes_matrix(axes)
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) != 1:
        allowed = "three perpendicular directions, z = x × y, as [forward, right, down]"
        raise Problem("axes that are not right-handed", names_text(axes), allowed)
    return axes


BodyAxes = Annotated[tuple[Toward, Toward, Toward], AfterValidator(_right_handed)]

OrbitFrame = Literal["ITRS", "GCRS", "EME2000", "TEME"]
RotationFrame = Literal["ITRS", "GCRS", "EME2000", "TEME", "orbital"]
Sequence = Literal["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"]
Satellite = Annotated[str, Field(strict=True, min_length=1, max_length=100)]
ClockOffset = Annotated[float, Quantity(TIME, largest="1000 s")]
PointSigma = Annotated[float, Quantity(LENGTH, smallest="0 m", largest="10 km")]
AngleSigma = Annotated[float, Quantity(ANGLE, smallest="0 arcsec", largest="10 deg")]


class OrbitFileSpec(Spec):
    """Orbit in a file: SP3-c or d, CCSDS OEM, DIMAP, or CSV.

    Keys that the file itself contains may be omitted; otherwise both must agree.

    Attributes
    ----------
    file : str
        Path of the file.
    satellite : str | None
        Satellite, if the file has several.
    frame : {'ITRS', 'GCRS', 'EME2000', 'TEME'} | None
        Reference frame of positions and velocities; inertial ones need Earth orientation.
    time_scale : {'UTC', 'GPS', 'TAI', 'TT', 'GAL', 'QZS', 'BDT'} | None
        Time scale of the times in the file.
    epoch : str | None
        Date and time, in that time scale, at which `time [s]` of a table is 0.
    leap_seconds : {'counted', 'skipped'} | None
        Treatment of leap seconds since the epoch in `time [s]` of a UTC clock; required if there are any.
    offset : float
        Time that is added to all times of the file, in seconds.
    """

    file: Reference
    satellite: Satellite | None = None
    frame: OrbitFrame | None = None
    time_scale: TimeScale | None = None
    epoch: ClockReading | None = None
    leap_seconds: Literal["counted", "skipped"] | None = None
    offset: ClockOffset = 0.0


class AttitudeFileSpec(Spec):
    """Attitude in a file: CCSDS AEM, DIMAP, or CSV of quaternions or of roll, pitch and yaw.

    Attributes
    ----------
    file : str
        Path of the file.
    satellite : str | None
        Satellite, if the file has several.
    frame : {'ITRS', 'GCRS', 'EME2000', 'TEME', 'orbital'} | None
        Reference frame of the attitude; `orbital` has X forward, Z down, Y = Z x X.
    time_scale : {'UTC', 'GPS', 'TAI', 'TT', 'GAL', 'QZS', 'BDT'} | None
        Time scale of the times in the file.
    epoch : str | None
        Date and time, in that time scale, at which `time [s]` of a table is 0.
    leap_seconds : {'counted', 'skipped'} | None
        Treatment of leap seconds since the epoch in `time [s]` of a UTC clock; required if there are any.
    offset : float
        Time that is added to all times of the file, in seconds.
    scalar : {'last', 'first'} | None
        Position of a quaternion's scalar part, the cosine of half the rotation angle.
    direction : {'body_to_frame', 'frame_to_body'} | None
        Sense of the quaternion q: v' = q v q* transforms the components of a vector v from body axes to the frame
        (`body_to_frame`), or from the frame to body axes (`frame_to_body`).
    body_axes : tuple[str, str, str]
        Directions of the file's body x, y and z in flight, as [forward, right, down].
    sequence : {'xyz', 'xzy', 'yxz', 'yzx', 'zxy', 'zyx'} | None
        Sequence of roll about x, pitch about y, yaw about z: `xyz` means v_frame = Rx(roll) Ry(pitch) Rz(yaw) v_body.
    nadir : {'geodetic', 'geocentric'} | None
        For the frame `orbital`, the direction of its Z: along the ellipsoid's normal (geodetic) or to the Earth's
        centre (geocentric).
    steering : {'none', 'yaw'} | None
        For the frame `orbital`, the direction of its X: along the inertial velocity (none), or along the track on the
        rotating Earth (yaw).
    """

    file: Reference
    satellite: Satellite | None = None
    frame: RotationFrame | None = None
    time_scale: TimeScale | None = None
    epoch: ClockReading | None = None
    leap_seconds: Literal["counted", "skipped"] | None = None
    offset: ClockOffset = 0.0
    scalar: Literal["last", "first"] | None = None
    direction: Literal["body_to_frame", "frame_to_body"] | None = None
    body_axes: BodyAxes
    sequence: Sequence | None = None
    nadir: Literal["geodetic", "geocentric"] | None = None
    steering: Literal["none", "yaw"] | None = None


class PlatformFilesSpec(Spec):
    """Orbit and attitude of a pass from files.

    Attributes
    ----------
    orbit : OrbitFileSpec
        File of the orbit.
    attitude : AttitudeFileSpec
        File of the attitude.
    earth_orientation : str | None
        Table of the IERS (finals2000A, C04) or CSV, for inertial frames.
    earth : EarthSpec | None
        Earth rotation parameters of one moment, instead of that table.
    """

    orbit: OrbitFileSpec
    attitude: AttitudeFileSpec
    earth_orientation: Reference | None = None
    earth: EarthSpec | None = None

    @model_validator(mode="after")
    def _is_one_earth(self) -> PlatformFilesSpec:
        if self.earth_orientation is not None and self.earth is not None:
            problem = "the Earth's orientation is given twice"
            raise Problem(problem, None, "either earth_orientation or earth", within=("earth",))
        return self


class _HeightsFileSpec(Spec):
    """Base of files with heights: the reference surface of the heights, and the geoid if it is one."""

    file: Reference
    crs: Text | None = None
    heights: Literal["ellipsoid", "geoid"] | None = None
    geoid: Reference | None = None

    @model_validator(mode="after")
    def _has_its_geoid(self) -> Self:
        if (self.heights == "geoid") != (self.geoid is not None):
            allowed = "heights: geoid with geoid: FILE, or heights: ellipsoid"
            raise Problem("heights and geoid do not fit together", None, allowed, within=("heights",))
        return self


class GroundFileSpec(_HeightsFileSpec):
    """Ground points in a file: CSV, GeoJSON or .gcp of the Ames Stereo Pipeline.

    Attributes
    ----------
    file
        Path of the file. docs/orbit_files.md, ground points, has its columns.
    crs
        Coordinate reference system, in PROJ's notation: EPSG:4979 and EPSG:4978 are complete, EPSG:4326 and EPSG:32650
        also need `heights`.
    heights
        Reference surface of the heights: the ellipsoid, or the geoid of `geoid`.
    geoid
        Grid of geoid heights above the ellipsoid, GeoTIFF or GTX.
    sigma : tuple[float, float] | None
        Standard deviations [east and north, up] of points for which the file has none, in metres.
    sigma_axes : {'xyz', 'enu'}
        Axes of the three sigmas of a .gcp: Earth-fixed x, y, z as that program uses them, or east, north, up.
    """

    sigma: tuple[PointSigma, PointSigma] | None = None
    sigma_axes: Literal["xyz", "enu"] = "xyz"


class RasterFileSpec(_HeightsFileSpec):
    """Orthophoto or elevation model as GeoTIFF.

    Attributes
    ----------
    file
        Path of the file.
    crs
        Coordinate reference system, for a file that does not contain it.
    heights
        Reference surface of an elevation model: the ellipsoid, or the geoid of `geoid`.
    geoid
        Grid of geoid heights above the ellipsoid, GeoTIFF or GTX.
    band : int
        Band of the file that is read, counted from 1.
    """

    band: Annotated[Whole, Field(ge=1, le=1000)] = 1


_FILE_NAMES = ("file", "geoid", "earth_orientation", "rpc")
"""Keys of specifications whose values are paths of files in other formats."""
FILE_KEYS = ("platform", "orbit", "attitude", "lines", "ground", "image_points", "tie_points")
"""Keys of a pass whose values are paths of its tables."""


def with_absolute_files(
    spec: SpecType, folder: Path | None = None, owner: Spec | None = None, key: KeyPath = ()
) -> SpecType:
    """Return a specification with absolute paths of all measurement files.

    Parameters
    ----------
    spec : SpecType
        Specification as read.
    folder : Path | None
        Folder from which relative paths start; None for that of the specification's file.
    owner : Spec | None
        Specification that contains it, if the files must exist.
    key : KeyPath
        Key path of the specification in the owner.

    Raises
    ------
    InputError
        A file that must exist is missing; reported at the owner's key.
    """
    base = Path(spec.source.file).parent if folder is None else folder
    changes: dict[str, Any] = {}
    for name in type(spec).model_fields:
        value, below = getattr(spec, name), (*key, name)
        if isinstance(value, Spec):
            changes[name] = with_absolute_files(value, base, owner, below)
        elif isinstance(value, Mapping) and any(isinstance(item, Spec) for item in value.values()):
            inner = {k: with_absolute_files(item, base, owner, (*below, k)) for k, item in value.items()}
            changes[name] = FrozenMap(inner)
        elif name in (*_FILE_NAMES, *FILE_KEYS) and isinstance(value, str):
            if owner is not None:
                owner.file_at(below, value, base, "a CSV file" if name in FILE_KEYS else "a file")
            changes[name] = os.path.abspath(base / value)
    return spec.model_copy(update=changes)


class QuaternionSpec(Spec):
    """Meaning of the four numbers q1, q2, q3, q4 of an attitude.

    Attributes
    ----------
    scalar : {'first', 'last'}
        Position of the scalar part (the cosine of half the rotation angle) among the four.
    direction : {'body_to_frame', 'frame_to_body'}
        Sense of the quaternion q: v' = q v q* transforms the components of a vector v from body axes to the frame
        (`body_to_frame`), or from the frame to body axes (`frame_to_body`).
    """

    scalar: Literal["first", "last"]
    direction: Literal["body_to_frame", "frame_to_body"]


class ConventionsSpec(Spec):
    """Conventions of the tables. All are required; quaternion and body axes only if a table has quaternions.

    Attributes
    ----------
    frame : 'itrs'
        Reference frame of positions, velocities and quaternions; velocities are relative to it. itrs is Earth-fixed
        (WGS 84, CGCS2000 and ITRF agree with it to some centimetres).
    quaternion : QuaternionSpec | None
        Order and sense of the quaternions in tables.
    body_axes : tuple[str, str, str] | None
        Directions of the quaternions' body x, y and z in flight, as [forward, right, down].
    time_scale : 'utc'
        Time scale of the epochs of the passes. Times in tables are SI seconds from them.
    line_moment : {'start', 'middle', 'end'}
        Moment of a line's exposure to which its time refers.
    centre : {'integer', 'half'}
        Image coordinate of the centre of pixel (or line) n: n, or n + 0.5.
    first_pixel : int
        Number of the first pixel of a line.
    first_pixel_sees : {'right', 'left'}
        Side of the track that the first pixel images.
    """

    frame: Literal["itrs"]
    quaternion: QuaternionSpec | None = None
    body_axes: BodyAxes | None = None
    time_scale: Literal["utc"]
    line_moment: Literal["start", "middle", "end"]
    centre: Literal["integer", "half"]
    first_pixel: Annotated[int, Field(strict=True, ge=0, le=1)]
    first_pixel_sees: Literal["right", "left"]


class PassFilesSpec(Spec):
    """Tables of a pass, CSV files with paths relative to the file that lists them.

    Attributes
    ----------
    epoch : str
        UTC at which the times of all tables of the pass are 0 s.
    platform : str | PlatformFilesSpec | None
        Orbit and attitude in one table, or files of other formats (SP3, OEM, AEM ...) with the conventions that they do
        not contain; alternatively `orbit` and `attitude`.
    orbit : str | None
        Table of time, x, y, z and optionally vx, vy, vz.
    attitude : str | None
        Table of time, q1, q2, q3, q4.
    lines : str
        Exposure times of the lines of each line camera.
    ground : str
        Ground points with coordinates, sigmas and roles.
    image_points : str
        Image coordinates of the ground points in the line cameras.
    tie_points : str | None
        Image coordinates of points without known coordinates; by default there are none.
    """

    epoch: UtcTime
    platform: Reference | PlatformFilesSpec | None = None
    orbit: Reference | None = None
    attitude: Reference | None = None
    lines: Reference
    ground: Reference
    image_points: Reference
    tie_points: Reference | None = None

    @model_validator(mode="after")
    def _has_a_platform(self) -> PassFilesSpec:
        separate = (self.orbit is not None, self.attitude is not None)
        if (self.platform is not None) == any(separate) or (any(separate) and not all(separate)):
            keys = [k for k in ("platform", "orbit", "attitude") if getattr(self, k) is not None]
            allowed = "`platform: FILE`, `platform:` with files of other formats, or `orbit: FILE` and `attitude: FILE`"
            raise Problem("orbit and attitude must be given once", " and ".join(keys) or "none of them", allowed)
        return self

    @property
    def files(self) -> dict[str, str]:
        """Key -> path of each table of the pass; files in other formats are not included."""
        files = {name: getattr(self, name) for name in FILE_KEYS}
        return {name: file for name, file in files.items() if isinstance(file, str)}


Passes = Annotated[Named[PassFilesSpec], not_empty("no passes", "at least one pass")]


class OrbitDataSpec(Spec):
    """Measurements of passes: ``data.yaml`` of a folder.

    Attributes
    ----------
    conventions : ConventionsSpec
        Conventions of all tables: frames, quaternions, times and image coordinates.
    passes : Mapping[str, PassFilesSpec]
        Name of the pass, or of the field over which it leads -> its tables.
    """

    conventions: ConventionsSpec
    passes: Passes


class OrbitReadingsSpec(Spec):
    """Accuracy of the orbit readings along X, Y and Z of the orbital frame.

    Attributes
    ----------
    noise : tuple[float, float, float]
        Standard deviation of a reading, independent from reading to reading, in metres.
    drift : tuple[float, float, float]
        Standard deviation of an error common to the whole pass, in metres.
    interval : float | None
        Interval between independent readings, in seconds; by default the median interval of the table.
    """

    noise: LengthSigmas
    drift: LengthSigmas = (0.0, 0.0, 0.0)
    interval: Interval | None = None


class AttitudeReadingsSpec(Spec):
    """Accuracy of the attitude readings about body X, Y and Z. Biases are estimated.

    Attributes
    ----------
    noise : tuple[float, float, float]
        Standard deviation of a reading, independent from reading to reading, in radians.
    slow : SlowErrorsSpec
        Errors that change within a pass.
    drift : tuple[float, float, float] | None
        Standard deviation of a constant rate in each pass, as the change in a second, in radians; zeros for no rate,
        and by default unknown.
    walk : tuple[float, float, float]
        Standard deviation of the increment of a random walk in a second, in radians.
    interval : float | None
        Interval between independent readings, in seconds; by default the median interval of the table.
    """

    noise: AngleSigmas
    slow: SlowErrorsSpec = SlowErrorsSpec.model_construct()
    drift: AngleSigmas | None = None
    walk: AngleSigmas = (0.0, 0.0, 0.0)
    interval: Interval | None = None


class ReadingErrorsSpec(Spec):
    """Standard deviations of the orbit and attitude readings; those of points are in their tables.

    Attributes
    ----------
    gps : OrbitReadingsSpec
        Accuracy of the measured orbit.
    star_tracker : AttitudeReadingsSpec
        Accuracy of the measured attitude.
    season : tuple[float, float, float]
        Standard deviation of the change of biases from pass to pass about body X, Y, Z, in radians; used for warnings
        only.
    """

    gps: OrbitReadingsSpec
    star_tracker: AttitudeReadingsSpec
    season: AngleSigmas = (0.0, 0.0, 0.0)

    @property
    def switched_on(self) -> bool:
        """True: real measurements always have errors; a simulation may switch them off."""
        return True

    @property
    def datum(self) -> tuple[float, float, float]:
        """Common shift of the control points that a simulation may have, in metres; zero for real measurements."""
        return (0.0, 0.0, 0.0)


class FixedTestSpec(PayloadTestSpec):
    """Base of tests of a payload that use no random numbers."""

    @property
    def seed(self) -> int:
        """Seed of random numbers, without effect because the test uses none."""
        return 0


class MeasuredTestSpec(FixedTestSpec):
    """Base of all tests on measurements.

    Attributes
    ----------
    camera
        Payload as calibrated in the laboratory: a name in scenes/library/payloads, or the path of your file.
    data : str | None
        Folder with a ``data.yaml``, or the path of such a file; alternatively `conventions` and `passes` are given
        here.
    conventions : ConventionsSpec | None
        Conventions of all tables: frames, quaternions, times and image coordinates.
    passes : Mapping[str, PassFilesSpec] | None
        Name -> tables of a pass.
    effects : EffectsSpec
        Effects on the light path that the image points contain; `corrected` makes the analysis correct them.
    """

    data: Reference | None = None
    conventions: ConventionsSpec | None = None
    passes: Passes | None = None
    effects: EffectsSpec = EffectsSpec.model_construct()

    @model_validator(mode="before")
    @classmethod
    def _check_sources(cls, value: Any) -> Any:
        if isinstance(value, Mapping):
            here = [key for key in ("conventions", "passes") if value.get(key) is not None]
            if ("data" in value) == bool(here) or len(here) == 1:
                actual = names_text([*(["data"] if "data" in value else []), *here]) or "none of them"
                allowed = "`data: DIR`, or `conventions:` and `passes:`"
                raise Problem("the measurements must be given in exactly one way", actual, allowed, within=("data",))
        return value


class MeasuredCalibrationSpec(MeasuredTestSpec):
    """In-orbit calibration from measured passes.

    Attributes
    ----------
    schemes : tuple[tuple[str, ...], ...]
        Schemes: each is a list of passes whose parameters are averaged; the program adds a scheme in which each pass
        uses its own parameters.
    errors : ReadingErrorsSpec
        Accuracy of the readings of orbit and attitude.
    screening : {'robust', 'none'}
        Treatment of image points: `robust` weights with rejection of gross errors, or `none`.
    ties : {'with_control', 'apart'}
        Use of tie points: `with_control`, they calibrate together with the control points; `apart`, they only serve the
        strip adjustment.
    strip : bool
        True to adjust every pass on its tie points before check points are intersected.
    launch : LaunchSpec
        Prior standard deviations of the changes due to the launch.
    limits : MapLimitsSpec
        Largest RMS errors for the verdict.
    """

    schemes: tuple[tuple[Name, ...], ...]
    errors: ReadingErrorsSpec
    screening: Literal["robust", "none"] = "robust"
    ties: Literal["with_control", "apart"] = "with_control"
    strip: Flag = False
    launch: LaunchSpec = LaunchSpec.model_construct()
    limits: MapLimitsSpec = MapLimitsSpec.model_construct()


class MeasuredAngleSpec(MeasuredTestSpec):
    """Intersection angles from measured ground points that the lines image at one moment.

    Attributes
    ----------
    angles : Mapping[str, tuple[str, str]] | None
        Name -> the two lines between which the angle lies; by default alpha [forward, nadir] and beta [nadir, backward]
        if the camera has these lines, or alpha between the lines of a camera with two.
    time : float | None
        Time from the pass's epoch, in seconds; by default the middle of the image points of each line.
    errors : ReadingErrorsSpec
        Accuracy of the readings of orbit and attitude.
    """

    angles: Angles = None
    time: Moment | None = None
    errors: ReadingErrorsSpec

    @model_validator(mode="after")
    def _knows_these_errors(self) -> MeasuredAngleSpec:
        tracker = self.errors.star_tracker
        if any(tracker.drift or ()) or any(tracker.walk):
            problem = "the evaluation of angles has no model of a drift or a walk of the attitude"
            raise Problem(problem, None, "`slow:`", within=("errors", "star_tracker"))
        return self


class MeasuredJitterSpec(MeasuredTestSpec):
    """Search for jitter by measured points that several lines of a pass observed.

    Attributes
    ----------
    lines : tuple[str, ...] | None
        Names of the lines that are used; by default all that have points.
    search : JitterSearchSpec
        Settings of the search: frequencies, axes, false-alarm probability and models.
    """

    lines: LineNames = None
    search: JitterSearchSpec


class LineTimesFileSpec(Spec):
    """Exposure times of lines: a table of camera, line and time.

    Attributes
    ----------
    file : str
        Path of a CSV file with columns `camera`, `line` and `time [s]` or `date_time`; or of the DIMAP file of a scene,
        for a camera of one line.
    time_scale : {'UTC', 'GPS', 'TAI', 'TT', 'GAL', 'QZS', 'BDT'}
        Time scale of the times in the file.
    epoch : str | None
        Date and time, in that time scale, at which `time [s]` of a table is 0.
    moment : {'start', 'middle', 'end'}
        Moment of a line's exposure to which its time refers.
    """

    file: Reference
    time_scale: TimeScale
    epoch: ClockReading | None = None
    moment: Literal["start", "middle", "end"]


class ImagePointsFileSpec(Spec):
    """Image coordinates of ground points: a table of point, camera, line, pixel and their sigmas.

    Attributes
    ----------
    file : str
        Path of a CSV file with columns `point`, `camera`, `line`, `pixel`, `line_sigma`, `pixel_sigma` and optionally
        `correlation`; or of the .gcp of the Ames Stereo Pipeline with the ground points, whose images are named as the
        lines, `nadir.tif`.
    centre : {'integer', 'half'}
        Image coordinate of the centre of pixel (or line) n: n, or n + 0.5.
    first_pixel : int
        Number of the first pixel of a line.
    first_pixel_sees : {'right', 'left'}
        Side of the track that the first pixel images.
    """

    file: Reference
    centre: Literal["integer", "half"]
    first_pixel: Annotated[Whole, Field(ge=0, le=1)]
    first_pixel_sees: Literal["right", "left"]


class UncertaintySpec(Spec):
    """Uncertainty of camera and platform, as standard deviations; a large one can hide a wrong convention.

    Attributes
    ----------
    attitude : float
        Standard deviation of the measured attitude including the camera's mounting, about each axis, in radians.
    position : float
        Standard deviation of the orbit along each axis, in metres.
    interior : float
        Standard deviation of each line's position in the focal plane, along and across the line, in pixels.
    scale : float
        Relative standard deviation of each line's principal distance.
    time : float
        Standard deviation of the line times relative to those of orbit and attitude, in seconds.
    """

    attitude: AngleSigma = 3e-4
    position: PointSigma = 10.0
    interior: Annotated[Number, Field(ge=0.0, le=10_000.0)] = 20.0
    scale: Annotated[Number, Field(ge=0.0, le=0.1)] = 1e-4
    time: Annotated[float, Quantity(TIME, smallest="0 s", largest="100 s")] = 1e-3


class OrbitCheckSpec(FixedTestSpec):
    """Check of the conventions of a pass in files.

    Attributes
    ----------
    camera
        Payload as calibrated in the laboratory: a name in scenes/library/payloads, or the path of your file.
    platform : PlatformFilesSpec
        Files of orbit and attitude.
    lines : LineTimesFileSpec
        File of the exposure times of the lines.
    ground : GroundFileSpec
        File of the ground points.
    image_points : ImagePointsFileSpec
        File of their image coordinates.
    effects : LightEffectsSpec
        Effects on the light path between ground and camera.
    uncertainty : UncertaintySpec
        Uncertainty of camera and platform.
    points : int
        Largest number of points of each line that are used.
    """

    platform: PlatformFilesSpec
    lines: LineTimesFileSpec
    ground: GroundFileSpec
    image_points: ImagePointsFileSpec
    effects: LightEffectsSpec = LightEffectsSpec.model_construct()
    uncertainty: UncertaintySpec = UncertaintySpec.model_construct()
    points: Annotated[Whole, Field(ge=4, le=1000)] = 60


class ImageWindowSpec(Spec):
    """Window of an image.

    Attributes
    ----------
    row : int
        Row, in the file, of the window's first pixel, counted from 0.
    column : int
        Column, in the file, of the window's first pixel, counted from 0.
    rows : int
        Number of rows of the window.
    columns : int
        Number of columns of the window.
    """

    row: Annotated[Whole, Field(ge=0)]
    column: Annotated[Whole, Field(ge=0)]
    rows: Annotated[Whole, Field(ge=32, le=50_000)]
    columns: Annotated[Whole, Field(ge=32, le=50_000)]


class LineImageFileSpec(Spec):
    """Image of a line in a file.

    Attributes
    ----------
    file : str
        Path of a TIFF; a georeference in it is not used.
    band : int
        Band that is read, counted from 1.
    first_line : int
        Number, in the table of times, of the image's first row.
    first_pixel : int
        Pixel of the line, counted from 0, of the image's first column.
    first_pixel_sees : str
        Side of the track that the first column images: right or left.
    window : ImageWindowSpec | None
        Window that is matched; by default the whole image.
    """

    file: Reference
    band: Annotated[Whole, Field(ge=1, le=1000)] = 1
    first_line: Annotated[Whole, Field(ge=0)] = 0
    first_pixel: Annotated[Whole, Field(ge=0)] = 0
    first_pixel_sees: Annotated[str, Field(pattern="^(right|left)$")]
    window: ImageWindowSpec | None = None


class OrbitMatchSpec(FixedTestSpec):
    """Measurement of points of an orthophoto, and of tie points, in line images by matching.

    Attributes
    ----------
    name
        Name of the test, and of the pass in exported files.
    camera
        Payload as calibrated in the laboratory: a name in scenes/library/payloads, or the path of your file.
    platform : PlatformFilesSpec
        Files of orbit and attitude.
    lines : LineTimesFileSpec
        File of the exposure times of the lines.
    images : Mapping[str, LineImageFileSpec]
        Line -> its image.
    orthophoto : RasterFileSpec
        Orthophoto of the ground.
    dem : RasterFileSpec
        Elevation model of the ground.
    control_sigma : tuple[float, float]
        Standard deviations of points of the orthophoto with their heights, [each axis in plan, height], in metres.
    effects : LightEffectsSpec
        Effects on the light path between ground and camera.
    points : ImagePointsSpec
        Number of points and settings of the matching.
    """

    platform: PlatformFilesSpec
    lines: LineTimesFileSpec
    images: Annotated[Named[LineImageFileSpec], not_empty("no images", "one line of the camera or more")]
    orthophoto: RasterFileSpec
    dem: RasterFileSpec
    control_sigma: tuple[PointSigma, PointSigma]
    effects: LightEffectsSpec = LightEffectsSpec.model_construct()
    points: ImagePointsSpec
