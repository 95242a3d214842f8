"""On-board monitoring and what it buys on the ground (papers 001, 000, 003), as files in scenes/orbit: a stereo pair
whose cameras move along an orbit, monitored at an interval or in a loop with mechanisms; points intersected without
control.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.array_math import number_of
from optics.numerics.number_tree import FrozenMap
from scenes.specs.course import CourseSpec, Moment, Rotation, Shift, moment, no_such_time
from scenes.specs.disturbances import JobDisturbances, component_named
from scenes.specs.job import AnalysisSpec, JobSpec, PerturbationSpec, RenderSpec, checked_nodes
from scenes.specs.orbit.angle import Relief, TerrainHeight, check_ends
from scenes.specs.orbit.calibration import Count, FieldLength
from scenes.specs.orbit.flight import AttitudeSpec, EarthSpec, ErrorsSpec, OrbitSpec
from scenes.specs.orbit.scene import GroundSpec as SceneGroundSpec
from scenes.specs.orbit.scene import ImagePointsSpec, LineTime, Side
from scenes.specs.perturbation import NodeInfo, PlainPerturbationSpec, perturbation_issues
from scenes.yaml.errors import InputError, KeyPath, Problem, shown
from scenes.yaml.spec import Flag, Name, Named, NothingIsEmpty, Number, Paths, Ref, Seed, Spec, Text, TitledSpec, Whole
from scenes.yaml.unit_fields import Quantity
from scenes.yaml.units import ANGLE, LENGTH, MOMENT, Kind, parse_quantity

_EVEN = 1e-6
"""Seconds; steps between times that differ by less are equal."""
_WHOLE = 1e-9
"""Share of a step by which a range is rounded to whole ones."""
_KINDS: dict[str, Kind] = {"rotate": ANGLE, "shift": LENGTH}
"""Kind of a mechanism's motion -> what its steps measure."""
_QUANTITIES: dict[str, Kind] = {"d_alpha": ANGLE, "d_beta": ANGLE, "d_gamma": ANGLE, "d_f": LENGTH, "defocus": LENGTH}

Span = Annotated[float, Quantity(MOMENT, smallest="0 s", largest="100000 h")]
Interval = Annotated[float, Quantity(MOMENT, above_zero=True, largest="100000 h")]
Frames = Annotated[Whole, Field(ge=1, le=1000)]
Repeats = Annotated[Whole, Field(ge=8, le=500)]
Parameter = Literal["d_alpha", "d_beta", "d_gamma", "d_f"]
PARAMETERS: tuple[Parameter, ...] = ("d_alpha", "d_beta", "d_gamma", "d_f")
"""Changes of a camera that the monitor gives."""


def _once(names: tuple[Parameter, ...]) -> tuple[Parameter, ...]:
    if not names:
        raise Problem("nothing is corrected", "an empty list", "at least one of d_alpha, d_beta, d_gamma, d_f")
    return tuple(dict.fromkeys(names))


class MotionSpec(Spec):
    """How a body moves along the orbit: what mounts do and temperatures of this model do not say.

    Attributes
    ----------
    rotate : Rotation
        Rotation vector in the body's own frame about the pivot, radians; comes before the shift.
    shift : Shift
        In the body's own frame, metres.
    pivot : Name
        Name of the body's point that the rotation leaves in place.
    begin : Moment
        When it begins, seconds.
    duration : Span
        Over which it grows evenly to `rotate` and `shift`, where it stays, seconds; 0 for a step.
    period : Interval | None
        Instead of `duration`, of a swing `rotate` x sin(2 pi (t - begin)/period), seconds, which lasts always.
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
            raise Problem("both a ramp and a swing", None, "either duration or period", within=("period",))
        return self

    def share(self, time: float) -> float:
        """Share of `rotate` and `shift` that is there at a time in seconds."""
        passed = time - self.begin
        if self.period is not None:
            return math.sin(2.0 * math.pi * passed / self.period)
        if self.duration:
            return min(max(passed / self.duration, 0.0), 1.0)
        return float(passed >= 0.0)

    @property
    def furthest(self) -> PlainPerturbationSpec:
        """The whole of the motion as a perturbation."""
        return PlainPerturbationSpec.model_construct(rotate=self.rotate, shift=self.shift, pivot=self.pivot)


class GroundSpec(Spec):
    """Check points at every time of the course, at random places that both lines see; their means lie where the two
    views are at equal times before and after.

    Attributes
    ----------
    points : Count
        At every time.
    first, last : Number
        Ends of the part of the second camera's line that they lie on, pixels from 0.
    length : FieldLength
        Of the piece of the strip along the track, metres.
    height : TerrainHeight
        Mean above the ellipsoid, metres.
    relief : Relief
        Heights lie evenly within this on either side of the mean, metres.
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
    """Errors of what is measured; orbit and attitude are exact unless given.

    Attributes
    ----------
    gps
        Of the orbit.
    star_tracker
        Of the attitude. What both cameras share of it the monitor does not see.
    image : Number
        Standard deviation of an image point along and across the line, pixels.
    monitor : Flag
        Noise of the monitor's frames; false for expected images without noise or rounding.
    switched_on : Flag
        False for exact image points, orbit and attitude, and monitor frames without noise.
    """

    image: Annotated[Number, Field(ge=0, le=10)] = 0.3
    monitor: Flag = True
    switched_on: Flag = True


