"""Bundle adjustment of a block of line images with all sensors of its passes, as in a file of scenes/orbit.

The block is simulated from specified laws: the errors of the orbit and attitude readings follow `truth` if it is given,
else `errors`; the adjustment always assumes `errors`.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from scenes.specs.orbit import flight
from scenes.specs.orbit.angle import Relief, TerrainHeight
from scenes.specs.orbit.calibration import CameraDriftSpec, FieldLength, MonitorReadingSpec
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
Positive = Annotated[float, Quantity(LENGTH, above_zero=True, largest="1 km")]
PointCount = Annotated[Whole, Field(ge=0, le=1_000_000)]


class LawSpec(Spec):
    """Time law of an error of readings.

    Attributes
    ----------
    law : {'constant', 'rate', 'white', 'walk', 'slow', 'orbital', 'jitter'}
        Law: constant; rate, a linear growth from the middle of its validity; white, independent readings that a cubic
        spline interpolates; walk, a random walk that is zero in the middle; slow, a stationary process with the
        correlation time `time`; orbital, cosine and sine of the period `time`; jitter, an oscillation of `frequency`
        whose amplitude and phase have the correlation time `time`.
    shared_by : {'pass', 'tracker', 'block'}
        Extent over which the error has one random realisation: each pass (`pass`), all passes of a star tracker
        (`tracker`), or the whole block (`block`).
    interval : float
        Interval between independent readings of `white`, or between the estimated values of `walk`, of `slow` and of
        the amplitudes of `jitter`, in seconds.
    time : float | None
        Correlation time of `slow` and of the amplitudes of `jitter`, or period of `orbital`, in seconds.
    frequency : float | None
        Frequency of `jitter`, in hertz.
    """

    law: LawKind
    shared_by: Literal["pass", "tracker", "block"] = "pass"
    interval: flight.Interval = 1.0
    time: Period | None = None
    frequency: flight.Frequency | None = None

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
    """Time law of an error of the attitude.

    Attributes
    ----------
    sigma : tuple[float, float, float]
        Standard deviation about body X, Y and Z, in radians. Its meaning depends on the law: of the constant, of a
        reading, or of an amplitude; for `jitter` the root mean square of the oscillation; for `rate` the change in a
        second; for `walk` the increment in a second.
    """

    sigma: AngleSigmas


class OrbitLawSpec(LawSpec):
    """Time law of an error of the orbit.

    Attributes
    ----------
    sigma : tuple[float, float, float]
        Standard deviation along body X, Y and Z at the middle of the pass, in metres; its meaning depends on the law:
        of the constant, of a reading, or of an amplitude; for `rate` the change in a second; for `walk` the increment
        in a second.
    """

    sigma: flight.LengthSigmas


class ReadingLawsSpec(Spec):
    """Time laws of the errors of orbit and attitude readings; reports show their names.

    Attributes
    ----------
    attitude : Mapping[str, AttitudeLawSpec]
        Name -> law of the star trackers including their mounting.
    orbit : Mapping[str, OrbitLawSpec]
        Name -> law of the positions.
    """

    attitude: Annotated[Named[AttitudeLawSpec], not_empty("no laws of the attitude", "at least one")]
    orbit: Annotated[Named[OrbitLawSpec], not_empty("no laws of the orbit", "at least one")]

    @model_validator(mode="after")
    def _names_differ(self) -> ReadingLawsSpec:
        if both := set(self.attitude) & set(self.orbit):
            raise Problem("one name for two laws", min(both), "names that differ", within=("orbit", min(both)))
        return self


class TrackerAngleSpec(Spec):
    """Measured relative orientation of two star trackers, which determines the difference of their constant errors.

    Attributes
    ----------
    between : tuple[str, str]
        Names of the two star trackers.
    sigma : tuple[float, float, float]
        Standard deviation of the measured rotation about body X, Y and Z, in radians.
    """

    between: tuple[Name, Name]
    sigma: Annotated[tuple[float, float, float], Vector(Quantity(ANGLE, above_zero=True, largest="1 deg"))]


class BlockPassSpec(Spec):
    """Pass over the block.

    Attributes
    ----------
    epoch : str
        UTC at which the satellite is vertically above the place that `longitude` and `latitude` give.
    longitude : float | None
        Longitude of the place over which the satellite is at the epoch, in radians; east is positive. By default that
        of the area's centre.
    latitude : float | None
        Geodetic latitude of that place, in radians; north is positive. By default that of the area's centre.
    direction : {'descending', 'ascending'}
        Direction of flight: descending to the south, ascending to the north.
    roll : float
        Roll of the satellite about body X, in radians; positive looks to the left of the track, toward -Y.
    tracker : str
        Name of the star tracker that measures the attitude.
    """

    epoch: flight.UtcTime
    longitude: flight.Longitude | None = None
    latitude: flight.Latitude | None = None
    direction: Literal["descending", "ascending"] = "descending"
    roll: Annotated[float, Quantity(ANGLE, largest="40 deg")] = 0.0
    tracker: Name = "tracker"


class AreaSpec(Spec):
    """Area in which the points lie.

    Attributes
    ----------
    longitude : float
        Longitude of the area's centre, in radians; east is positive.
    latitude : float
        Geodetic latitude of the area's centre, in radians; north is positive.
    height : float
        Mean height of the ground above the ellipsoid, in metres.
    relief : float
        Half range of the heights, which are uniformly distributed about the mean, in metres.
    east : float
        Size of the area from west to east, in metres.
    north : float
        Size of the area from south to north, in metres.
    """

    longitude: flight.Longitude
    latitude: flight.Latitude
    height: TerrainHeight = 0.0
    relief: Relief = 0.0
    east: FieldLength = 20e3
    north: FieldLength = 20e3


class BlockPointsSpec(Spec):
    """Points of the block at random positions in the area. Every scene that covers a point observes it.

    Attributes
    ----------
    control : int
        Number of control points, whose coordinates are known.
    tie : int
        Number of tie points, whose coordinates are unknown.
    check : int
        Number of tie points whose adjusted coordinates are compared with the truth.
    image : float
        Standard deviation of an image point in x and in y, in pixels.
    control_sigma : tuple[float, float]
        Standard deviations of control points, [each axis in plan, height], in metres.
    gross : float
        Fraction of the tie points' image points with gross errors.
    gross_size : float
        Size of the gross errors, in pixels.
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
    """Laser altimeter along body Z.

    Attributes
    ----------
    footprints : int
        Number of footprints in each pass, evenly spaced over the area; they are also observed in the images.
    range : float
        Standard deviation of a range, in metres.
    pointing : float
        Standard deviation of the beam's direction about body X and Y, in radians.
    beam : float
        Full divergence of the beam, in radians; the direction within it to which the range belongs is unknown.
    """

    footprints: Annotated[Whole, Field(ge=1, le=1000)] = 5
    range: Positive = 0.3
    pointing: Annotated[float, Quantity(ANGLE, above_zero=True, largest="1 deg")] = 5e-6
    beam: Annotated[float, Quantity(ANGLE, smallest="0 deg", largest="1 deg")] = 0.0


