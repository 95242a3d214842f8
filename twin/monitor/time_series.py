"""Time series of an instrument's states (a course): the states, the monitor's images and their analysis."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.monitor.disturbances import FALSE_ALARM, Consistency, Disturbances, chi_squares
from analysis.monitor.jump_detection import Jump
from analysis.monitor.monitor_formulas import GroundGeometry
from analysis.monitor.parameters import CameraCalibration
from analysis.monitor.recovery import Curvature, Recovery, SpotEvidence, estimates_of
from analysis.monitor.series_smoother import smooth_series, window_of
from analysis.spots.spot_image import NoiseParts, SeriesNoise, SpotError
from analysis.statistics import limit_of
from optics.geometry.tree import Motion, State
from optics.numerics.backend import one_blas_thread
from optics.thermal.heat import Temperature
from scenes.models.job_state import motions_of
from scenes.models.thermal_model import TemperatureError
from scenes.specs.course import CourseSpec, moment
from scenes.specs.job import JobSpec
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.errors import InputError, names_text
from twin.framework.artefact import significant
from twin.framework.record import Quantity, Record
from twin.monitor.monitor_experiment import MonitorExperiment, largest_piece
from twin.monitor.observation import LOST, ObservationOptions, observe, shared_detector, why_lost
from twin.monitor.reading_table import ReadingTable, reading_table

LARGEST_SERIES = 200_000_000
"""Largest number of pixels of a time series' first frames, which stay in memory: about 1.2 GB.

There is one such frame for each time and channel.
"""


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """Results of a time series of T states of an instrument (a course).

    Dimensions: T times, C spots.

    Attributes
    ----------
    times : (T,) ndarray
        Times, in seconds.
    temperatures : mapping
        Path of a body -> its temperature change at each time, perturbation included.
    motions : mapping
        Path of a body -> its motion at each time, perturbation included, for the bodies that the time series moves.
    shown : int
        Index of the time for which the run's other files and figures are made.
    angle : float
        Angle between two cameras in the nominal state, in radians; NaN unless there are two.
    readings : ReadingTable
        True and estimated changes at all times, relative to one nominal measurement.
    smoothed : SmoothedCourse | None
        Estimates from all measurements together; None without a prior.
    shift : (T, 2 C) ndarray
        Shifts of the spots (row and column of each), in pixels.
    shift_covariance : (T, 2 C, 2 C) ndarray
        Covariance of the shifts, in px^2.
    photons : (T, C, rows, columns) ndarray of float32
        Expected photons per pixel and frame.
    shown_photons : (C, rows, columns) ndarray
        Expected photons of the time that is shown, as they were exposed.
    frames : (T, C, rows, columns) ndarray of uint16
        First frame of each time.
    warnings : tuple of str
        Warnings for the user.
    evidence : SpotEvidence
        Goodness of fit of all spots.
    curvature : mapping of str to Curvature
        Estimator -> test at all times of the linearity of the motions that it assumes.
    agrees : (T,) ndarray of bool
        True where the shifts agree with the prior; the false-alarm rate is that of all times together.
    """

    times: np.ndarray
    temperatures: Mapping[str, tuple[Temperature, ...]]
    motions: Mapping[str, tuple[Motion, ...]]
    shown: int
    angle: float
    readings: ReadingTable
    smoothed: SmoothedCourse | None
    shift: np.ndarray
    shift_covariance: np.ndarray
    photons: np.ndarray
    shown_photons: np.ndarray
    frames: np.ndarray
    warnings: tuple[str, ...]
    evidence: SpotEvidence
    curvature: Mapping[str, Curvature]
    agrees: np.ndarray

    @property
    def sigma_holds(self) -> np.ndarray:
        """True at the times at which the standard deviations are valid, (T,) for T times.

        They are valid where the spots and the shifts pass the tests of their assumptions.

        It is False at all times if the measurements together contradict the prior or its time laws.
        """
        agrees = self.agrees & (self.smoothed is None or self.smoothed.consistency.agrees)
        return agrees & np.all(
            [self.evidence.consistent, *(curvature.valid for curvature in self.curvature.values())], axis=0
        )

    def doubts(self, spots: Sequence[str]) -> tuple[str, ...]:
        """Return sentences on invalid sigmas and on estimates recomputed because of nonlinearity, without full stops.

        Parameters
        ----------
        spots : sequence of str
            Names of the spots.
        """
        out = [] if self.smoothed is None else list(self.smoothed.contradiction)
        doubt = self.evidence.course_doubt([moment(time) for time in self.times.tolist()], spots)
        if doubt is not None:
            out.append(f"course {doubt}")
        for name, curvature in self.curvature.items():
            untraceable = np.flatnonzero(~curvature.valid)
            recomputed = np.flatnonzero(curvature.beyond & curvature.valid)
            if len(untraceable):
                out.append(
                    f"course: σ does not hold at {len(untraceable)} times, first at "
                    f"{moment(float(self.times[untraceable[0]]))}: the motions estimated by the {name} are too large "
                    "for linear theory, and their states cannot be traced"
                )
            if len(recomputed):
                out.append(
                    f"course: at {len(recomputed)} times, first at {moment(float(self.times[recomputed[0]]))}, the "
                    f"motions estimated by the {name} are too large for linear theory; its readings are from "
                    "Gauss-Newton iteration"
                )
        return tuple(out)

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of course.json, the result file of a time series.

        They are those of truth.json and recovered.json, with a list over the times for each number.
        """
        numbers: dict[str, Any] = COURSE(self)
        return numbers

    def group(self, name: str) -> dict[str, Any] | None:
        """Return a group of changes as in course.json, with filtered and smoothed estimates; None without it.

        Parameters
        ----------
        name : str
            ``cameras``, ``intersection_angle`` or ``ground``.
        """
        groups, smoothed = self.readings.groups("true"), {} if self.smoothed is None else self.smoothed.changes.groups()
        if name == "cameras":
            return {
                camera: readings | smoothed.get(name, {}).get(camera, {}) for camera, readings in groups[name].items()
            }
        return groups[name] | smoothed.get(name, {}) if name in groups else None