class CorrectionSpec(Spec):
    """A correction of one quantity of the posterior.

    With every reading the command changes by `gain` times what the posterior says is left of the quantity, over what
    the mechanism does to it.

    Attributes
    ----------
    camera : Name
        Whose quantity it is.
    quantity : Literal['d_alpha', 'd_beta', 'd_gamma', 'd_f', 'defocus']
        `d_alpha`, `d_beta`, `d_gamma`, `d_f`, or `defocus`, best focus less line CCD.
    mechanism : Text | None
        The motion of a body that corrects it, in words without amount: `forward/focal_plane shift z`; by default the
        line of sight is corrected in the processing of the images on the ground, and no body moves.
    gain : Number
        Share of what is left that one reading corrects.
    delay : Whole
        Readings after which a command has its effect; 0 for at once, before the images of that moment.
    step : Text | None
        The mechanism moves by whole steps, with unit; by default it moves by any amount.
    range : Text | None
        To either side of where it stands at the beginning, with unit; none by default.
    dead_band : Text | None
        What is left and is smaller is left alone, in the quantity's unit.
    response : Number
        What the mechanism does over what it is known to do; the estimate does not know it.
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
            raise Problem("no processing corrects the focus", "no mechanism", allowed, within=("quantity",))
        if self.mechanism is None and self.response != 1.0:
            allowed = "no response, or a mechanism"
            raise Problem(
                "a correction by processing does what it says", str(self.response), allowed, None, ("response",)
            )
        try:
            kind = self.motion[1]
        except Problem as problem:
            raise problem.below("mechanism") from None
        if self.mechanism is not None and kind not in _KINDS:
            raise Problem("no motion of a mechanism", shown(kind), "rotate or shift, and an axis", None, ("mechanism",))
        for key in ("step", "range", "dead_band"):
            self._size(key)
        if self.largest == 0.0:
            raise Problem("less than one step", shown(self.range), f"{self.step} or more", None, ("range",))
        return self

    @property
    def motion(self) -> tuple[str, str, str, str]:
        """Node, kind, axis and pivot of the mechanism; empty for none."""
        return ("", "", "", "") if self.mechanism is None else component_named(self.mechanism)

    def kind_of(self, key: str) -> Kind:
        """Return the kind of quantity of ``step``, ``range`` or ``dead_band``."""
        own = self.mechanism is not None and key != "dead_band"
        return _KINDS[self.motion[1]] if own else _QUANTITIES[self.quantity]

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
        """The step, rad or m."""
        return self._size("step")

    @property
    def largest(self) -> float | None:
        """The range to either side, rad or m; of a mechanism of steps that of its whole steps."""
        reach, step = self._size("range"), self._size("step")
        return reach if reach is None or step is None else step * math.floor(reach / step + _WHOLE)

    @property
    def band(self) -> float:
        """The dead band, rad or m of the quantity."""
        return self._size("dead_band") or 0.0


class ReadingsSpec(Spec):
    """When the spots are read, and images are taken just after.

    Attributes
    ----------
    begin : Moment
        Of the first, seconds from the orbit's epoch.
    every : Interval
        From one to the next.
    count : Whole
        How many.
    """

    begin: Moment = 0.0
    every: Interval
    count: Annotated[Whole, Field(ge=2, le=1000)]

    @property
    def times(self) -> tuple[float, ...]:
        """Seconds from the orbit's epoch."""
        return tuple(self.begin + self.every * k for k in range(self.count))


class LoopImagesSpec(Spec):
    """Pairs of line images, rendered after some of the readings with the loop open and closed.

    Attributes
    ----------
    times : tuple[Moment, ...]
        Of these readings, seconds from the orbit's epoch.
    side : Side
        Lines and pixels of every image.
    ground : SceneGroundSpec
        What is there.
    points : ImagePointsSpec
        How points of the second camera's image are sought in the first one's; `tie` says how many.
    """

    times: Annotated[tuple[Moment, ...], Field(min_length=1, max_length=20)]
    side: Annotated[Side, Field(le=2000)] = 400
    ground: SceneGroundSpec = SceneGroundSpec()
    points: ImagePointsSpec = ImagePointsSpec.model_validate({"control": 0, "tie": 60, "reach": 16})

    @model_validator(mode="after")
    def _has_ties(self) -> "LoopImagesSpec":
        if not self.points.tie:
            raise Problem("no points of one image are sought in the other", "tie: 0", "some", None, ("points", "tie"))
        return self


