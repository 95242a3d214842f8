"""On-board monitoring and its benefit on the ground (papers 001, 000, 003).

The cameras of a stereo pair move along an orbit; they are monitored at an interval, or in a closed loop with
mechanisms; ground points are intersected without control.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.array_math import index_of_value
from optics.numerics.number_tree import FrozenMap
from scenes.specs.course import CourseSpec, Moment, Rotation, Shift, moment, no_such_time
from scenes.specs.disturbances import JobDisturbances, component_parts
from scenes.specs.job import AnalysisSpec, JobSpec, PerturbationSpec, RenderSpec, checked_nodes
from scenes.specs.orbit.angle import Relief, TerrainHeight, check_ends
from scenes.specs.orbit.calibration import Count, FieldLength
from scenes.specs.orbit.flight import AttitudeSpec, EarthSpec, ErrorsSpec, OrbitSpec
from scenes.specs.orbit.scene import LineTime
from scenes.specs.perturbation import NodeInfo, PlainPerturbationSpec, perturbation_issues
from scenes.yaml.errors import InputError, KeyPath, Problem, shown
from scenes.yaml.spec import Flag, Name, Named, NothingIsEmpty, Number, Paths, Ref, Seed, Spec, Text, TitledSpec, Whole
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.units import ANGLE, LENGTH, MOMENT, Kind, parse_quantity

_EVEN = 1e-6
"""Largest difference of time steps that count as equal, in seconds."""
_WHOLE = 1e-9
"""Tolerance, as a fraction of a step, for rounding a range to whole steps."""
_KINDS: dict[str, Kind] = {"rotate": ANGLE, "shift": LENGTH}
"""Kind of a mechanism's motion -> kind of quantity of its steps and range."""
_QUANTITIES: dict[str, Kind] = {"d_alpha": ANGLE, "d_beta": ANGLE, "d_gamma": ANGLE, "d_f": LENGTH, "defocus": LENGTH}

Span = Annotated[float, Quantity(MOMENT, smallest="0 s", largest="100000 h")]
Interval = Annotated[float, Quantity(MOMENT, above_zero=True, largest="100000 h")]
Frames = Annotated[Whole, Field(ge=1, le=1000)]
Repeats = Annotated[Whole, Field(ge=8, le=500)]
Parameter = Literal["d_alpha", "d_beta", "d_gamma", "d_f"]
PARAMETERS: tuple[Parameter, ...] = ("d_alpha", "d_beta", "d_gamma", "d_f")
"""Names of the changes of a camera that the monitor measures: three rotations and the principal distance."""


def _once(names: tuple[Parameter, ...]) -> tuple[Parameter, ...]:
    if not names:
        raise Problem("nothing is corrected", "an empty list", "at least one of d_alpha, d_beta, d_gamma, d_f")
    return tuple(dict.fromkeys(names))


class MotionSpec(Spec):
    """Motion of a body along the orbit from other causes than the temperatures of the model, such as its mounts.

    Attributes
    ----------
    rotate : tuple[float, float, float]
        Rotation vector in the body's frame about the pivot, in radians; the rotation precedes the shift.
    shift : tuple[float, float, float]
        Shift in the body's frame, in metres.
    pivot : str
        Name of the body's point that the rotation leaves in place.
    begin : float
        Time from the orbit's epoch at which the motion starts, in seconds.
    duration : float
        Duration of the linear growth to `rotate` and `shift`, in seconds; 0 for a step.
    period : float | None
        Period of an oscillation `rotate` x sin(2 pi (t - begin)/period) at all times t, instead of `duration`, in
        seconds.
    """

    rotate: Rotation = (0.0, 0.0, 0.0)
    shift: Shift = (0.0, 0.0, 0.0)
    pivot: Name = "origin"
    begin: Moment = 0.0
    duration: Span = 0.0
    period: Interval | None = None

    @model_validator(mode="after")
    def _is_a_motion(self) -> "MotionSpec":
        if not (any(self.rotate) or any(self.shift)):
            raise Problem("nothing moves", None, "rotate, shift or both")
        if self.period is not None and self.duration:
            raise Problem("both a ramp and an oscillation", None, "either duration or period", within=("period",))
        return self

    def share(self, time: float) -> float:
        """Return the fraction of `rotate` and `shift` that the motion has reached at a time in seconds."""
        passed = time - self.begin
        if self.period is not None:
            return math.sin(2.0 * math.pi * passed / self.period)
        if self.duration:
            return min(max(passed / self.duration, 0.0), 1.0)
        return float(passed >= 0.0)

    @property
    def full_motion(self) -> PlainPerturbationSpec:
        """Motion at its full amount, as a perturbation of the body."""
        return PlainPerturbationSpec.model_construct(rotate=self.rotate, shift=self.shift, pivot=self.pivot)