def _angle(course: TimeSeries) -> dict[str, Any] | None:
    """Return the estimated angle between two cameras over the time series, with its nominal value; None without one."""
    group = course.group("intersection_angle")
    return None if group is None else {"nominal_deg": float(np.degrees(course.angle))} | group


_TEMPERATURES: Record[Sequence[Temperature]] = Record(
    "Temperature of a body in the course at each time, its perturbation included.",
    Quantity("change_K", lambda fields: [field.change for field in fields], "change at the body's origin"),
    Quantity("gradient_K_per_m", lambda fields: [field.gradient for field in fields], "gradient along the body's axes"),
)
_MOTIONS: Record[Sequence[Motion]] = Record(
    "Motion of a body in the course at each time, its perturbation included.",
    Quantity("pivot", lambda moves: moves[0].pivot, "fixed point of a rotation or a scale change"),
    Quantity("rotate_arcsec", lambda moves: [motion.rotate for motion in moves], "rotation about X, Y and Z"),
    Quantity("shift_um", lambda moves: [motion.shift for motion in moves], "shift along X, Y and Z"),
    Quantity("scale_ppm", lambda moves: [motion.scale for motion in moves], "relative scale change"),
)


def _consistency(course: TimeSeries) -> dict[str, Any] | None:
    """Return the test of all measurements of the time series against the prior, as plain data; None without a prior."""
    return None if course.smoothed is None else course.smoothed.to_dict()


def _between(course: TimeSeries) -> dict[str, Any] | None:
    """Return the smoothed changes at times between the measurements, as plain data; None if there are none."""
    return course.smoothed.between_dict() if course.smoothed and len(course.smoothed.times) else None


