"""Measurements of passes as files give them, with every convention stated, and the tests that run on them.

Files of other people's formats stand here with what they themselves do not say of their numbers. Nothing has a default
where two readings are usual: a file that does not say which one it means is refused.
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
from scenes.specs.orbit.jitter_search import JitterSearchSpec, SomeLines
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

OrbitFrame = Literal["ITRS", "GCRS", "EME2000", "TEME"]
TurnFrame = Literal["ITRS", "GCRS", "EME2000", "TEME", "orbital"]
Sequence = Literal["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"]
Satellite = Annotated[str, Field(strict=True, min_length=1, max_length=100)]
ClockOffset = Annotated[float, Quantity(TIME, largest="1000 s")]
PointSigma = Annotated[float, Quantity(LENGTH, smallest="0 m", largest="10 km")]
AngleSigma = Annotated[float, Quantity(ANGLE, smallest="0 arcsec", largest="10 deg")]


class OrbitFileSpec(Spec):
    """An orbit in a file: SP3-c or d, CCSDS OEM, DIMAP, or CSV. What a file says itself may be left out here; else both
    agree.

    Attributes
    ----------
    file : Reference
        path.
    satellite : Satellite | None
        Which of the file's, where there are several.
    frame : OrbitFrame | None
        Axes of positions and velocities; inertial ones need Earth orientation.
    time_scale : TimeScale | None
        What the clock shows.
    epoch : ClockReading | None
        Reading of that clock at 0 s, for tables with `time [s]`.
    leap_seconds : Literal['counted', 'skipped'] | None
        Whether `time [s]` of a UTC clock counts those since its epoch; asked for where there are some.
    offset : ClockOffset
        Seconds to be added to the times.
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

    Attributes
    ----------
    file : Reference
        path.
    satellite : Satellite | None
        Which of the file's, where there are several.
    frame : TurnFrame | None
        That the body is turned against; `orbital` has X forward, Z down, Y = Z x X.
    time_scale : TimeScale | None
        What the clock shows.
    epoch : ClockReading | None
        Reading of that clock at 0 s, for tables with `time [s]`.
    leap_seconds : Literal['counted', 'skipped'] | None
        Whether `time [s]` of a UTC clock counts those since its epoch; asked for where there are some.
    offset : ClockOffset
        Seconds to be added to the times.
    scalar : Literal['last', 'first'] | None
        Where a quaternion's scalar part stands, the cosine of half the turn.
    turns : Literal['body_to_frame', 'frame_to_body'] | None
        What the quaternion does to the components of a vector, v' = q v q*.
    body_axes : BodyAxes
        What x, y and z of the file's body point to in flight, as [forward, right, down].
    sequence : Sequence | None
        Of roll about x, pitch about y, yaw about z: `xyz` means v_frame = Rx(roll) Ry(pitch) Rz(yaw) v_body.
    nadir, steering : Literal['geodetic', 'geocentric'] | None
        Of the orbital frame, as in `attitude` of a simulated pass.
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

    Attributes
    ----------
    orbit : OrbitFileSpec
        Its file.
    attitude : AttitudeFileSpec
        Its file.
    earth_orientation : Reference | None
        Table of the IERS (finals2000A, C04) or CSV; for inertial frames.
    earth : EarthSpec | None
        What takes its place, of one moment.
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

    Attributes
    ----------
    file
        path.
    crs
        Of the coordinates, as PROJ knows it: EPSG:4979 and EPSG:4978 say all, EPSG:4326 and EPSG:32650 need `heights`.
    heights
        Above the ellipsoid, or above the geoid of `geoid`.
    geoid
        Grid of heights of the geoid above the ellipsoid, GeoTIFF or GTX.
    sigma : tuple[PointSigma, PointSigma] | None
        Of points that the file gives none for: east and north, and up, metres.
    sigma_axes : Literal['xyz', 'enu']
        Of the three sigmas of a .gcp: Earth-fixed x, y, z as that program takes them, or east, north, up.
    """

    sigma: tuple[PointSigma, PointSigma] | None = None
    sigma_axes: Literal["xyz", "enu"] = "xyz"


class RasterFileSpec(_HeightsFileSpec):
    """An orthophoto or an elevation model as GeoTIFF.

    Attributes
    ----------
    file
        path.
    crs
        Of a file that does not say it.
    heights
        Of an elevation model, above the ellipsoid, or above the geoid of `geoid`.
    geoid
        As for ground points.
    band : Whole
        Of the file that is read, counted from 1.
    """

    band: Annotated[Whole, Field(ge=1, le=1000)] = 1


_FILE_NAMES = ("file", "geoid", "earth_orientation")
"""Keys that name files of other people's formats."""
FILE_KEYS = ("platform", "orbit", "attitude", "lines", "ground", "image_points", "tie_points")
"""Keys of a pass that name its tables."""