class GroundSpec(Spec):
    """Check points at every time of the course, at random positions that both lines image.

    The area is centred where one camera of the pair images the ground as long before that time as the other after it.

    Attributes
    ----------
    points : int
        Number of points at every time.
    first : float
        First pixel of the part of the second camera's line on which the points lie, counted from 0.
    last : float
        Last pixel of this part of the line, counted from 0.
    length : float
        Length of the area along the track, in metres.
    height : float
        Mean height above the ellipsoid, in metres.
    relief : float
        Half range of the heights, which are uniformly distributed about the mean, in metres.
    """

    points: Annotated[Count, Field(ge=2)] = 60
    first: Number
    last: Number
    length: FieldLength = 20e3
    height: TerrainHeight = 0.0
    relief: Relief = 0.0

    @model_validator(mode="after")
    def _has_width(self) -> "GroundSpec":
        check_ends(self.first, self.last, "the strip has no width")
        return self


class MonitorErrorsSpec(ErrorsSpec):
    """Measurement errors; orbit and attitude are exact by default.

    The monitor does not detect attitude errors that both cameras share.

    Attributes
    ----------
    image : float
        Standard deviation of an image point along and across the line, in pixels.
    monitor : bool
        True for noise in the monitor's frames; false for expected images without noise or rounding.
    switched_on : bool
        False for exact image points, orbit and attitude, and monitor frames without noise.
    """

    image: Annotated[Number, Field(ge=0, le=10)] = 0.3
    monitor: Flag = True
    switched_on: Flag = True


class CorrectionSpec(Spec):
    """Correction of one estimated quantity of a camera, in a closed loop.

    At every reading the command changes by `gain` times the estimated remaining error of the quantity, divided by the
    response of the quantity to the mechanism. The estimate is that of the estimator `posterior`.

    Attributes
    ----------
    camera : str
        Camera to which the quantity belongs.
    quantity : {'d_alpha', 'd_beta', 'd_gamma', 'd_f', 'defocus'}
        Quantity: `d_alpha`, `d_beta`, `d_gamma`, `d_f`, or `defocus`, best focus minus line CCD.
    mechanism : str | None
        Motion of a body that corrects the quantity, as text without amount: `forward/focal_plane shift z`. By default
        the line of sight is corrected in the image processing on the ground, and no body moves.
    gain : float
        Fraction of the remaining error that one reading corrects.
    delay : int
        Number of readings until a command takes effect; 0 for immediately, before the images of that time.
    step : str | None
        Step of the mechanism, with unit; by default any amount is possible.
    range : str | None
        Range of the mechanism to either side of its initial position, with unit; unlimited by default.
    dead_band : str | None
        Dead band: smaller remaining errors are not corrected; in the quantity's unit. Zero by default.
    response : float
        True response of the mechanism relative to the nominal one; the estimate does not know it.
    """

    camera: Name
    quantity: Literal["d_alpha", "d_beta", "d_gamma", "d_f", "defocus"]
    mechanism: Text | None = None
    gain: Annotated[Number, Field(ge=0.0, le=4.0)]
    delay: Annotated[Whole, Field(ge=0, le=20)] = 0
    step: Text | None = None
    range: Text | None = None
    dead_band: Text | None = None
    response: Annotated[Number, Field(gt=0.0, le=4.0)] = 1.0

    @model_validator(mode="after")
    def _can_be(self) -> "CorrectionSpec":
        if self.mechanism is None and self.quantity == "defocus":
            allowed = "mechanism: the motion of a body, as forward/focal_plane shift z"
            raise Problem("image processing cannot correct the focus", "no mechanism", allowed, within=("quantity",))
        if self.mechanism is None and self.response != 1.0:
            problem, allowed = "a correction by image processing has no response", "no response, or a mechanism"
            raise Problem(problem, str(self.response), allowed, None, ("response",))
        try:
            kind = self.motion[1]
        except Problem as problem:
            raise problem.below("mechanism") from None
        if self.mechanism is not None and kind not in _KINDS:
            raise Problem("not a mechanism's motion", shown(kind), "rotate or shift, and an axis", None, ("mechanism",))
        for key in ("step", "range", "dead_band"):
            self._size(key)
        if self.largest == 0.0:
            raise Problem("less than one step", shown(self.range), f"{self.step} or more", None, ("range",))
        return self

    @property
    def motion(self) -> tuple[str, str, str, str]:
        """Node, kind, axis and pivot of the motion of the mechanism; empty texts if no body moves."""
        return ("", "", "", "") if self.mechanism is None else component_parts(self.mechanism)

    def kind_of(self, key: str) -> Kind:
        """Return the kind of quantity (angle or length) of the key ``step``, ``range`` or ``dead_band``."""
        of_mechanism = self.mechanism is not None and key != "dead_band"
        return _KINDS[self.motion[1]] if of_mechanism else _QUANTITIES[self.quantity]

    def _size(self, key: str) -> float | None:
        text = getattr(self, key)
        if text is None:
            return None
        kind = self.kind_of(key)
        try:
            value = parse_quantity(text, kind)
        except Problem as problem:
            raise problem.below(key) from None
        if not value > 0.0:
            raise Problem("not greater than zero", shown(text), kind.allowed, None, (key,))
        return value

    @property
    def smallest(self) -> float | None:
        """Step of the mechanism, in rad or m; None if any amount is possible."""
        return self._size("step")

    @property
    def largest(self) -> float | None:
        """Range of the mechanism to either side, in rad or m; None if unlimited.

        For a mechanism with steps it is a whole number of them.
        """
        full_range, step = self._size("range"), self._size("step")
        return full_range if full_range is None or step is None else step * math.floor(full_range / step + _WHOLE)

    @property
    def band(self) -> float:
        """Dead band: remaining errors of the quantity below it are not corrected, in rad or m."""
        return self._size("dead_band") or 0.0