COURSE: Record[TimeSeries] = Record(
    "course.json: as truth.json and recovered.json, with a list over the times for each number.",
    Quantity("times_s", lambda course: course.times, "times of the measurements"),
    Quantity("detail", lambda course: course.shown, "index of the time that the run shows in full"),
    Quantity("temperatures", lambda course: course.temperatures, "temperatures by body", record=_TEMPERATURES),
    Quantity("cameras", lambda course: course.group("cameras"), "true changes and readings of each camera"),
    Quantity("motions", lambda course: course.motions or None, "motions by body", record=_MOTIONS, where_known=True),
    Quantity("intersection_angle", _angle, "the angle between two cameras", where_known=True),
    Quantity("ground", lambda course: course.group("ground"), "errors of points on the ground", where_known=True),
    Quantity("sigma_holds", lambda course: course.sigma_holds, "true at the times at which the sigmas are valid"),
    Quantity("disturbances", _consistency, "whether all measurements agree with the prior", where_known=True),
    Quantity("between", _between, "filtered and smoothed changes between the times", where_known=True),
)


def series_states(experiment: MonitorExperiment, job: JobSpec) -> list[State]:
    """Return the state of the instrument at each time of a job's time series (course).

    Parameters
    ----------
    experiment : MonitorExperiment
        Experiment with the instrument.
    job : JobSpec
        Job with a time series, checked by ``scenes.specs.job.checked_nodes``.

    Raises
    ------
    InputError
        At some time a temperature is at or below 0 K, or outside the range in which a glass's index is known.
    """
    course = _course(job)
    out = []
    for k, time in enumerate(course.times):
        fields = experiment.fields(job, k)
        try:
            experiment.thermal.check(fields)
        except TemperatureError as error:
            text = f"{error} at {moment(time)}"
            if error.origin in course.temperature:
                raise course.error(text, course.key(error.origin, k), allowed=error.allowed) from error
            raise job.error(text, ("perturb", error.origin, "temperature"), allowed=error.allowed) from error
        out.append(experiment.thermal.state(fields, experiment.motions(job, k)))
    return out