def with_absolute_files(
    spec: SpecType, folder: Path | None = None, owner: Spec | None = None, key: KeyPath = ()
) -> SpecType:
    """Make the paths of all files of measurements that a specification names absolute.

    Parameters
    ----------
    spec : SpecType
        As it was read.
    folder : Path | None
        That relative paths start from; None for that of the file it was read from.
    owner : Spec | None
        In which it stands, if the files have to be there.
    key : KeyPath
        Where it stands there.

    Raises
    ------
    InputError
        a file that has to be there is not, told at the owner's key.
    """
    place = Path(spec.source.file).parent if folder is None else folder
    changes: dict[str, Any] = {}
    for name in type(spec).model_fields:
        value, below = getattr(spec, name), (*key, name)
        if isinstance(value, Spec):
            changes[name] = with_absolute_files(value, place, owner, below)
        elif isinstance(value, Mapping) and any(isinstance(one, Spec) for one in value.values()):
            inner = {k: with_absolute_files(one, place, owner, (*below, k)) for k, one in value.items()}
            changes[name] = FrozenMap(inner)
        elif name in (*_FILE_NAMES, *FILE_KEYS) and isinstance(value, str):
            if owner is not None:
                owner.file_at(below, value, place, "a CSV file" if name in FILE_KEYS else "a file")
            changes[name] = os.path.abspath(place / value)
    return spec.model_copy(update=changes)


class QuaternionSpec(Spec):
    """What the four numbers q1, q2, q3, q4 of an attitude mean.

    Attributes
    ----------
    scalar : Literal['first', 'last']
        Whether the scalar part (the cosine of half the turn) is the first or the last of the four.
    turns : Literal['body_to_frame', 'frame_to_body']
        What the quaternion does to the components of a vector, v' = q v q*: from body axes into those of the frame, or
        the other way.
    """

    scalar: Literal["first", "last"]
    turns: Literal["body_to_frame", "frame_to_body"]


class ConventionsSpec(Spec):
    """How the numbers of the tables are to be read. All must be said; quaternion and body axes where a table
    holds quaternions.

    Attributes
    ----------
    frame : Literal['itrs']
        Axes of positions, velocities and quaternions; velocities are those against these axes. itrs is Earth-fixed (WGS
        84, CGCS2000 and ITRF agree with it to some centimetres).
    quaternion : QuaternionSpec | None
        Order and sense; of tables.
    body_axes : BodyAxes | None
        What x, y and z of the quaternions' body point to in flight, as [forward, right, down].
    time_scale : Literal['utc']
        In which the epochs of the passes are written. Times in tables are SI seconds from them.
    line_moment : Literal['start', 'middle', 'end']
        Which moment of its exposure the time of a line is.
    centre : Literal['integer', 'half']
        Image coordinates of the middle of pixel (or line) n: n, or n + 0.5.
    first_pixel : int
        Number of the first pixel of a line.
    first_pixel_sees : Literal['right', 'left']
        To which side of the track the first pixel looks.
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
    """The tables of a pass, CSV; paths are relative to the file that names them.

    Attributes
    ----------
    epoch : UtcTime
        Of the times in all tables.
    platform : Reference | PlatformFilesSpec | None
        Orbit and attitude in one table, or files of other formats (SP3, OEM, AEM ...) with what they do not say
        themselves; or each in its own table:
    orbit : Reference | None
        Time, x, y, z and perhaps vx, vy, vz.
    attitude : Reference | None
        Time, q1, q2, q3, q4.
    lines : Reference
        When the lines of each line camera were exposed.
    ground : Reference
        Points on the ground, with coordinates, sigmas and roles.
    image_points : Reference
        Where the line cameras see them.
    tie_points : Reference | None
        Likewise, of points without known coordinates; None for none.
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
        apart = (self.orbit is not None, self.attitude is not None)
        if (self.platform is not None) == any(apart) or (any(apart) and not all(apart)):
            given = [k for k in ("platform", "orbit", "attitude") if getattr(self, k) is not None]
            allowed = "`platform: FILE`, `platform:` with files of other formats, or `orbit: FILE` and `attitude: FILE`"
            raise Problem("orbit and attitude are not given once", " and ".join(given) or "none of them", allowed)
        return self

    @property
    def files(self) -> dict[str, str]:
        """Key -> what it names, for all that are given; without files of other formats."""
        found = {name: getattr(self, name) for name in FILE_KEYS}
        return {name: file for name, file in found.items() if isinstance(file, str)}