class ReadingsSpec(Spec):
    """Times at which the spots are read; images are taken immediately after.

    Attributes
    ----------
    begin : float
        Time of the first reading from the orbit's epoch, in seconds.
    interval : float
        Interval between readings, in seconds.
    count : int
        Number of readings.
    """

    begin: Moment = 0.0
    interval: Interval
    count: Annotated[Whole, Field(ge=2, le=1000)]

    @property
    def times(self) -> tuple[float, ...]:
        """Times of the readings from the orbit's epoch, in seconds."""
        return tuple(self.begin + self.interval * k for k in range(self.count))


class MechanismsSpec(Spec):
    """Closed loop: mechanisms point and refocus the cameras by the monitor's readings.

    The results are compared with those of the open loop.

    Attributes
    ----------
    readings : ReadingsSpec | None
        Times of the readings, if the file has no course: the motions are then drawn from the disturbances and their
        time laws. With a course the spots are read at each of its times.
    corrections : Mapping[str, CorrectionSpec]
        Name -> correction by the readings.
    """

    readings: ReadingsSpec | None = None
    corrections: Annotated[Named[CorrectionSpec], Field(min_length=1, max_length=50)]


class OrbitMonitorSpec(TitledSpec):
    """Height errors along an orbit with and without on-board monitoring, or with a closed loop.

    In a closed loop, mechanisms are controlled by the readings of the monitor.

    Attributes
    ----------
    instrument : str
        Instrument with two or more cameras and their monitors: a name in scenes/library/instruments, or the path of
        your file.
    cameras : tuple[str, ...] | None
        Two cameras of the stereo pair; the rotation of the first is relative to the second. By default those of an
        instrument with two.
    perturb : Mapping[str, PlainPerturbationSpec]
        Node -> constant perturbation relative to the nominal instrument, as in a job.
    course : CourseSpec | None
        Evenly spaced times from the orbit's epoch, with temperatures. Tests with `mechanisms.readings` have no course.
    motion : Mapping[str, MotionSpec]
        Node -> true motion, unknown to the estimates.
    reference : float | None
        Time of the course at which the cameras were calibrated and the monitor's reference images were taken, in
        seconds.
    disturbances : JobDisturbancesSpec | None
        Expected disturbances with their time laws, as in a job, on which the monitor's values and their sigmas are
        based; by default the instrument's.
    interval : float | None
        Interval between measurements of the monitor, in seconds, a multiple of the course's step. The values are
        interpolated linearly between them and held constant before the first and after the last. With disturbances all
        measurements are also smoothed together.
    intervals : tuple[float, ...] | None
        Intervals that are compared, in seconds; by default all that divide the course.
    apply : tuple[{'d_alpha', 'd_beta', 'd_gamma', 'd_f'}, ...]
        Changes measured by the monitor by which the cameras are corrected: rotations about the camera's Y, its X and
        the line of sight, and the principal distance.
    mechanisms : MechanismsSpec | None
        Closed loop that acts on every reading, instead of `reference` and `interval`.
    frames : int | None
        Number of frames of a measurement; by default that of the instrument's monitor.
    analysis : AnalysisSpec
        Analysis of the monitor's images.
    repeats : int
        Number of repetitions of a measurement with new noise, from which the scatter is computed.
    earth : EarthSpec
        Earth rotation.
    orbit : OrbitSpec
        True orbit; it must cover all times and one more minute at either end.
    attitude : AttitudeSpec
        True attitude.
    line_time : float
        Time from one image line to the next, in seconds.
    ground : GroundSpec
        Check points on the ground, whose errors are computed.
    errors : MonitorErrorsSpec
        Errors of image points, orbit, attitude and the monitor's frames.
    seed : int
        Seed of all random numbers.
    """

    instrument: Ref
    cameras: tuple[Name, ...] | None = None
    perturb: Paths[PlainPerturbationSpec] = Field(default_factory=FrozenMap)
    course: CourseSpec | None = None
    motion: Paths[MotionSpec] = Field(default_factory=FrozenMap)
    reference: Moment | None = None
    disturbances: JobDisturbances | None = None
    interval: Interval | None = None
    intervals: tuple[Interval, ...] | None = None
    apply: Annotated[tuple[Parameter, ...], AfterValidator(_once)] = PARAMETERS
    mechanisms: MechanismsSpec | None = None
    frames: Frames | None = None
    analysis: Annotated[AnalysisSpec, NothingIsEmpty] = AnalysisSpec.model_construct()
    repeats: Repeats = 40
    earth: EarthSpec = EarthSpec.model_construct()
    orbit: OrbitSpec
    attitude: AttitudeSpec = AttitudeSpec.model_construct(steering="yaw")
    line_time: LineTime = 0.09e-3
    ground: GroundSpec
    errors: MonitorErrorsSpec = MonitorErrorsSpec.model_construct()
    seed: Seed = 0

    @model_validator(mode="after")
    def _times_fit(self) -> "OrbitMonitorSpec":
        if self.cameras is not None and (len(self.cameras) != 2 or len(set(self.cameras)) != 2):
            value = ", ".join(self.cameras) or "none"
            raise Problem("not a pair of cameras", value, "two different cameras", within=("cameras",))
        self._require_keys()
        if self.course is not None:
            self._check_course(self.course)
        for k, time in enumerate(self.times):
            if wrong := self.orbit.misses(time):
                raise wrong.below(*self.times_key, *(() if self.course is None else ("times", k)))
        if self.mechanisms is None:
            if index_of_value(self.reference_time, self.times) is None:
                raise no_such_time(self.reference_time, self.times, "one of course.times").below("reference")
            self._check_interval(self.cadence, ("interval",))
            for k, interval in enumerate(self.intervals or ()):
                self._check_interval(interval, ("intervals", k))
        return self

    def _require_keys(self) -> None:
        """Raise `Problem` unless the file has the keys that either monitoring or a closed loop needs."""
        loop = self.mechanisms
        for key in ("course", "reference", "interval"):
            if loop is None and getattr(self, key) is None:
                raise Problem(f"'{key}' is missing", None, f"{key}, or mechanisms for a closed loop")
        if loop is None:
            return
        for key in ("reference", "interval", "intervals", "apply", "repeats"):
            if getattr(self, key) != type(self).model_fields[key].default:
                problem = f"a test with mechanisms has no {key}, since they act on every reading"
                raise Problem(problem, None, f"{key} or mechanisms, not both", within=(key,))
        if self.perturb and self.course is None:
            problem = "a perturbation needs a course: random motions start from the nominal instrument"
            raise Problem(problem, None, "perturb with a course", within=("perturb",))
        if (self.course is None) is (loop.readings is None):
            value = "neither" if loop.readings is None else "both"
            allowed = "readings: {interval: 4 min, count: 25}, or the file's course"
            raise Problem("the readings' times must be given once", value, allowed, within=("mechanisms",))

    def _check_course(self, course: CourseSpec) -> None:
        """Raise `Problem` unless the times are evenly spaced and all motions are in the test's `motion`."""
        if course.motion or course.table is not None:
            name = "motion" if course.motion else "table"
            allowed = "times and temperature under course; motions under the test's own motion"
            raise Problem(f"the course of this test has no {name}", None, allowed, within=("course", name))
        steps = [b - a for a, b in pairwise(course.times)]
        for k, step in enumerate(steps):
            if abs(step - steps[0]) > _EVEN:
                value = f"{moment(course.times[k])} to {moment(course.times[k + 1])} after steps of {moment(steps[0])}"
                raise Problem("the times are not evenly spaced", value, "equal steps", None, ("course", "times", k + 1))

    def _check_interval(self, interval: float, key: KeyPath) -> None:
        """Raise `Problem` unless the interval is a multiple of the step and not longer than the course."""
        step, span = self.step, self.times[-1] - self.times[0]
        if interval > span + _EVEN:
            raise Problem("longer than the course", moment(interval), f"at most {moment(span)}", within=key)
        if abs(interval - step * round(interval / step)) > _EVEN or interval < step - _EVEN:
            near, allowed = moment(step * max(round(interval / step), 1)), f"multiples of {moment(step)}"
            raise Problem("not a multiple of the course's step", moment(interval), allowed, near, key)

    @property
    def loop(self) -> MechanismsSpec:
        """Mechanisms of a test with a closed loop."""
        assert self.mechanisms is not None
        return self.mechanisms

    @property
    def times(self) -> tuple[float, ...]:
        """Times of the course, or of the readings of a loop without one, from the orbit's epoch, in seconds."""
        if self.course is not None:
            return self.course.times
        assert self.loop.readings is not None
        return self.loop.readings.times

    @property
    def times_key(self) -> KeyPath:
        """Key of the file that gives the times: that of the course, or of the readings of the closed loop."""
        return ("mechanisms", "readings") if self.course is None else ("course",)

    @property
    def step(self) -> float:
        """Step between the times of the course, in seconds."""
        return self.times[1] - self.times[0]

    @property
    def cadence(self) -> float:
        """Interval between measurements of the monitor, in seconds."""
        assert self.interval is not None
        return self.interval

    @property
    def compared(self) -> tuple[float, ...]:
        """Intervals between measurements of the monitor that are compared, ascending, in seconds."""
        if self.intervals is not None:
            return tuple(sorted(set(self.intervals)))
        count = len(self.times) - 1
        return tuple(self.step * n for n in range(1, count + 1) if count % n == 0)

    @property
    def reference_index(self) -> int:
        """Index, counted from 0, of the time at which the cameras were calibrated, among the times of the course."""
        number = index_of_value(self.reference_time, self.times)
        assert number is not None
        return number

    @property
    def reference_time(self) -> float:
        """Time at which the cameras were calibrated, in seconds."""
        assert self.reference is not None
        return self.reference

    def measured(self, interval: float) -> list[int]:
        """Return the numbers of the times at which the monitor measures, every ``interval`` seconds.

        They are counted from the reference time to both sides.
        """
        steps = round(interval / self.step)
        return [k for k in range(len(self.times)) if (k - self.reference_index) % steps == 0]

    @property
    def job(self) -> JobSpec:
        """Job that renders the monitor's images, without the motions of `motion`.

        Its issues are reported at the lines of this file.
        """
        frames = RenderSpec.model_construct(
            images=("spots",), targets=None, stray=None, frames=self.frames, seed=self.seed
        )
        shared = {key: getattr(self, key) for key in ("instrument", "course", "disturbances", "analysis")}
        job = JobSpec.model_construct(perturb=PerturbationSpec.of(self.perturb), render=frames, **shared)
        return job.with_source(self.source)

    def check_nodes(self, nodes: Mapping[str, NodeInfo]) -> None:
        """Raise `InputError` unless every node exists and allows its perturbation and motion."""
        checked_nodes(self.job, nodes)
        issues = [
            issue
            for path, motion in self.motion.items()
            for issue in perturbation_issues(self, nodes, path, motion.full_motion, ("motion", path))
        ]
        if issues:
            raise InputError(*issues)
