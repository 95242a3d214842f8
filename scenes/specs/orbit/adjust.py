"""Adjustment of a block of line images with everything that is known of its passes, as a file in scenes/orbit gives it.

The block is simulated from stated laws: the readings of orbit and attitude have errors that follow `truth` where it is
given, and what the adjustment is told of them in any case.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from scenes.specs.orbit.angle import Relief, TerrainHeight
from scenes.specs.orbit.calibration import CameraDriftSpec, FieldLength, MonitorReadingSpec
from scenes.specs.orbit.flight import (
    Altitude,
    AngleErrors,
    AttitudeSpec,
    EarthSpec,
    Frequency,
    Interval,
    Latitude,
    Longitude,
    PayloadTestSpec,
    UtcTime,
)
from scenes.specs.orbit.measurements import MeasuredTestSpec
from scenes.specs.orbit.scene import LineTime
from scenes.specs.procedures import SENSORS
from scenes.yaml.errors import Problem, unknown
from scenes.yaml.spec import Flag, Name, Named, Number, Reference, Seed, Spec, Whole, not_empty
from scenes.yaml.unit_fields import AngleSigmas, Quantity, Vector
from scenes.yaml.units import ANGLE, DISTANCE, LENGTH, MOMENT

Sensor = Literal["ties", "control", "monitor", "laser", "terrain", "tracker_angles"]
LawKind = Literal["constant", "rate", "white", "walk", "slow", "orbital", "jitter"]
Period = Annotated[float, Quantity(MOMENT, above_zero=True, largest="100000 h")]
Sigmas = Annotated[tuple[float, float, float], Vector(Quantity(LENGTH, smallest="0 m", largest="10 km"))]
Positive = Annotated[float, Quantity(LENGTH, above_zero=True, largest="1 km")]
PointCount = Annotated[Whole, Field(ge=0, le=1_000_000)]


class LawSpec(Spec):
    """How an error of readings behaves in time.

    Attributes
    ----------
    law : LawKind
        Constant; rate, of even growth from the middle of what shares it; white, readings independent of one another
        that a cubic spline joins; walk, a random walk that is zero in the middle; slow, a stationary process that
        forgets itself over `time`; orbital, cosine and sine of the period `time`; jitter, an oscillation of `frequency`
        whose amplitude and phase forget themselves over `time`.
    shared_by : Literal['pass', 'tracker', 'block']
        What has one draw of it: each pass, all passes of a star tracker, or the block.
    interval : Interval
        Between independent readings of `white`; between the values of `walk`, of `slow` and of the amplitudes of
        `jitter` that are solved for, seconds.
    time : Period | None
        Correlation time of `slow` and of the amplitudes of `jitter`, period of `orbital`, seconds.
    frequency : Frequency | None
        Of `jitter`, hertz.
    """

    law: LawKind
    shared_by: Literal["pass", "tracker", "block"] = "pass"
    interval: Interval = 1.0
    time: Period | None = None
    frequency: Frequency | None = None

    @model_validator(mode="after")
    def _has_its_time(self) -> LawSpec:
        if (self.time is None) == (self.law in ("slow", "orbital", "jitter")):
            named = {"slow": "a correlation time", "orbital": "a period", "jitter": "a correlation time"}
            what = named.get(self.law, "no `time:`")
            raise Problem(f"a {self.law} law has {what}", None, what, within=("time",))
        if (self.frequency is None) == (self.law == "jitter"):
            what = "a frequency" if self.law == "jitter" else "no `frequency:`"
            raise Problem(f"a {self.law} law has {what}", None, what, within=("frequency",))
        return self


class AttitudeLawSpec(LawSpec):
    """A law of errors of the attitude.

    Attributes
    ----------
    law
        How it behaves in time.
    shared_by
        What has one draw of it.
    interval
        Between independent readings, or between values that are solved for, seconds.
    time
        Correlation time or period, seconds.
    frequency
        Of `jitter`, hertz.
    sigma : AngleSigmas
        Standard deviation about body X, Y and Z, radians: of a constant, a reading, an amplitude, of jitter as a root
        mean square; of a rate in each second; of what a walk gains in a second.
    """

    sigma: AngleSigmas


class OrbitLawSpec(LawSpec):
    """A law of errors of the orbit.

    Attributes
    ----------
    law
        How it behaves in time.
    shared_by
        What has one draw of it.
    interval
        Between independent readings, or between values that are solved for, seconds.
    time
        Correlation time or period, seconds.
    frequency
        Of `jitter`, hertz.
    sigma : Sigmas
        Standard deviation along body X, Y and Z of the middle of the pass, metres, as for the attitude.
    """

    sigma: Sigmas


class ReadingLawsSpec(Spec):
    """Laws of the errors of the readings, by names that reports show.

    Attributes
    ----------
    attitude : Named[AttitudeLawSpec]
        Of the star trackers with their mounting.
    orbit : Named[OrbitLawSpec]
        Of the positions.
    """

    attitude: Annotated[Named[AttitudeLawSpec], not_empty("no laws of the attitude", "at least one")]
    orbit: Annotated[Named[OrbitLawSpec], not_empty("no laws of the orbit", "at least one")]

    @model_validator(mode="after")
    def _names_differ(self) -> ReadingLawsSpec:
        if both := set(self.attitude) & set(self.orbit):
            raise Problem("one name for two laws", min(both), "names that differ", within=("orbit", min(both)))
        return self


class TrackerAngleSpec(Spec):
    """A measured angle between two star trackers: the difference of what is constant in their errors.

    Attributes
    ----------
    between : tuple[Name, Name]
        The two.
    sigma : tuple[float, float, float]
        About body X, Y and Z, radians.
    """

    between: tuple[Name, Name]
    sigma: Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, above_zero=True, largest="1 deg"))]


class BlockPassSpec(Spec):
    """A pass over the block.

    Attributes
    ----------
    epoch : UtcTime
        UTC at which it passes vertically above a place.
    longitude, latitude : Longitude | None
        Of this place, radians; of the area's middle where not given.
    direction : Literal['descending', 'ascending']
        To the south or to the north.
    roll : float
        Of the satellite about body X, radians; positive looks to the left of the track, toward -Y.
    tracker : Name
        Star tracker that gives its attitude.
    """

    epoch: UtcTime
    longitude: Longitude | None = None
    latitude: Latitude | None = None
    direction: Literal["descending", "ascending"] = "descending"
    roll: Annotated[float, Quantity(ANGLE, largest="40 deg")] = 0.0
    tracker: Name = "tracker"


class AreaSpec(Spec):
    """Where the points lie.

    Attributes
    ----------
    longitude, latitude : Longitude
        Of its middle, radians.
    height : TerrainHeight
        Mean of the ground above the ellipsoid, metres.
    relief : Relief
        Heights lie evenly within this on either side of the mean, metres.
    east, north : FieldLength
        Its lengths, metres.
    """

    longitude: Longitude
    latitude: Latitude
    height: TerrainHeight = 0.0
    relief: Relief = 0.0
    east: FieldLength = 20e3
    north: FieldLength = 20e3


class BlockPointsSpec(Spec):
    """Points of the block at random places of the area; every scene that sees one observes it.

    Attributes
    ----------
    control : PointCount
        Points with known coordinates.
    tie : PointCount
        Points without.
    check : Whole
        Tie points whose coordinates are compared with the truth afterwards.
    image : Number
        Standard deviation of an image point in x and in y, pixels.
    control_sigma : tuple[float, float]
        Of each axis in plan, and of the height, of control points, metres.
    gross : Number
        Share of the tie points' image points that are wrong.
    gross_size : Number
        How far these are off, pixels.
    """

    control: PointCount = 10
    tie: PointCount = 300
    check: Annotated[Whole, Field(ge=2, le=100_000)] = 100
    image: Annotated[Number, Field(gt=0, le=10)] = 0.3
    control_sigma: Annotated[tuple[float, float], Vector(Quantity(LENGTH, above_zero=True, largest="1 km"), 2)] = (
        0.2,
        0.3,
    )
    gross: Annotated[Number, Field(ge=0, le=0.4)] = 0.0
    gross_size: Annotated[Number, Field(gt=0, le=1000)] = 30.0


class LaserSpec(Spec):
    """A laser altimeter that looks along body Z.

    Attributes
    ----------
    footprints : Whole
        Of each pass, evenly spaced over the area; the images see them, too.
    range : Positive
        Standard deviation of a range, metres.
    pointing : float
        Of the beam about body X and Y, radians.
    beam : float
        Full angle of the beam, radians; where in it the range is taken is not known.
    """

    footprints: Annotated[Whole, Field(ge=1, le=1000)] = 5
    range: Positive = 0.3
    pointing: Annotated[float, Quantity(ANGLE, above_zero=True, largest="1 deg")] = 5e-6
    beam: Annotated[float, Quantity(ANGLE, smallest="0 deg", largest="1 deg")] = 0.0


class TerrainModelSpec(Spec):
    """A terrain model as weak control of the heights of tie points.

    Attributes
    ----------
    sigma : Positive
        Of a height, independent from point to point, metres.
    common : float
        Of an error that all heights share, metres.
    """

    sigma: Positive = 4.0
    common: Annotated[float, Quantity(LENGTH, smallest="0 m", largest="1 km")] = 1.0


class CameraChangeSpec(Spec):
    """How a line camera may have changed since its calibration, one standard deviation.

    Attributes
    ----------
    lasting : CameraDriftSpec
        The same in all passes.
    each_pass : CameraDriftSpec
        Of each pass by itself.
    walk : CameraDriftSpec
        What it gains in a day, as a random walk from the first pass on.
    """

    lasting: CameraDriftSpec = CameraDriftSpec.model_construct()
    each_pass: CameraDriftSpec = CameraDriftSpec.model_construct()
    walk: CameraDriftSpec = CameraDriftSpec.model_construct()

    @model_validator(mode="after")
    def _may_change(self) -> CameraChangeSpec:
        both = (self.lasting, self.each_pass)
        for k, name in enumerate(("d_alpha", "d_beta", "d_gamma")):
            if not any(one.angles[k] for one in both):
                problem = f"{name} may not change at all, which no camera keeps"
                raise Problem(problem, None, "a sigma above zero in `lasting` or `each_pass`", within=("lasting",))
        if not any(one.principal_distance for one in both):
            problem = "the principal distance may not change at all, which no camera keeps"
            raise Problem(problem, None, "a sigma above zero in `lasting` or `each_pass`", within=("lasting",))
        return self


class MonitorRecordSpec(Spec):
    """A record of `twin.operate`, whose estimate says how the cameras stand in every pass.

    Attributes
    ----------
    record : Reference
        Its folder, or the URL of its database.
    plan : Reference | None
        File of the plan of operation under which it is followed; None for the plan that the record keeps.
    """

    record: Reference
    plan: Reference | None = None


def one_monitor(monitor: object, record: MonitorRecordSpec | None) -> None:
    """Refuse two monitors."""
    if monitor is not None and record is not None:
        raise Problem("`monitor` and `monitor_record` are both given", None, "one of them", within=("monitor_record",))


class OrbitAdjustSpec(PayloadTestSpec):
    """A block of scenes, adjusted at once.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera
        Name in scenes/library/payloads or path of a file.
    lines : tuple[Name, ...]
        Of the camera that take part; each is a scene of each pass.
    earth : EarthSpec
        Its rotation.
    altitude : Altitude
        Of the sun-synchronous orbit, metres.
    span : float
        How long the orbit is followed before and after each pass' epoch, seconds.
    line_time : LineTime
        From one image line to the next, seconds.
    attitude : AttitudeSpec
        True attitude, without the roll of the passes.
    area : AreaSpec
        Where the points lie.
    passes : Named[BlockPassSpec]
        By name.
    points : BlockPointsSpec
        And how well they are measured.
    errors : ReadingLawsSpec
        What is stated of the readings.
    truth : ReadingLawsSpec | None
        What the readings' errors follow in truth; None where they follow what is stated.
    angles : tuple[TrackerAngleSpec, ...]
        Between star trackers.
    changes : Named[CameraChangeSpec]
        Line -> how its camera may have changed.
    monitor : MonitorReadingSpec | None
        How well an on-board monitor reads these changes in each pass; None for no monitor.
    monitor_record : MonitorRecordSpec | None
        What a record of `twin.operate` says of them, in place of `monitor`; the true cameras are drawn from that.
    laser : LaserSpec | None
        An altimeter; None for none.
    terrain : TerrainModelSpec | None
        a terrain model; None for none.
    without : tuple[Sensor, ...]
        Sensors that are there and are not used.
    robust : Flag
        Whether gross errors are looked for.
    components : tuple[Name, ...]
        Laws and groups of measurements whose variances are estimated.
    datum : tuple[float, float, float]
        By which control points are given too far east, north and up, unknown to the analysis, metres.
    seed : Seed
        Of every random number.
    """

    lines: tuple[Name, ...] = ("forward", "nadir", "backward")
    earth: EarthSpec = EarthSpec.model_construct()
    altitude: Altitude = 500e3
    span: Annotated[float, Quantity(MOMENT, smallest="1 s", largest="1 h")] = 60.0
    line_time: LineTime = 0.7e-3
    attitude: AttitudeSpec = AttitudeSpec.model_construct(steering="yaw")
    area: AreaSpec
    passes: Annotated[Named[BlockPassSpec], not_empty("no passes", "at least one pass")]
    points: BlockPointsSpec = BlockPointsSpec.model_construct()
    errors: ReadingLawsSpec
    truth: ReadingLawsSpec | None = None
    angles: tuple[TrackerAngleSpec, ...] = ()
    changes: Annotated[Named[CameraChangeSpec], not_empty("no changes", "how each line may have changed")]
    monitor: MonitorReadingSpec | None = None
    monitor_record: MonitorRecordSpec | None = None
    laser: LaserSpec | None = None
    terrain: TerrainModelSpec | None = None
    without: tuple[Sensor, ...] = ()
    robust: Flag = True
    components: tuple[Name, ...] = ()
    datum: Annotated[tuple[float, float, float], Vector(Quantity(DISTANCE, largest="10 km"))] = (0.0, 0.0, 0.0)
    seed: Seed = 0

    @model_validator(mode="after")
    def _fits_together(self) -> OrbitAdjustSpec:
        if not self.lines or len(set(self.lines)) != len(self.lines):
            raise Problem("no lines, or one twice", None, "each line once", within=("lines",))
        for name in self.lines:
            if name not in self.changes:
                raise Problem(f"it is not said how {name} may have changed", None, f"`{name}:`", within=("changes",))
        for name in self.changes:
            if name not in self.lines:
                raise unknown("no such line among `lines`", name, self.lines, ("changes", name))
        one_monitor(self.monitor, self.monitor_record)
        trackers = tuple(dict.fromkeys(one.tracker for one in self.passes.values()))
        for k, angle in enumerate(self.angles):
            for j, name in enumerate(angle.between):
                if name not in trackers:
                    raise unknown("no such star tracker in the passes", name, trackers, ("angles", k, "between", j))
            if len(set(angle.between)) == 1:
                problem, place = "an angle of a star tracker with itself", ("angles", k, "between")
                raise Problem(problem, angle.between[0], "two star trackers", within=place)
        lasting = [one for one in self.errors.attitude.values() if (one.law, one.shared_by) == ("constant", "tracker")]
        if self.angles and not lasting:
            problem = "an angle between star trackers that have no constant error"
            raise Problem(
                problem, None, "a law `constant` of `shared_by: tracker` in errors.attitude", within=("angles",)
            )
        return self._has_known_groups()

    def _has_known_groups(self) -> OrbitAdjustSpec:
        groups = ("image", "control", "laser", "terrain", *self.errors.attitude, *self.errors.orbit)
        for k, name in enumerate(self.components):
            if name not in groups:
                raise unknown("no such group of variances", name, groups, ("components", k))
        return self

    @property
    def sensors(self) -> tuple[str, ...]:
        """Those of `SENSORS` that the block has."""
        has = {
            "ties": self.points.tie > 0,
            "control": self.points.control > 0,
            "monitor": self.monitor is not None or self.monitor_record is not None,
            "laser": self.laser is not None,
            "terrain": self.terrain is not None,
            "tracker_angles": bool(self.angles),
        }
        return tuple(name for name in SENSORS if has[name])


class CameraReadingSpec(Spec):
    """What a monitor reads of a line camera in a pass, against the state of its calibration.

    Attributes
    ----------
    angles : AngleErrors
        d_alpha (about the camera's Y), d_beta (about X) and d_gamma (about the line of sight), radians.
    principal_distance : float
        d_f, metres.
    """

    angles: AngleErrors
    principal_distance: Annotated[float, Quantity(LENGTH, largest="5 mm")] = 0.0


class MonitoredSpec(MonitorReadingSpec):
    """Readings of an on-board monitor, one of every line camera in every pass that it watched.

    Attributes
    ----------
    angles
        Standard deviation of d_alpha, d_beta and d_gamma, radians.
    principal_distance
        Of d_f, metres.
    readings : Named[Named[CameraReadingSpec]]
        Pass -> line -> what it read.
    """

    readings: Annotated[Named[Named[CameraReadingSpec]], not_empty("no readings", "at least one pass")]


class MeasuredAdjustSpec(MeasuredTestSpec):
    """A block of measured passes, adjusted at once.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    camera
        Name in scenes/library/payloads or path of a file: the camera as it was calibrated.
    data
        Folder with a ``data.yaml``, or the path of such a file; else `conventions` and `passes` stand here.
    conventions
        Of all tables.
    passes
        By name.
    effects
        On the light, that are in the image points; `corrected` takes them out.
    names : Literal['shared', 'own']
        Whether one name of a point in the tables of two passes is one point on the ground (shared), or names count
        within their pass (own).
    errors : ReadingLawsSpec
        Laws of the errors of orbit and attitude.
    trackers : Named[Name]
        Pass -> star tracker that gave its attitude; "tracker" where not said.
    changes : Named[CameraChangeSpec]
        Line -> how its camera may have changed since the calibration.
    monitor : MonitoredSpec | None
        Readings of these changes; None for no monitor.
    monitor_record : MonitorRecordSpec | None
        What a record of `twin.operate` says of them, in place of `monitor`.
    without : tuple[Literal['ties', 'control', 'monitor'], ...]
        Sensors that are there and are not used.
    robust : Flag
        Whether gross errors are looked for.
    components : tuple[Name, ...]
        Laws and groups of measurements whose variances are estimated.
    """

    names: Literal["shared", "own"]
    errors: ReadingLawsSpec
    trackers: Named[Name] = Field(default_factory=dict, validate_default=True)
    changes: Annotated[Named[CameraChangeSpec], not_empty("no changes", "how each line may have changed")]
    monitor: MonitoredSpec | None = None
    monitor_record: MonitorRecordSpec | None = None
    without: tuple[Literal["ties", "control", "monitor"], ...] = ()
    robust: Flag = True
    components: tuple[Name, ...] = ()

    @model_validator(mode="after")
    def _has_known_groups(self) -> MeasuredAdjustSpec:
        groups = ("image", "control", *self.errors.attitude, *self.errors.orbit)
        for k, name in enumerate(self.components):
            if name not in groups:
                raise unknown("no such group of variances", name, groups, ("components", k))
        one_monitor(self.monitor, self.monitor_record)
        if "monitor" in self.without and "monitor" not in self.sensors:
            raise Problem("no monitor to do without", None, "a section `monitor:`", within=("without",))
        return self

    @property
    def sensors(self) -> tuple[str, ...]:
        """What can be left out; whether there are points of a role is known when the tables are read."""
        watched = self.monitor is not None or self.monitor_record is not None
        return ("ties", "control", "monitor") if watched else ("ties", "control")