Passes = Annotated[Named[PassFilesSpec], not_empty("no passes", "at least one pass")]


class OrbitDataSpec(Spec):
    """Measurements of passes: ``data.yaml`` of a folder.

    Attributes
    ----------
    conventions : ConventionsSpec
        Of all tables.
    passes : Passes
        By name, of the pass or of the field that it passes.
    """

    conventions: ConventionsSpec
    passes: Passes


class OrbitReadingsSpec(Spec):
    """What is known of the errors of the orbit's readings, along X, Y and Z of the orbital frame.

    Attributes
    ----------
    noise : LengthSigmas
        Standard deviation of a reading, independent from reading to reading, metres.
    drift : LengthSigmas
        Standard deviation of what the whole pass has in common, metres.
    interval : Interval | None
        Between readings that are independent, seconds; None for the median of the table.
    """

    noise: LengthSigmas
    drift: LengthSigmas = (0.0, 0.0, 0.0)
    interval: Interval | None = None


class AttitudeReadingsSpec(Spec):
    """What is known of the errors of the attitude's readings, about X, Y and Z of the body. Biases are solved for.

    Attributes
    ----------
    noise : AngleSigmas
        Standard deviation of a reading, independent from reading to reading, radians.
    slow : SlowErrorsSpec
        What changes within a pass.
    drift : AngleSigmas | None
        Standard deviation of the rate of each pass, by what it changes in a second, radians; zeros where there is none,
        None where nobody knows.
    walk : AngleSigmas
        Standard deviation of what a random walk gains in a second, radians.
    interval : Interval | None
        Between readings that are independent, seconds; None for the median of the table.
    """

    noise: AngleSigmas
    slow: SlowErrorsSpec = SlowErrorsSpec.model_construct()
    drift: AngleSigmas | None = None
    walk: AngleSigmas = (0.0, 0.0, 0.0)
    interval: Interval | None = None


class ReadingErrorsSpec(Spec):
    """Standard deviations of the readings; those of points stand in their tables.

    Attributes
    ----------
    gps : OrbitReadingsSpec
        Of the orbit.
    star_tracker : AttitudeReadingsSpec
        Of the attitude.
    season : AngleSigmas
        By how much biases may differ from pass to pass about body X, Y, Z, radians; used for warnings only.
    """

    gps: OrbitReadingsSpec
    star_tracker: AttitudeReadingsSpec
    season: AngleSigmas = (0.0, 0.0, 0.0)

    @property
    def switched_on(self) -> bool:
        """Measurements have errors."""
        return True

    @property
    def datum(self) -> tuple[float, float, float]:
        """A wrong datum of which the analysis knew would not be one."""
        return (0.0, 0.0, 0.0)


class FixedTestSpec(PayloadTestSpec):
    """A test of a payload in which nothing is drawn."""

    @property
    def seed(self) -> int:
        """Any: nothing is drawn."""
        return 0


class MeasuredTestSpec(FixedTestSpec):
    """What all tests on measurements say.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera
        Name in scenes/library/payloads or path of a file: the camera as the laboratory knows it.
    data : Reference | None
        Folder with a ``data.yaml``, or the path of such a file; else `conventions` and `passes` stand here.
    conventions : ConventionsSpec | None
        Of all tables.
    passes : Passes | None
        By name.
    effects : EffectsSpec
        On the light, that are in the image points; `corrected` takes them out.
    """

    data: Reference | None = None
    conventions: ConventionsSpec | None = None
    passes: Passes | None = None
    effects: EffectsSpec = EffectsSpec.model_construct()

    @model_validator(mode="before")
    @classmethod
    def _says_where_the_data_are(cls, value: Any) -> Any:
        if isinstance(value, Mapping):
            here = [key for key in ("conventions", "passes") if value.get(key) is not None]
            if ("data" in value) == bool(here) or len(here) == 1:
                found = names_text([*(["data"] if "data" in value else []), *here]) or "none of them"
                allowed = "`data: DIR`, or `conventions:` and `passes:`"
                raise Problem("where the measurements are is not said once", found, allowed, within=("data",))
        return value


