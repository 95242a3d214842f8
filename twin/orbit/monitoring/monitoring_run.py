"""Heights with and without on-board monitoring, from points intersected at a series of times.

The points are intersected with the cameras as calibrated, corrected with the monitor's readings, corrected with
readings interpolated over an interval, and with the true cameras. The analysis uses the calibrated lines, measured
orbit and attitude, image points and the monitor's readings. The truth is used to compute errors, and in two cases that
serve as bounds: correction with the true four parameters, and the true lines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2, norm

from analysis.arrays import ARCSEC
from analysis.monitor.disturbances import Consistency
from analysis.monitor.monitor_formulas import IntersectionAngleChange, exact
from analysis.orbit.forward_intersection import IntersectionError, between
from optics.geometry.tree import Motion, State, compose
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.specs.instrument import BASE
from scenes.specs.orbit.monitor import PARAMETERS
from twin.framework.procedure import Advance, BenchError, silent
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import Truth
from twin.orbit.flight.line_camera import LineCamera, calibrated_line, look_angle
from twin.orbit.monitoring import pair_flight
from twin.orbit.monitoring.loop_run import LoopRun, run_loop
from twin.orbit.monitoring.monitor_series import MonitorSeries, Readings, SmoothedReadings, states_of

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.monitor import OrbitMonitorSpec
    from scenes.specs.orbit.setup import MonitorSetup

FALSE_ALARM = 1e-4
"""Probability of a false alarm: a two-sided test reports correct sigmas as wrong."""


@dataclass(frozen=True, eq=False)
class Cause:
    """Effect of a single temperature or motion of the file on the two cameras and on the monitor's reading.

    Attributes
    ----------
    what : str
        "temperature" or "motion".
    path : str
        Path of the node.
    truth : Mapping[str, (4,) ndarray]
        Camera -> true changes since the reference, in rad (three angles) and m (principal distance).
    error : Mapping[str, (4,) ndarray]
        Camera -> noise-free reading of the monitor minus the truth, in rad (three angles) and m (principal distance).
    """

    what: str
    path: str
    truth: Mapping[str, np.ndarray]
    error: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Conversion:
    """Height change for a rotation of a camera by one arcsecond, in metres, at the reference time.

    Attributes
    ----------
    traced : Mapping[str, float]
        Camera -> height change, by ray trace, when this camera alone is rotated by 1 arcsec about its Y, in m.
    theory : Mapping[str, float]
        Camera -> height change from the base-to-height ratio, in m: slant range x 1 arcsec / cos(incidence), divided by
        the difference of the tangents of both angles of incidence.
    base_to_height : float
        Base-to-height ratio: the difference of these tangents.
    """

    traced: Mapping[str, float]
    theory: Mapping[str, float]
    base_to_height: float

    @property
    def of_angle(self) -> float:
        """Height change for a change of the intersection angle by 1 arcsec, half from each camera, in metres."""
        first, second = self.traced.values()
        return 0.5 * (first - second)

    @property
    def of_common(self) -> float:
        """Height change for a common rotation of both cameras by 1 arcsec, in metres; their angle does not change."""
        return float(sum(self.traced.values()))


@dataclass(frozen=True, eq=False)
class Scatter:
    """Height errors at one time due to the monitor's noise, over repeated measurements.

    Attributes
    ----------
    heights : (R,) ndarray for R repeats
        Mean height error due to the errors of the monitor's readings alone, in metres.
    sigma : float
        Standard deviation of the mean height propagated from the readings' predicted covariance, mean over the repeats,
        in metres.
    """

    heights: np.ndarray
    sigma: float

    @property
    def spread(self) -> float:
        """Standard deviation of the mean height over the repeated measurements, in metres."""
        return float(np.std(self.heights, ddof=1))

    @property
    def limits(self) -> tuple[float, float]:
        """Limits of `spread` / `sigma`, exceeded with a probability of `FALSE_ALARM` where `sigma` is right."""
        degrees = len(self.heights) - 1
        low, high = chi2.ppf([0.5 * FALSE_ALARM, 1.0 - 0.5 * FALSE_ALARM], degrees)
        return float(np.sqrt(low / degrees)), float(np.sqrt(high / degrees))

    @property
    def agrees(self) -> bool:
        """True if the ratio of observed to predicted standard deviation lies within `limits`."""
        low, high = self.limits
        return low < self.spread / self.sigma < high


@dataclass(frozen=True, eq=False)
class Smoothing:
    """Height errors with readings smoothed from the measurements at one interval.

    Attributes
    ----------
    case : CaseErrors
        Errors at the check points with smoothed readings.
    interpolated : CaseErrors
        Errors at the check points with readings interpolated between the same measurements.
    error : (T,) ndarray for T times
        Mean height error due to the errors of the smoothed readings, to first order, in metres.
    sigma : (T,) ndarray
        Standard deviation of that error according to the smoother, in metres; 0 at the reference.
    consistency : Consistency
        Chi-square test of the measured shifts against the prior.
    """

    case: pair_flight.CaseErrors
    interpolated: pair_flight.CaseErrors
    error: np.ndarray
    sigma: np.ndarray
    consistency: Consistency

    @property
    def factor(self) -> float:
        """RMS height error due to the cameras with interpolated readings, divided by that with smoothed readings."""
        return self.interpolated.camera_height_rms / self.case.camera_height_rms

    @property
    def ratios(self) -> np.ndarray:
        """Height errors divided by their sigma, at the times with a sigma above zero."""
        positive = self.sigma > 0.0
        return np.asarray(self.error[positive] / self.sigma[positive])

    @property
    def largest_ratio(self) -> float:
        """Largest absolute height error divided by its sigma."""
        return float(np.max(np.abs(self.ratios), initial=0.0))

    @property
    def limit(self) -> float:
        """Critical value of `largest_ratio`, exceeded with probability `FALSE_ALARM` at most, for any correlation."""
        return float(norm.isf(0.5 * FALSE_ALARM / max(len(self.ratios), 1)))

    @property
    def agrees(self) -> bool:
        """True if all height errors divided by their sigmas lie within the limit, as expected for correct sigmas."""
        return self.largest_ratio <= self.limit


@dataclass(frozen=True, eq=False)
class MonitorRun(pair_flight.PairFlight):
    """Results of a monitored orbit: truth and measurements at T times, and the resulting heights.

    Changes are relative to the reference, at which the lines were calibrated.

    Attributes
    ----------
    setup : MonitorSetup
        Resolved test file and instrument.
    seed : int
        Seed of all random numbers.
    looks : tuple of float
        Nominal look angles of the two cameras, in radians.
    truth : Mapping[str, (T, 4) ndarray]
        Camera -> true changes since the reference: rotations d_alpha, d_beta, d_gamma about the camera's Y, X and line
        of sight (rad), and change d_f of the principal distance (m).
    true_angle : (T,) ndarray
        True angle between the lines of sight, in radians.
    estimator : str
        Name of the estimator that is used for the monitor's shifts.
    monitored : Readings
        Changes since the reference that the monitor measured.
    together : Mapping[float, SmoothedReadings]
        Interval between measurements, in seconds -> changes smoothed from all measurements at this interval; empty
        without a prior.
    clean : Mapping[str, (T, 4) ndarray]
        Camera -> readings from expected images without noise.
    prisms : Mapping[str, (T, 4) ndarray]
        Camera -> readings without noise, due only to the temperatures that the file gives to the monitor's prisms.
    repeated : Readings
        Repeated readings of the monitor at time index `worst`.
    worst : int
        Index of the time with the largest change of the angle.
    causes : tuple of Cause
        Effect of each temperature and motion of the file alone at time index `worst`, without noise.
    rotated : Mapping[str, LineCamera]
        Camera -> its line at the reference with the whole camera rotated by 1 arcsec about its Y.
    doubts : tuple of str
        Warnings that the monitor's sigmas are not valid because its spots differ from the calibrated ones.
    """

    setup: MonitorSetup
    seed: int
    looks: tuple[float, float]
    truth: Mapping[str, np.ndarray]
    true_angle: np.ndarray
    estimator: str
    monitored: Readings
    together: Mapping[float, SmoothedReadings]
    clean: Mapping[str, np.ndarray]
    prisms: Mapping[str, np.ndarray]
    repeated: Readings
    worst: int
    causes: tuple[Cause, ...]
    rotated: Mapping[str, LineCamera]
    doubts: tuple[str, ...] = ()

    @property
    def spec(self) -> OrbitMonitorSpec:
        """Content of the test file."""
        return self.setup.test

    @property
    def mask(self) -> np.ndarray:
        """Mask (4,) of a camera's three rotations and principal distance: 1 for those that are corrected, else 0."""
        return np.array([float(name in self.spec.apply) for name in PARAMETERS])

    def height(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the mean height errors at T times, (T,), in m, due to errors (T, 4) of each camera's parameters."""
        return np.asarray(np.sum([np.sum(self.slopes[n] * values[n], axis=1) for n in self.pair], axis=0))

    def variance(self, covariance: np.ndarray, at: int | None = None) -> np.ndarray:
        """Return the variance of the mean height due to the pair's parameters, for S covariances, (S,), in m^2.

        Parameters
        ----------
        covariance : (S, 8, 8) ndarray
            Covariances of the 8 parameters of the pair, in rad and m.
        at : int, optional
            Index of the time to which all covariances belong; None for one covariance at each time.
        """
        both = np.concatenate([self.slopes[n] * self.mask for n in self.pair], axis=1)
        slope = both if at is None else both[at]
        return np.asarray(np.einsum("...i,...ij,...j->...", slope, covariance, slope))

    def applied(self, readings: Readings) -> dict[str, np.ndarray]:
        """Return the values that correct each camera in S states, (S, 4); 0 for parameters that are not applied."""
        return {name: readings[name].vector * self.mask for name in self.pair}

    def _interpolated(self, interval: float) -> pair_flight.CaseErrors:
        at = self.spec.measured(interval)
        applied = self.applied(self.monitored)
        return self.case({name: between(self.times, self.times[at], v[at]) for name, v in applied.items()})

    @cached_property
    def cases(self) -> Mapping[str, pair_flight.CaseErrors]:
        """Errors at the check points, by name of the method with which the cameras are corrected.

        none: cameras as calibrated; monitored: corrected with the monitor's readings at every time; interval: corrected
        with readings interpolated over the file's interval; smoothed: corrected with readings smoothed from the same
        measurements, if there is a prior; parameters: corrected with the true four parameters; true: the true lines.
        The last two are bounds that no measurement reaches.
        """
        cases = {
            "none": self.case({name: np.zeros((len(self.times), 4)) for name in self.pair}),
            "monitored": self.case(self.applied(self.monitored)),
            "interval": self._interpolated(self.spec.cadence),
        }
        if self.smoothing:
            cases["smoothed"] = self.smoothed.case
        return FrozenMap(cases | {"parameters": self.case(self.truth), "true": self.true_case})

    @cached_property
    def intervals(self) -> Mapping[float, pair_flight.CaseErrors]:
        """Errors at the check points with interpolated readings, by interval between measurements, in seconds."""
        return FrozenMap({interval: self._interpolated(interval) for interval in self.spec.compared})

    @cached_property
    def angle(self) -> IntersectionAngleChange:
        """Changes of the intersection angle that the monitor measures at T times, with their sigmas."""
        first, second = (self.monitored[name] for name in self.pair)
        return exact(first, second, *self.looks, *self.monitored.across)

    @property
    def angle_change(self) -> np.ndarray:
        """True change of the intersection angle since the reference at T times, (T,), in radians."""
        return np.asarray(self.true_angle - self.true_angle[self.spec.reference_index])

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation of the mean height at T times due to the noise of the monitor, (T,), in metres."""
        return np.sqrt(self.variance(self.monitored.noise))

    @property
    def sigma_total(self) -> np.ndarray | None:
        """Standard deviation of the mean height at T times due to all errors, (T,), in metres; None without a prior."""
        total = self.monitored.total
        return None if total is None else np.sqrt(self.variance(total))

    @cached_property
    def smoothing(self) -> Mapping[float, Smoothing]:
        """Height errors with smoothed readings, by interval between measurements, in seconds; empty without a prior."""
        return FrozenMap({interval: self._smoothing(interval) for interval in sorted(self.together)})

    @property
    def smoothed(self) -> Smoothing:
        """Height errors with readings smoothed from the measurements at the file's interval; requires a prior."""
        return self.smoothing[self.spec.cadence]

    def _smoothing(self, interval: float) -> Smoothing:
        smoothed, mask = self.together[interval], self.mask
        readings = smoothed.readings
        assert readings.total is not None
        case = self.case(self.applied(readings))
        error = self.height({n: mask * (readings[n].vector - self.truth[n]) for n in self.pair})
        # at the reference the variance is zero but for rounding
        variance = np.maximum(self.variance(readings.total), 0.0)
        interpolated = self.intervals[interval] if interval in self.intervals else self._interpolated(interval)
        return Smoothing(case, interpolated, error, np.sqrt(variance), smoothed.consistency)

    @cached_property
    def parts(self) -> Mapping[str, np.ndarray]:
        """Contributions to the corrected cameras' mean height error at T times: cause -> (T,) values, in metres."""

        def applied(values: Callable[[str], np.ndarray]) -> np.ndarray:
            return self.height({name: self.mask * values(name) for name in self.pair})

        cases = self.cases
        return FrozenMap(
            {
                "prisms": applied(lambda name: self.prisms[name]),
                "other_systematic": applied(lambda name: self.clean[name] - self.truth[name] - self.prisms[name]),
                "noise": applied(lambda name: self.monitored[name].vector - self.clean[name]),
                "not_applied": self.height({n: -self.truth[n] * (1.0 - self.mask) for n in self.pair}),
                "beyond_parameters": cases["parameters"].camera,
                "interpolation": cases["interval"].camera - cases["monitored"].camera,
            }
        )

    @cached_property
    def conversion(self) -> Conversion:
        """Height change for a rotation of a camera by an arcsecond, at the reference time."""
        k = self.spec.reference_index
        view, traced = self.views[k], {}
        first, second = self.pair
        calm = pair_flight.point_errors(self.true_pair(k), view, exact_data=True)[:, 2].mean()
        slant, incidence = {}, {}
        up = view.ground / np.linalg.norm(view.ground, axis=1, keepdims=True)
        for i, name in enumerate(self.pair):
            pair = self.true_pair(k)
            pair[i] = pair_flight.in_calibrated_form(self.rotated[name], self.calibrated[name])
            traced[name] = float(pair_flight.point_errors(pair, view, exact_data=True)[:, 2].mean() - calm)
            arm = view.exact[i].station - view.ground
            slant[name] = np.linalg.norm(arm, axis=1)
            forward = np.cross(up, view.exact[i].attitude[:, :, 1])  # along the track, level
            incidence[name] = np.arctan2(-np.sum(arm * forward, axis=1), np.sum(arm * up, axis=1))
        ratio = np.tan(incidence[first]) - np.tan(incidence[second])
        # a ray assumed to look farther forward passes above the point, and intersects the other ray higher, the more
        # that one comes from ahead
        theory = {
            name: float(np.mean(sign * slant[name] * ARCSEC / np.cos(incidence[name]) / ratio))
            for name, sign in ((first, 1.0), (second, -1.0))
        }
        return Conversion(FrozenMap(traced), FrozenMap(theory), float(np.mean(np.abs(ratio))))

    @cached_property
    def scatter(self) -> Scatter:
        """Scatter of the heights over repeated measurements of the monitor, with exact image points.

        Only the monitor's noise contributes.
        """
        monitored, heights = self.applied(self.repeated), []
        for row in range(self.spec.repeats):
            pair = [self.calibrated[n].corrected(monitored[n][row]) for n in self.pair]
            heights.append(pair_flight.point_errors(pair, self.views[self.worst], exact_data=True)[:, 2].mean())
        variance = self.variance(self.repeated.noise, self.worst)
        return Scatter(np.array(heights), float(np.sqrt(np.mean(variance))))

    @cached_property
    def residual(self) -> float:
        """Largest angle between true lines of sight and those corrected with the true four parameters, in radians.

        It is the error of a model with four parameters per camera; the maximum is over pixels and times.
        """
        away = []
        for k, lines in enumerate(self.lines):
            for name, line in lines.items():
                pixel = np.linspace(0.0, line.pixels - 1.0, 101)
                model = self.calibrated[name].corrected(self.truth[name][k]).look(pixel)
                away.append(float(np.max(np.linalg.norm(model - line.look(pixel), axis=-1))))
        return max(away)

    def cause_heights(self, cause: Cause) -> tuple[float, float]:
        """Return the height errors due to one cause, in metres: without monitoring, and due to the monitor's error."""
        slopes = {n: self.slopes[n][self.worst] for n in self.pair}
        without = sum(float(-slopes[n] @ cause.truth[n]) for n in self.pair)
        return without, sum(float(slopes[n] @ (self.mask * cause.error[n])) for n in self.pair)


def run_monitor(setup: MonitorSetup, backend: Backend, seed: int, advance: Advance = silent) -> MonitorRun | LoopRun:
    """Simulate a monitored stereo pair and intersect its points: ``python -m twin.orbit monitor``.

    If the file has mechanisms, the closed loop of monitor and mechanisms is simulated instead.

    Raises
    ------
    InputError
        A node is unknown, the instrument does not have a mechanism, or a temperature is impossible.
    BenchError
        The test cannot be carried out as its file describes it.
    """
    spec = setup.test
    try:
        if spec.mechanisms is not None:
            return run_loop(setup, backend, seed, advance)
        run = simulate_monitoring(setup, backend, seed, advance)
        # intersections that fail raise here
        run.cases, run.intervals, run.conversion, run.scatter  # noqa: B018
        return run
    except (AimError, BeamMissedError) as error:
        raise BenchError(f"the instrument cannot be rendered: {error}", spec.times_key, pair_flight.TOO_FAR) from error
    except IntersectionError as error:
        raise BenchError(str(error), ("cameras",), "cameras with different look angles") from error


def simulate_monitoring(setup: MonitorSetup, backend: Backend, seed: int, advance: Advance) -> MonitorRun:
    """Trace, render and measure the monitored pair at all times of the test.

    Raises
    ------
    InputError
        A node is unknown or a temperature is impossible.
    BenchError
        The test cannot be carried out as its file describes it.
    AimError, BeamMissedError
        Light is lost.
    """
    spec, pair = setup.test, setup.pair
    ground_seed, monitor_seed = np.random.SeedSequence(seed).spawn(2)
    number = int(np.random.default_rng(monitor_seed).integers(2**31))
    parts = 6
    advance("monitor", 0, parts)
    experiment = MonitorExperiment(setup.resolved, backend)
    spec.check_nodes(experiment.instrument.nodes)
    states = states_of(experiment, spec)
    advance("monitor", 1, parts)
    reference = states[spec.reference_index]
    bodies = {body.path: body for body in experiment.instrument.assembly.tree.bodies}

    def rotated_state(camera: str) -> State:
        return compose(reference, {f"{BASE}/{camera}": Motion((0.0, ARCSEC, 0.0))}, bodies)

    lines = tuple(pair_flight.traced_pair(experiment, state, pair) for state in states)
    by_arcsec = {name: pair_flight.traced_pair(experiment, rotated_state(name), pair)[name] for name in pair}
    advance("monitor", 2, parts)
    angle = np.array([look_angle(line[pair[0]], line[pair[1]]) for line in lines])
    worst = int(np.argmax(np.abs(angle - angle[spec.reference_index])))
    # computed before the images, which take longer, so that errors appear early
    views = pair_flight.view_check_points(spec, pair, lines, ground_seed, advance)
    monitor = MonitorSeries(experiment, spec, reference, pair)
    noisy, clean = monitor.measured(states, number)
    truth, distance = _changes(clean.truth, spec.reference_index)
    used = noisy if spec.errors.switched_on and spec.errors.monitor else clean
    gains = monitor.gains(used, range(len(states)))
    advance("monitor", 3, parts)
    prisms = monitor.prism_shifts()
    advance("monitor", 4, parts)
    repeated = monitor.repeated(states[worst], spec.repeats, number + 1, worst)
    advance("monitor", 5, parts)
    causes = _causes(experiment, spec, monitor, worst, gains[worst])
    advance("monitor", 6, parts)
    axes, smoothed = experiment.sight.axes, {}
    if experiment.disturbances is not None:
        smoothed = {interval: monitor.smoothed(used, interval) for interval in {spec.cadence, *spec.compared}}
    return MonitorRun(
        pair,
        np.array(spec.times),
        lines,
        FrozenMap({n: calibrated_line(lines[spec.reference_index][n], axes[n], distance[n]) for n in pair}),
        views,
        setup,
        seed,
        (experiment.instrument.spec.cameras[pair[0]].look, experiment.instrument.spec.cameras[pair[1]].look),
        FrozenMap({name: truth[name] for name in pair}),
        angle,
        monitor.estimator,
        monitor.readings(used, range(len(states))),
        FrozenMap(smoothed),
        FrozenMap(monitor.estimates_by_camera(gains, clean.shifts)),
        FrozenMap(monitor.estimates_by_camera(gains, prisms)),
        monitor.readings(repeated, [worst] * spec.repeats),
        worst,
        causes,
        FrozenMap(by_arcsec),
        used.doubts(spec.times, [channel.key for channel in experiment.path.channels]),
    )


def _changes(truths: Sequence[Truth], reference: int) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return each camera's true changes (T, 4) since the reference at T times, and its principal distance then.

    The ray trace gives changes relative to the nominal camera. Their differences are the changes between two states,
    except for products of two small angles, 1e-11 rad.
    """
    changes, distance = {}, {}
    for name in truths[0].cameras:
        cameras = [truth.cameras[name] for truth in truths]
        values = np.concatenate([change.vector for change in cameras])
        changes[name] = values - values[reference]
        distance[name] = float(np.concatenate([c.principal_distance for c in cameras])[reference])
    return changes, distance


def _causes(
    experiment: MonitorExperiment, spec: OrbitMonitorSpec, monitor: MonitorSeries, worst: int, gain: np.ndarray
) -> tuple[Cause, ...]:
    """Return the effect of each single temperature and motion of the file, from the reference to one time.

    Parameters
    ----------
    experiment : MonitorExperiment
        Instrument with its monitor.
    spec : OrbitMonitorSpec
        Content of the test file.
    monitor : MonitorSeries
        Monitor with its reference images.
    worst : int
        Index of the time.
    gain : (8, 2 C) ndarray
        Gain of the estimator for C spots at that time: 8 parameters of the pair, in rad and m per px of the spots'
        shifts.
    """
    assert spec.course is not None
    named = [("temperature", path) for path in spec.course.temperature] + [("motion", path) for path in spec.motion]
    states = [
        s for what, path in named for s in states_of(experiment, spec, (spec.reference_index, worst), (what, path))
    ]
    measured = monitor.clean(states)
    truth, _ = _changes(measured.truth, 0)
    estimates = monitor.estimates_by_camera(gain, measured.shifts)
    causes = []
    for k, (what, path) in enumerate(named):
        true, read = ({n: v[n][2 * k + 1] - v[n][2 * k] for n in monitor.pair} for v in (truth, estimates))
        error = {n: read[n] - true[n] for n in monitor.pair}
        causes.append(Cause(what, path, FrozenMap(true), FrozenMap(error)))
    return tuple(causes)