class MechanismsSpec(Spec):
    """Mechanisms that point and refocus by what the monitor's readings say, beside the same pair left alone.

    Attributes
    ----------
    readings : ReadingsSpec | None
        When the spots are read where the file has no course: amounts of what is stated to move are then drawn by its
        laws in time. With a course they are read at each of its times.
    corrections : Named[CorrectionSpec]
        Name -> what acts on what the readings say.
    images : LoopImagesSpec | None
        Pairs of line images; none without this section.
    """

    readings: ReadingsSpec | None = None
    corrections: Annotated[Named[CorrectionSpec], Field(min_length=1, max_length=50)]
    images: LoopImagesSpec | None = None


class OrbitMonitorSpec(TitledSpec):
    """Height errors along an orbit with and without on-board monitoring, or with mechanisms that act on its readings.

    Attributes
    ----------
    name
        As the file is called.
    description
        For people.
    instrument : Ref
        Name in scenes/library/instruments or path of a file; two cameras with monitors.
    cameras : tuple[Name, ...] | None
        The two that make the stereo pair; the first is turned against the second. All of the instrument's when it has
        two.
    perturb : Paths[PlainPerturbationSpec]
        Node -> a constant perturbation against the nominal instrument, as in a job.
    course : CourseSpec | None
        Evenly spaced times from the orbit's epoch, with temperatures. Mechanisms have `readings` in its place where
        amounts are drawn.
    motion : Paths[MotionSpec]
        Node -> how it moves, which no estimate knows.
    reference : Moment | None
        One of the times, at which the cameras were calibrated and the monitor's reference images were taken.
    disturbances : JobDisturbances | None
        What is expected to move, and how it goes on in time, as in a job: the monitor's values and their sigmas rest on
        it. The instrument's by default.
    interval : Interval | None
        From one measurement of the monitor to the next, a multiple of the course's step; between them what it says is
        interpolated linearly, before the first and after the last it is held. Where disturbances are stated, all
        measurements are smoothed together, too.
    intervals : tuple[Interval, ...] | None
        That are compared; by default all that divide the course.
    apply : tuple[Parameter, ...]
        Which of the monitor's values correct the cameras.
    mechanisms : MechanismsSpec | None
        In place of `reference` and `interval`: the loop is closed, and every reading is acted upon.
    frames : Frames | None
        Of one measurement; as many as the instrument's monitor takes by default.
    analysis : AnalysisSpec
        How the monitor's images are analysed.
    repeats : Repeats
        How often a measurement is repeated with noise drawn anew, for the scatter.
    earth : EarthSpec
        Its rotation.
    orbit : OrbitSpec
        True orbit, over all times and a minute more at either end.
    attitude : AttitudeSpec
        True attitude.
    line_time : LineTime
        From one image line to the next, seconds.
    ground : GroundSpec
        Check points.
    errors : MonitorErrorsSpec
        Of what is measured.
    seed : Seed
        Of every random number.
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
            found = ", ".join(self.cameras) or "none"
            raise Problem("not a pair of cameras", found, "two different cameras", within=("cameras",))
        self._require_keys()
        if self.course is not None:
            self._check_course(self.course)
        for k, time in enumerate(self.times):
            if wrong := self.orbit.misses(time):
                raise wrong.below(*self.times_key, *(() if self.course is None else ("times", k)))
        if self.mechanisms is None:
            if number_of(self.reference_time, self.times) is None:
                raise no_such_time(self.reference_time, self.times, "one of course.times").below("reference")
            self._check_interval(self.every, ("interval",))
            for k, interval in enumerate(self.intervals or ()):
                self._check_interval(interval, ("intervals", k))
        elif self.mechanisms.images is not None:
            for k, time in enumerate(self.mechanisms.images.times):
                if number_of(time, self.times) is None:
                    wrong = no_such_time(time, self.times, "the time of a reading")
                    raise wrong.below("mechanisms", "images", "times", k)
        return self

    def _require_keys(self) -> None:
        """Problem unless the file has either what monitoring needs, or what a loop needs."""
        loop = self.mechanisms
        for key in ("course", "reference", "interval"):
            if loop is None and getattr(self, key) is None:
                raise Problem(f"'{key}' is missing", None, f"{key}, or mechanisms where the loop is closed")
        if loop is None:
            return
        for key in ("reference", "interval", "intervals", "apply", "repeats"):
            if getattr(self, key) != type(self).model_fields[key].default:
                problem = f"mechanisms act on every reading, and a loop has no {key}"
                raise Problem(problem, None, f"{key} or mechanisms, not both", within=(key,))
        if self.perturb and self.course is None:
            problem = "drawn amounts are those of the instrument as designed, without a perturbation"
            raise Problem(problem, None, "perturb with a course", within=("perturb",))
        if (self.course is None) is (loop.readings is None):
            found = "neither" if loop.readings is None else "both"
            allowed = "readings: {every: 4 min, count: 25}, or the file's course"
            raise Problem("the times of the readings", found, allowed, within=("mechanisms",))

    def _check_course(self, course: CourseSpec) -> None:
        """Problem unless its times are evenly spaced, and all that moves stands under the test's own motion."""
        if course.motion or course.table is not None:
            name = "motion" if course.motion else "table"
            allowed = "times and temperature under course; motions under the test's own motion"
            raise Problem(f"the course of this test has no {name}", None, allowed, within=("course", name))
        steps = [b - a for a, b in pairwise(course.times)]
        for k, step in enumerate(steps):
            if abs(step - steps[0]) > _EVEN:
                found = f"{moment(course.times[k])} to {moment(course.times[k + 1])} after steps of {moment(steps[0])}"
                raise Problem("the times are not evenly spaced", found, "equal steps", None, ("course", "times", k + 1))

    def _check_interval(self, interval: float, key: KeyPath) -> None:
        """Problem unless the interval is a multiple of the step and not longer than the course."""
        step, span = self.step, self.times[-1] - self.times[0]
        if interval > span + _EVEN:
            raise Problem("longer than the course", moment(interval), f"at most {moment(span)}", within=key)
        if abs(interval - step * round(interval / step)) > _EVEN or interval < step - _EVEN:
            near = moment(step * max(round(interval / step), 1))
            raise Problem(
                "no multiple of the course's step", moment(interval), f"multiples of {moment(step)}", near, key
            )

    @property
    def loop(self) -> MechanismsSpec:
        """The mechanisms of a test that has some."""
        assert self.mechanisms is not None
        return self.mechanisms

    @property
    def times(self) -> tuple[float, ...]:
        """Times of the course, or of the readings of a loop without one, seconds from the orbit's epoch."""
        if self.course is not None:
            return self.course.times
        assert self.loop.readings is not None
        return self.loop.readings.times

    @property
    def times_key(self) -> KeyPath:
        """Where the file has its times."""
        return ("mechanisms", "readings") if self.course is None else ("course",)

    @property
    def step(self) -> float:
        """Between the times, seconds."""
        return self.times[1] - self.times[0]

    @property
    def every(self) -> float:
        """From one measurement of the monitor to the next, seconds."""
        assert self.interval is not None
        return self.interval

    @property
    def compared(self) -> tuple[float, ...]:
        """Intervals of the comparison, ascending, seconds."""
        if self.intervals is not None:
            return tuple(sorted(set(self.intervals)))
        count = len(self.times) - 1
        return tuple(self.step * n for n in range(1, count + 1) if count % n == 0)

    @property
    def referred(self) -> int:
        """Number of the reference time, from 0."""
        number = number_of(self.reference_time, self.times)
        assert number is not None
        return number

    @property
    def reference_time(self) -> float:
        """Time at which the cameras were calibrated, seconds."""
        assert self.reference is not None
        return self.reference

    def measured(self, interval: float) -> list[int]:
        """Numbers of the times at which the monitor measures at this interval: from the reference on, to both sides."""
        every = round(interval / self.step)
        return [k for k in range(len(self.times)) if (k - self.referred) % every == 0]

    @property
    def job(self) -> JobSpec:
        """The job of the monitor's images without `motion`; what is wrong with it is told at this file's lines."""
        frames = RenderSpec.model_construct(
            images=("spots",), targets=None, stray=None, frames=self.frames, seed=self.seed
        )
        job = JobSpec.model_construct(
            instrument=self.instrument,
            perturb=PerturbationSpec.of(self.perturb),
            course=self.course,
            disturbances=self.disturbances,
            render=frames,
            analysis=self.analysis,
        )
        return job.with_source(self.source)

    def check_nodes(self, nodes: Mapping[str, NodeInfo]) -> None:
        """InputError unless every node exists and allows what is done to it."""
        checked_nodes(self.job, nodes)
        issues = [
            issue
            for path, motion in self.motion.items()
            for issue in perturbation_issues(self, nodes, path, motion.furthest, ("motion", path))
        ]
        if issues:
            raise InputError(*issues)