def run_series(
    experiment: MonitorExperiment,
    resolved: ResolvedJob,
    states: Sequence[State],
    advance: Callable[[int], None] = lambda done: None,
) -> TimeSeries:
    """Trace, render, expose and recover all times of a time series, relative to one nominal measurement.

    Parameters
    ----------
    experiment : MonitorExperiment
        Experiment with the instrument.
    resolved : ResolvedJob
        Job with a time series (course); its frames and seed are used.
    states : sequence of State
        States from ``series_states``.
    advance : callable
        Called with the number of times that are done, first with 0.

    Raises
    ------
    InputError
        At some time light misses the mirrors or a spot cannot be measured, or there are too many pixels.
    """
    job, frames, seed = resolved.job, resolved.frames, resolved.job.render.seed
    course = _course(job)
    channels, shape = experiment.path.channels, experiment.path.shape
    each = len(channels) * shape[0] * shape[1]
    if len(states) * each > LARGEST_SERIES:
        raise course.error(
            "the images of all times do not fit into memory",
            ("times",),
            value=f"{len(states)} times",
            allowed=f"at most {LARGEST_SERIES // each} with area CCDs of {shape[0]} x {shape[1]} pixels",
        )
    advance(0)
    photons = np.empty((len(states), len(channels), *shape), np.float32)
    first = np.empty(photons.shape, np.uint16)
    saturated = np.zeros(photons.shape[:2], bool)
    share = np.empty(photons.shape[:2])
    shown_photons, angle = np.empty(photons.shape[1:]), np.nan
    tables: list[ReadingTable] = []
    recoveries: list[Recovery] = []
    prior, cameras, ground = experiment.disturbances, experiment.cameras, experiment.ground
    together = CourseSmoother(prior, cameras, ground, course.times)
    record, size, done = shared_detector(experiment, frames, seed), largest_piece(each * frames), 0
    how = ObservationOptions(record, job.analysis.centroid, size, keep_parts=prior is not None)
    try:
        for observation in observe(experiment, states, how):
            piece, expected = slice(done, done + len(observation.numbers)), observation.light.photons
            tables.append(reading_table(observation.recovery, cameras, observation.truth, ground, prior))
            recoveries.append(together.add(observation.recovery))
            angle = observation.truth.angle
            photons[piece], first[piece] = expected, observation.after[:, :, 0]
            if piece.start <= course.shown < piece.stop:
                shown_photons[:] = expected[course.shown - piece.start]
            saturated[piece] = experiment.detector.saturated(observation.after).pixels > 0
            share[piece] = expected.sum(axis=(2, 3)) / experiment.nominal_photons.sum(axis=(1, 2))
            done = piece.stop
            advance(done)
    except LOST as error:
        for k in range(done, min(done + size, len(states))):
            if why := why_lost(experiment, states[k]):
                raise too_large(job, k, why) from error
        raise
    except SpotError as error:
        k, spot = divmod(error.indices[0], len(channels))
        reason = f"the spot {channels[spot].key} cannot be measured ({error.reasons[error.indices[0]]})"
        raise too_large(job, done + k, reason) from error
    shift = np.concatenate([r.shift for r in recoveries])
    spread = np.concatenate([r.shift_covariance for r in recoveries])
    agrees = np.ones(len(shift), bool)
    if prior is not None and np.any(spread):
        agrees = chi_squares(shift, spread, prior) <= limit_of(FALSE_ALARM / len(shift), shift.shape[1])
    state_motions = [motions_of(job, k) for k in range(len(states))]
    smoothed = together.smoothed()
    jumped = () if smoothed is None else smoothed.jump_texts()
    return TimeSeries(
        times=np.array(course.times),
        temperatures={path: tuple(job.fields(k)[path] for k in range(len(states))) for path in job.fields(0)},
        motions={path: tuple(motions[path] for motions in state_motions) for path in course.motion},
        shown=course.shown,
        angle=angle,
        readings=ReadingTable.joined(tables),
        smoothed=smoothed,
        shift=shift,
        shift_covariance=spread,
        photons=photons,
        shown_photons=shown_photons,
        frames=first,
        warnings=(*_warnings(experiment, course, saturated, share), *(f"course: {text}" for text in jumped)),
        evidence=SpotEvidence.joined([r.evidence for r in recoveries if r.evidence is not None]),
        curvature={e: Curvature.joined([r.curvature[e] for r in recoveries]) for e in recoveries[0].curvature},
        agrees=agrees,
    )


def too_large(job: JobSpec, k: int, reason: str) -> InputError:
    """Return the input error for the state at time number ``k`` that cannot be rendered, with the reason."""
    course = _course(job)
    changed = {"temperature": list(course.temperature), "motion": list(course.motion)}
    parts = {name: f"{name}s of {', '.join(nodes)}" for name, nodes in changed.items() if nodes}
    return course.error(
        f"the instrument at {moment(course.times[k])} of the course cannot be rendered: {reason}",
        (next(iter(parts)),),
        value=" and ".join(parts.values()),
        allowed="temperatures and motions that keep the beams on the mirrors and the spots on their CCDs",
    )


def _course(job: JobSpec) -> CourseSpec:
    """Return the specification of a job's time series: its times, with the temperatures and motions at each."""
    assert job.course is not None
    return job.course


MIN_LIGHT = 0.5
"""Fraction of the nominal light on a CCD below which the user is warned."""