class TerrainModelSpec(Spec):
    """Terrain model as weak control of the heights of tie points.

    Attributes
    ----------
    sigma : float
        Standard deviation of a height, independent from point to point, in metres.
    common : float
        Standard deviation of an error that all heights share, in metres.
    """

    sigma: Positive = 4.0
    common: Annotated[float, Quantity(LENGTH, smallest="0 m", largest="1 km")] = 1.0


class CameraChangeSpec(Spec):
    """Change of a line camera since its calibration, as standard deviations.

    Attributes
    ----------
    lasting : CameraDriftSpec
        Change that is the same in all passes.
    each_pass : CameraDriftSpec
        Change that is independent in each pass.
    walk : CameraDriftSpec
        Increment in a day of a random walk from the first pass on.
    """

    lasting: CameraDriftSpec = CameraDriftSpec.model_construct()
    each_pass: CameraDriftSpec = CameraDriftSpec.model_construct()
    walk: CameraDriftSpec = CameraDriftSpec.model_construct()

    @model_validator(mode="after")
    def _may_change(self) -> CameraChangeSpec:
        both = (self.lasting, self.each_pass)
        for k, name in enumerate(("d_alpha", "d_beta", "d_gamma", "the principal distance")):
            if not any((*change.angles, change.principal_distance)[k] for change in both):
                problem = f"{name} has a prior sigma of zero, which is not realistic"
                raise Problem(problem, None, "a sigma above zero in `lasting` or `each_pass`", within=("lasting",))
        return self