class MeasuredCalibrationSpec(MeasuredTestSpec):
    """A calibration on measured passes.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera
        Name in scenes/library/payloads or path of a file: the camera as the laboratory knows it.
    data
        Folder with a ``data.yaml``, or the path of such a file; else `conventions` and `passes` stand here.
    conventions
        Of all tables.
    passes
        By name.
    effects
        On the light, that are in the image points; `corrected` takes them out.
    schemes : tuple[tuple[Name, ...], ...]
        Passes whose parameters are averaged; each by itself is added.
    errors : ReadingErrorsSpec
        Of the readings of orbit and attitude.
    screening : Literal['robust', 'none']
        Whether image points are given robust weights and those with gross errors left out.
    ties : Literal['with_control', 'apart']
        Whether tie points calibrate together with the control points, or are kept apart for the strips.
    strip : Flag
        Whether every pass is adjusted on its tie points before check points are intersected.
    launch : LaunchSpec
        How much of a change is no surprise.
    limits : MapLimitsSpec
        For the verdict.
    """

    schemes: tuple[tuple[Name, ...], ...]
    errors: ReadingErrorsSpec
    screening: Literal["robust", "none"] = "robust"
    ties: Literal["with_control", "apart"] = "with_control"
    strip: Flag = False
    launch: LaunchSpec = LaunchSpec.model_construct()
    limits: MapLimitsSpec = MapLimitsSpec.model_construct()


class MeasuredAngleSpec(MeasuredTestSpec):
    """Intersection angles from the ground points that the lines of one moment see.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera
        Name in scenes/library/payloads or path of a file: the camera as the laboratory knows it.
    data
        Folder with a ``data.yaml``, or the path of such a file; else `conventions` and `passes` stand here.
    conventions
        Of all tables.
    passes
        By name.
    effects
        On the light, that are in the image points; `corrected` takes them out.
    angles : Angles
        Name -> the two lines that the angle lies between; None for the usual ones.
    time : Moment | None
        The moment, seconds from the pass's epoch; None for the middle of the image points of each line.
    errors : ReadingErrorsSpec
        Of the readings of orbit and attitude.
    """

    angles: Angles = None
    time: Moment | None = None
    errors: ReadingErrorsSpec

    @model_validator(mode="after")
    def _knows_these_errors(self) -> MeasuredAngleSpec:
        tracker = self.errors.star_tracker
        if any(tracker.drift or ()) or any(tracker.walk):
            problem = "angles know of readings and slow errors of the attitude, not of a drift or a walk"
            raise Problem(problem, None, "`slow:`", within=("errors", "star_tracker"))
        return self


class MeasuredJitterSpec(MeasuredTestSpec):
    """A search for jitter in points that several lines of a pass saw.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera
        Name in scenes/library/payloads or path of a file: the camera as the laboratory knows it.
    data
        Folder with a ``data.yaml``, or the path of such a file; else `conventions` and `passes` stand here.
    conventions
        Of all tables.
    passes
        By name.
    effects
        On the light, that are in the image points; `corrected` takes them out.
    lines : SomeLines
        That are used, by name; None for all that have points.
    search : JitterSearchSpec
        How jitter is sought.
    """

    lines: SomeLines = None
    search: JitterSearchSpec


class LineTimesFileSpec(Spec):
    """When lines were exposed: a table of camera, line and time.

    Attributes
    ----------
    file : Reference
        Path, CSV with columns `camera`, `line` and `time [s]` or `date_time`; or the DIMAP file of a scene, for a
        camera of one line.
    time_scale : TimeScale
        Of the clock.
    epoch : ClockReading | None
        Reading of that clock at 0 s, for tables with `time [s]`.
    moment : Literal['start', 'middle', 'end']
        Which moment of its exposure a line's time is.
    """

    file: Reference
    time_scale: TimeScale
    epoch: ClockReading | None = None
    moment: Literal["start", "middle", "end"]


class ImagePointsFileSpec(Spec):
    """Where lines see ground points: a table of point, camera, line, pixel and their sigmas.

    Attributes
    ----------
    file : Reference
        Path, CSV with columns `point`, `camera`, `line`, `pixel`, `line_sigma`, `pixel_sigma` and perhaps
        `correlation`; or the .gcp of the Ames Stereo Pipeline that is the file of the ground points, with images that
        are called as the lines, `nadir.tif`.
    centre : Literal['integer', 'half']
        Image coordinates of the middle of pixel (or line) n: n, or n + 0.5.
    first_pixel : Whole
        Number of the first pixel of a line.
    first_pixel_sees : Literal['right', 'left']
        To which side of the track the first pixel looks.
    """

    file: Reference
    centre: Literal["integer", "half"]
    first_pixel: Annotated[Whole, Field(ge=0, le=1)]
    first_pixel_sees: Literal["right", "left"]


