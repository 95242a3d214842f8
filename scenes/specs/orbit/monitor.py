"""What on-board monitoring buys on the ground (papers 001, 000, 003), as a file in scenes/orbit gives it: a course of
temperatures and motions of a stereo pair along an orbit, monitoring at an interval, points intersected without control.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from optics.numerics.array_math import number_of
from optics.numerics.frozen_map import FrozenMap
from scenes.specs.course import CourseSpec, Moment, Rotation, Shift, moment, no_such_time
from scenes.specs.disturbances import JobDisturbances
from scenes.specs.job import AnalysisSpec, JobSpec, PerturbationSpec, RenderSpec, checked_nodes
from scenes.specs.orbit.angle import Relief, TerrainHeight, check_ends
from scenes.specs.orbit.calibration import Count, FieldLength, LineTime
from scenes.specs.orbit.flight import AttitudeSpec, EarthSpec, ErrorsSpec, OrbitSpec
from scenes.specs.perturbation import NodeInfo, PlainPerturbationSpec, perturbation_issues
from scenes.yaml.errors import InputError, Problem
from scenes.yaml.quantity import Quantity
from scenes.yaml.spec import Flag, Name, NothingIsEmpty, Number, Paths, Reference, Seed, Spec, TitledSpec, Whole
from scenes.yaml.units import MOMENT

_EVEN = 1e-6
"""Seconds; steps between times that differ by less are equal."""

Span = Annotated[float, Quantity(MOMENT, smallest="0 s", largest="100000 h")]
Interval = Annotated[float, Quantity(MOMENT, above_zero=True, largest="100000 h")]
Frames = Annotated[Whole, Field(ge=1, le=1000)]
Repeats = Annotated[Whole, Field(ge=8, le=500)]
Parameter = Literal["d_alpha", "d_beta", "d_gamma", "d_f"]
PARAMETERS: tuple[Parameter, ...] = ("d_alpha", "d_beta", "d_gamma", "d_f")
"""What the monitor says of a camera."""


def _once(names: tuple[Parameter, ...]) -> tuple[Parameter, ...]:
    if not names:
        raise Problem("nothing is corrected", "an empty list", "at least one of d_alpha, d_beta, d_gamma, d_f")
    return tuple(dict.fromkeys(names))


class MotionSpec(Spec):
    """How a body moves along the orbit: what mounts do and temperatures of this model do not say.

    Attributes:
        rotate: rotation vector in the body's own frame about the pivot, radians; comes before the shift.
        shift: in the body's own frame, metres.
        pivot: name of the body's point that the rotation leaves in place.
        begin: when it begins, seconds.
        duration: over which it grows evenly to `rotate` and `shift`, where it stays, seconds; 0 for a step.
        period: instead of `duration`, of a swing `rotate` x sin(2 pi (t - begin)/period), seconds, which lasts always.
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

    Attributes:
        points: at every time.
        first, last: ends of the part of the second camera's line that they lie on, pixels from 0.
        length: of the piece of the strip along the track, metres.
        height: mean above the ellipsoid, metres.
        relief: heights lie evenly within this on either side of the mean, metres.
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

    Attributes:
        gps: of the orbit.
        star_tracker: of the attitude. What both cameras share of it the monitor does not see.
        image: standard deviation of an image point along and across the line, pixels.
        monitor: noise of the monitor's frames; false for expected images without noise or rounding.
        switched_on: false for exact image points, orbit and attitude, and monitor frames without noise.
    """

    image: Annotated[Number, Field(ge=0, le=10)] = 0.3
    monitor: Flag = True
    switched_on: Flag = True


class OrbitMonitorSpec(TitledSpec):
    """Height errors along an orbit with and without on-board monitoring.

    Attributes:
        name: as the file is called.
        description: for people.
        instrument: name in scenes/library/instruments or path of a file; two cameras with monitors.
        cameras: the two that make the stereo pair; the first is turned against the second. All of the instrument's when
            it has two.
        perturb: node -> a constant perturbation against the nominal instrument, as in a job.
        course: evenly spaced times from the orbit's epoch, with temperatures.
        motion: node -> how it moves.
        reference: one of the times, at which the cameras were calibrated and the monitor's reference images were taken.
        disturbances: what is expected to move, and how it goes on in time, as in a job: the monitor's values and their
            sigmas rest on it. The instrument's by default.
        interval: from one measurement of the monitor to the next, a multiple of the course's step; between them what it
            says is interpolated linearly, before the first and after the last it is held. Where disturbances are
            stated, all measurements are smoothed together, too.
        intervals: that are compared; by default all that divide the course.
        apply: which of the monitor's values correct the cameras.
        frames: of one measurement; as many as the instrument's monitor takes by default.
        analysis: how the monitor's images are analysed.
        repeats: how often a measurement is repeated with noise drawn anew, for the scatter.
        earth: its rotation.
        orbit: true orbit, over the course and a minute more at either end.
        attitude: true attitude.
        line_time: from one image line to the next, seconds.
        ground: check points.
        errors: of what is measured.
        seed: of every random number.
    """

    instrument: Reference
    cameras: tuple[Name, ...] | None = None
    perturb: Paths[PlainPerturbationSpec] = Field(default_factory=FrozenMap)
    course: CourseSpec
    motion: Paths[MotionSpec] = Field(default_factory=FrozenMap)
    reference: Moment
    disturbances: JobDisturbances | None = None
    interval: Interval
    intervals: tuple[Interval, ...] | None = None
    apply: Annotated[tuple[Parameter, ...], AfterValidator(_once)] = PARAMETERS
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
        if self.course.motion or self.course.table is not None:
            name = "motion" if self.course.motion else "table"
            allowed = "times and temperature under course; motions under the test's own motion"
            raise Problem(f"the course of this test has no {name}", None, allowed, within=("course", name))
        times = self.course.times
        steps = [b - a for a, b in pairwise(times)]
        for k, step in enumerate(steps):
            if abs(step - steps[0]) > _EVEN:
                found = f"{moment(times[k])} to {moment(times[k + 1])} after steps of {moment(steps[0])}"
                raise Problem(
                    "the times are not evenly spaced", found, "equal steps", within=("course", "times", k + 1)
                )
        for k, time in enumerate(times):
            if wrong := self.orbit.misses(time):
                raise wrong.below("course", "times", k)
        if number_of(self.reference, times) is None:
            raise no_such_time(self.reference, times, "one of course.times").below("reference")
        self._check_interval(self.interval, ("interval",))
        for k, interval in enumerate(self.intervals or ()):
            self._check_interval(interval, ("intervals", k))
        if self.cameras is not None and (len(self.cameras) != 2 or len(set(self.cameras)) != 2):
            found = ", ".join(self.cameras) or "none"
            raise Problem("not a pair of cameras", found, "two different cameras", within=("cameras",))
        return self

    def _check_interval(self, interval: float, key: tuple[str | int, ...]) -> None:
        """Problem unless the interval is a multiple of the step and not longer than the course."""
        step, span = self.step, self.course.times[-1] - self.course.times[0]
        if interval > span + _EVEN:
            raise Problem("longer than the course", moment(interval), f"at most {moment(span)}", within=key)
        if abs(interval - step * round(interval / step)) > _EVEN or interval < step - _EVEN:
            near = moment(step * max(round(interval / step), 1))
            raise Problem(
                "no multiple of the course's step", moment(interval), f"multiples of {moment(step)}", near, key
            )

    @property
    def step(self) -> float:
        """Between the course's times, seconds."""
        return self.course.times[1] - self.course.times[0]

    @property
    def compared(self) -> tuple[float, ...]:
        """Intervals of the comparison, ascending, seconds."""
        if self.intervals is not None:
            return tuple(sorted(set(self.intervals)))
        count = len(self.course.times) - 1
        return tuple(self.step * n for n in range(1, count + 1) if count % n == 0)

    @property
    def referred(self) -> int:
        """Number of the reference time, from 0."""
        number = number_of(self.reference, self.course.times)
        assert number is not None
        return number

    @property
    def reference_time(self) -> float:
        """Return the course's time that is the reference, seconds."""
        return self.course.times[self.referred]

    def measured(self, interval: float) -> list[int]:
        """Numbers of the times at which the monitor measures at this interval: from the reference on, to both sides."""
        every = round(interval / self.step)
        return [k for k in range(len(self.course.times)) if (k - self.referred) % every == 0]

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