def _warnings(
    experiment: MonitorExperiment, course: CourseSpec, saturated: np.ndarray, share: np.ndarray
) -> tuple[str, ...]:
    """Return warnings for the user about saturated pixels and lost light in the images of a time series."""
    out = []
    for i, channel in enumerate(experiment.path.channels):
        bad = np.flatnonzero(saturated[:, i])
        if len(bad):
            out.append(
                f"course: saturated pixels in the spot {channel.key} at {len(bad)} times, first at "
                f"{moment(course.times[bad[0]])}: centroids are biased; reduce the light"
            )
        worst = int(np.argmin(share[:, i]))
        if share[worst, i] < MIN_LIGHT:
            out.append(
                f"course: {channel.key} at {moment(course.times[worst])}: only {100 * share[worst, i]:.0f}% of the "
                "nominal light reaches the CCD"
            )
    return tuple(out)


_AS_GOOD = 3.0
"""Difference of log likelihoods (a factor 20 of likelihood) below which the spots do not show which body jumped."""
MOST_BETWEEN, LARGEST_BETWEEN = 7, 400
"""Largest numbers of smoothed times that are inserted: between two times of a course (time series), and in total."""


@dataclass(frozen=True, eq=False)
class SmoothedCourse:
    """Estimates over a time series from all its measurements together, using the time laws of the prior.

    Dimensions: T times of measurements, F times between them.

    Attributes
    ----------
    name : str
        Name of the prior.
    changes : ReadingTable
        Changes at all times of the series, by the estimators `filtered` (from the measurements up to each time) and
        `smoothed` (from all).
    times : (F,) ndarray
        Times between those of the measurements, in seconds.
    between : ReadingTable
        Changes at these times.
    innovations : (T,) ndarray
        Chi-square of each measurement against its prediction from the measurements before it.
    each : int
        Degrees of freedom of each innovation.
    consistency : Consistency
        Chi-square test of the whole series.
    jumps : tuple of Jump | None
        Detected jumps; None if the prior allows no jumps.
    jump_false_alarm : float
        Probability that a jump is detected in a series without any.
    """

    name: str
    changes: ReadingTable
    times: np.ndarray
    between: ReadingTable
    innovations: np.ndarray
    each: int
    consistency: Consistency
    jumps: tuple[Jump, ...] | None = None
    jump_false_alarm: float = FALSE_ALARM

    def jump_texts(self) -> tuple[str, ...]:
        """Return body, time and size of each jump, as sentences without full stop."""
        return tuple(jump_text(jump) for jump in self.jumps or ())

    @property
    def contradiction(self) -> tuple[str, ...]:
        """Warning if all measurements together contradict the prior or its time laws.

        Each measurement may agree with the prior, while all of them contradict its evolution in time.
        """
        test = self.consistency
        if test.agrees:
            return ()
        return (
            f"the series contradicts the prior {self.name} or its time laws: chi-square "
            f"{significant(test.chi_square)} for {test.degrees} degrees of freedom, limit {test.limit:.1f} at a "
            f"false-alarm rate of {FALSE_ALARM:g}; σ of filtered and smoothed changes does not hold",
        )

    def between_dict(self) -> dict[str, Any]:
        """Return the smoothed changes at times between the measurements, as plain data for course.json."""
        return {"times_s": self.times.tolist(), **self.between.groups()}

    def to_dict(self) -> dict[str, Any]:
        """Return the consistency test of the measurements with the prior, as plain data."""
        test = self.consistency
        searched: dict[str, Any] = {}
        if self.jumps is not None:
            jumps = [jump.to_dict() for jump in self.jumps]
            searched = {"jumps": {"false_alarm": self.jump_false_alarm, "detected": jumps}}
        return {
            "name": self.name,
            "chi_square": test.chi_square,
            "degrees_of_freedom": test.degrees,
            "limit": test.limit,
            "false_alarm": FALSE_ALARM,
            "chance": test.p_value,
            "agrees": test.agrees,
            "innovations": {"chi_square": self.innovations.tolist(), "degrees_of_freedom": self.each},
            **searched,
        }