class UncertaintySpec(Spec):
    """How wrong camera and platform may be, standard deviations: what hides a convention, if it is large enough.

    Attributes
    ----------
    attitude : AngleSigma
        Of the measured attitude with the camera's mounting, about each axis.
    position : PointSigma
        Of the orbit, along each axis.
    interior : Number
        Of each line's place in the focal plane, pixels along and across it.
    scale : Number
        Of each line's principal distance, relative.
    time : float
        Of the line times against those of orbit and attitude.
    """

    attitude: AngleSigma = 3e-4
    position: PointSigma = 10.0
    interior: Annotated[Number, Field(ge=0.0, le=10_000.0)] = 20.0
    scale: Annotated[Number, Field(ge=0.0, le=0.1)] = 1e-4
    time: Annotated[float, Quantity(TIME, smallest="0 s", largest="100 s")] = 1e-3


class OrbitCheckSpec(FixedTestSpec):
    """A check of the conventions of a pass in files.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera
        Name in scenes/library/payloads or path of a file: the camera as the laboratory knows it.
    platform : PlatformFilesSpec
        Orbit and attitude.
    lines : LineTimesFileSpec
        Times of the lines.
    ground : GroundFileSpec
        Points on the ground.
    image_points : ImagePointsFileSpec
        Where the lines see them.
    effects : LightEffectsSpec
        What happens to the light between ground and camera.
    uncertainty : UncertaintySpec
        How wrong camera and platform may be.
    points : Whole
        Most of each line that are used.
    shown : Whole
        Places of points that are printed for each reading.
    """

    platform: PlatformFilesSpec
    lines: LineTimesFileSpec
    ground: GroundFileSpec
    image_points: ImagePointsFileSpec
    effects: LightEffectsSpec = LightEffectsSpec.model_construct()
    uncertainty: UncertaintySpec = UncertaintySpec.model_construct()
    points: Annotated[Whole, Field(ge=4, le=1000)] = 60
    shown: Annotated[Whole, Field(ge=1, le=20)] = 3


class ImageWindowSpec(Spec):
    """A part of an image.

    Attributes
    ----------
    row, column : Whole
        Of the file, of its first pixel, counted from 0.
    rows, columns : Whole
        Its size.
    """

    row: Annotated[Whole, Field(ge=0)]
    column: Annotated[Whole, Field(ge=0)]
    rows: Annotated[Whole, Field(ge=32, le=50_000)]
    columns: Annotated[Whole, Field(ge=32, le=50_000)]


class LineImageFileSpec(Spec):
    """A line's image in a file.

    Attributes
    ----------
    file : Reference
        Path, TIFF; a georeference in it is not used.
    band : Whole
        That is read, counted from 1.
    first_line : Whole
        Number, in the table of times, of the image's first row.
    first_pixel : Whole
        Pixel of the line, counted from 0, of the image's first column.
    first_pixel_sees : str
        To which side of the track the first column looks.
    window : ImageWindowSpec | None
        Part that is matched; None for all.
    """

    file: Reference
    band: Annotated[Whole, Field(ge=1, le=1000)] = 1
    first_line: Annotated[Whole, Field(ge=0)] = 0
    first_pixel: Annotated[Whole, Field(ge=0)] = 0
    first_pixel_sees: Annotated[str, Field(pattern="^(right|left)$")]
    window: ImageWindowSpec | None = None


class OrbitMatchSpec(FixedTestSpec):
    """Points of an orthophoto, and tie points, sought in line images.

    Attributes
    ----------
    name
        As the file is called; also of the pass in what is exported.
    description
        For people.
    camera
        Name in scenes/library/payloads or path of a file: the camera as the laboratory knows it.
    platform : PlatformFilesSpec
        Orbit and attitude.
    lines : LineTimesFileSpec
        Times of the lines.
    images : Named[LineImageFileSpec]
        Line -> its image.
    orthophoto : RasterFileSpec
        Of the ground.
    dem : RasterFileSpec
        Of the ground.
    control_sigma : tuple[PointSigma, PointSigma]
        Of places of the orthophoto with their heights: in plan, each axis, and in height, metres.
    effects : LightEffectsSpec
        What happens to the light between ground and camera.
    points : ImagePointsSpec
        How many, and how they are matched.
    """

    platform: PlatformFilesSpec
    lines: LineTimesFileSpec
    images: Annotated[Named[LineImageFileSpec], not_empty("no images", "one line of the camera or more")]
    orthophoto: RasterFileSpec
    dem: RasterFileSpec
    control_sigma: tuple[PointSigma, PointSigma]
    effects: LightEffectsSpec = LightEffectsSpec.model_construct()
    points: ImagePointsSpec