class MonitorRecordSpec(Spec):
    """Record of `twin.operate`, whose estimate gives the state of the cameras in every pass.

    Attributes
    ----------
    record : str
        Folder of the record, or URL of its database.
    plan : str | None
        File of the plan of operation for the estimate; by default the plan stored in the record.
    """

    record: Reference
    plan: Reference | None = None


def check_one_monitor(monitor: object, record: MonitorRecordSpec | None) -> None:
    """Raise `Problem` if a file has both `monitor` and `monitor_record`, two sources of the same changes."""
    if monitor is not None and record is not None:
        raise Problem("`monitor` and `monitor_record` are both given", None, "one of them", within=("monitor_record",))


def _require_groups(spec: OrbitAdjustSpec | MeasuredAdjustSpec, groups: tuple[str, ...]) -> None:
    """Raise `Problem` for a component of variance that is neither among these groups nor a law of the readings."""
    known = (*groups, *spec.errors.attitude, *spec.errors.orbit)
    for k, name in enumerate(spec.components):
        if name not in known:
            raise unknown("no such group of variances", name, known, ("components", k))


class OrbitAdjustSpec(flight.PayloadTestSpec):
    """Bundle adjustment of a simulated block of scenes.

    Attributes
    ----------
    lines : tuple[str, ...]
        Lines of the camera that take part; each one gives a scene in each pass.
    earth : EarthSpec
        Earth rotation.
    altitude : float
        Altitude of the sun-synchronous orbit, in metres.
    span : float
        Half duration of the orbit data about each pass' epoch, in seconds.
    line_time : float
        Time from one image line to the next, in seconds.
    attitude : AttitudeSpec
        True attitude without the roll of the passes.
    area : AreaSpec
        Area in which the points lie.
    passes : Mapping[str, BlockPassSpec]
        Name -> pass.
    points : BlockPointsSpec
        Points and their accuracies.
    errors : ReadingLawsSpec
        Time laws of the reading errors that the adjustment assumes.
    truth : ReadingLawsSpec | None
        Time laws of the true reading errors; by default those of `errors`.
    angles : tuple[TrackerAngleSpec, ...]
        Measured angles between star trackers.
    changes : Mapping[str, CameraChangeSpec]
        Line -> change of its camera since the calibration.
    monitor : MonitorReadingSpec | None
        Accuracy of an on-board monitor that measures these changes in each pass; by default there is no monitor.
    monitor_record : MonitorRecordSpec | None
        Record of `twin.operate` with an estimate of these changes, instead of `monitor`; the true cameras are drawn
        from the estimate.
    laser : LaserSpec | None
        Laser altimeter; by default there is none.
    terrain : TerrainModelSpec | None
        Terrain model; by default there is none.
    without : tuple[{'ties', 'control', 'monitor', 'laser', 'terrain', 'tracker_angles'}, ...]
        Sensors that the file has but the adjustment does not use.
    robust : bool
        True to detect gross errors.
    components : tuple[str, ...]
        Names of laws and groups of measurements whose variance components are estimated.
    datum : tuple[float, float, float]
        Common error of the control points to the east, north and up, unknown to the analysis, in metres.
    seed : int
        Seed of all random numbers.
    """

    lines: tuple[Name, ...] = ("forward", "nadir", "backward")
    earth: flight.EarthSpec = flight.EarthSpec.model_construct()
    altitude: flight.Altitude = 500e3
    span: Annotated[float, Quantity(MOMENT, smallest="1 s", largest="1 h")] = 60.0
    line_time: LineTime = 0.7e-3
    attitude: flight.AttitudeSpec = flight.AttitudeSpec.model_construct(steering="yaw")
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
            raise Problem("no lines, or a repeated line", None, "each line once", within=("lines",))
        for name in self.lines:
            if name not in self.changes:
                raise Problem(f"no change of {name} is given", None, f"`{name}:`", within=("changes",))
        for name in self.changes:
            if name not in self.lines:
                raise unknown("no such line among `lines`", name, self.lines, ("changes", name))
        check_one_monitor(self.monitor, self.monitor_record)
        trackers = tuple(dict.fromkeys(item.tracker for item in self.passes.values()))
        for k, angle in enumerate(self.angles):
            for j, name in enumerate(angle.between):
                if name not in trackers:
                    raise unknown("no such star tracker in the passes", name, trackers, ("angles", k, "between", j))
            if len(set(angle.between)) == 1:
                problem, key = "an angle of a star tracker with itself", ("angles", k, "between")
                raise Problem(problem, angle.between[0], "two star trackers", within=key)
        lasting = [
            item for item in self.errors.attitude.values() if (item.law, item.shared_by) == ("constant", "tracker")
        ]
        if self.angles and not lasting:
            problem = "an angle between star trackers that have no constant error"
            allowed = "an entry of errors.attitude with `law: constant` and `shared_by: tracker`"
            raise Problem(problem, None, allowed, within=("angles",))
        _require_groups(self, ("image", "control", "laser", "terrain"))
        return self

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names in `SENSORS` of the sensors that the block has, such as `laser`."""
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
    """Monitor reading of a line camera in a pass, relative to the state of its calibration.

    Attributes
    ----------
    angles : tuple[float, float, float]
        Rotations d_alpha (about the camera's Y), d_beta (about X) and d_gamma (about the line of sight), in radians.
    principal_distance : float
        Change d_f of the principal distance, in metres.
    """

    angles: flight.AngleErrors
    principal_distance: Annotated[float, Quantity(LENGTH, largest="5 mm")] = 0.0


class MonitoredSpec(MonitorReadingSpec):
    """Readings of an on-board monitor, one for every line camera and pass that it covers.

    Attributes
    ----------
    angles
        Standard deviations of the rotations d_alpha (about the camera's Y), d_beta (about X) and d_gamma (about the
        line of sight), in radians.
    principal_distance
        Standard deviation of the change d_f of the principal distance, in metres.
    readings : Mapping[str, Mapping[str, CameraReadingSpec]]
        Pass -> line -> reading.
    """

    readings: Annotated[Named[Named[CameraReadingSpec]], not_empty("no readings", "at least one pass")]


class MeasuredAdjustSpec(MeasuredTestSpec):
    """Bundle adjustment of a block of measured passes.

    Attributes
    ----------
    camera
        Payload as calibrated: a name in scenes/library/payloads, or the path of your file.
    names : {'shared', 'own'}
        Meaning of point names: `shared`, one name in the tables of two passes is one point on the ground; `own`, a name
        is valid within its pass.
    errors : ReadingLawsSpec
        Time laws of the errors of orbit and attitude.
    trackers : Mapping[str, str]
        Pass -> star tracker that measured its attitude; by default "tracker".
    changes : Mapping[str, CameraChangeSpec]
        Line -> change of its camera since the calibration.
    monitor : MonitoredSpec | None
        Readings of these changes by an on-board monitor; by default there is no monitor.
    monitor_record : MonitorRecordSpec | None
        Record of `twin.operate` with an estimate of these changes, instead of `monitor`.
    without : tuple[{'ties', 'control', 'monitor'}, ...]
        Sensors that the data have but the adjustment does not use.
    robust : bool
        True to detect gross errors.
    components : tuple[str, ...]
        Names of laws and groups of measurements whose variance components are estimated.
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
        _require_groups(self, ("image", "control"))
        check_one_monitor(self.monitor, self.monitor_record)
        if "monitor" in self.without and "monitor" not in self.sensors:
            raise Problem("there is no monitor to exclude", None, "a section `monitor:`", within=("without",))
        return self

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that can be excluded.

        Whether the tables have tie points or control points is known only when they are read.
        """
        watched = self.monitor is not None or self.monitor_record is not None
        return ("ties", "control", "monitor") if watched else ("ties", "control")