def jump_text(jump: Jump) -> str:
    """Return body, time and size of a jump, as a sentence without full stop.

    Parameters
    ----------
    jump : Jump
        Detected jump.
    """
    body = jump.body
    sizes = ", ".join(
        f"{label.removeprefix(f'{body} ')} {size:+.3g} ± {sigma:.2g} {unit}"
        for label, size, sigma, unit in zip(jump.labels, jump.sizes, jump.sigmas, jump.units, strict=True)
    )
    rivals = [other for other, ratio in jump.rivals.items() if ratio > jump.log_ratio - _AS_GOOD]
    others = f"; {names_text(rivals[:3])} would explain it nearly as well" if rivals else ""
    return (
        f"{body} jumped between {moment(jump.after)} and {moment(jump.until)}: {sizes}, log likelihood ratio "
        f"{jump.log_ratio:.1f}; sigmas are larger there, and the smoothed changes treat it as an event{others}"
    )


class CourseSmoother:
    """Collector of the shifts and noise of all measurements, which are then smoothed together.

    Parameters
    ----------
    prior
        Prior with its time laws; without one (None) nothing is smoothed.
    cameras
        Calibration of each camera.
    ground
        Ground geometry of a stereo pair of known altitude, else None.
    times
        Times of the measurements, in seconds, ascending.
    """

    def __init__(
        self,
        prior: Disturbances | None,
        cameras: Mapping[str, CameraCalibration],
        ground: GroundGeometry | None,
        times: Sequence[float],
    ) -> None:
        self._prior, self._cameras, self._ground = prior, cameras, ground
        self._times = np.array(times)
        self._shifts: list[np.ndarray] = []
        self._noise: SeriesNoise | None = None

    def add(self, recovery: Recovery) -> Recovery:
        """Store shifts and noise of some states, and return the recovery without its large per-pixel noise maps.

        Parameters
        ----------
        recovery : Recovery
            Recovery of the next states, with the separate contributions to their noise.
        """
        if recovery.parts is None:
            return recovery
        self.take(recovery.shift, *recovery.parts)
        return recovery.at(slice(None))

    def take(self, shift: np.ndarray, before: NoiseParts, after: NoiseParts) -> None:
        """Store the shifts and the noise of states that were measured elsewhere.

        Parameters
        ----------
        shift : (S, 2 C) ndarray
            Shifts (after - before) of C spots (row and column of each) in the next S states, in pixels.
        before : NoiseParts
            Noise of the C spots before the change, the same at every call.
        after : NoiseParts
            Noise of the S C spots after it, state by state.
        """
        if self._noise is None:
            self._noise = SeriesNoise(before, window_of(shift.shape[1]))
        self._noise.add(after)
        self._shifts.append(shift)

    def smoothed(self) -> SmoothedCourse | None:
        """Return the smoothed changes of all stored states; None without a prior, or for a single time."""
        prior, noise, times = self._prior, self._noise, self._times
        if prior is None or noise is None or len(times) < 2:
            return None
        steps = min(MOST_BETWEEN, LARGEST_BETWEEN // (len(times) - 1)) + 1
        shares = np.arange(1, steps) / steps
        between = (times[:-1, None] + shares * np.diff(times)[:, None]).ravel()
        with one_blas_thread():
            series = smooth_series(prior, times, np.concatenate(self._shifts), noise, np.append(times, between))

        def part(which: slice) -> ReadingTable:
            estimates = {"filtered": series.filtered, "smoothed": series.smoothed}
            arrays = {
                name: (estimate.values[which], estimate.noise[which], estimate.total[which])
                for name, estimate in estimates.items()
            }
            estimated = estimates_of(arrays, self._cameras, self._ground)
            return reading_table(estimated, self._cameras, None, self._ground, prior)

        count = len(times)
        each = series.consistency.degrees // count
        at, rest = part(slice(count)), part(slice(count, None))
        test, jumps, false_alarm = series.consistency, series.jumps, prior.jump_false_alarm
        return SmoothedCourse(prior.name, at, between, rest, series.innovations, each, test, jumps, false_alarm)
