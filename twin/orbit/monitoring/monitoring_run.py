"""Heights with and without on-board monitoring: points of every time intersected by cameras as calibrated, corrected by
the monitor, corrected by values interpolated over an interval, and as they truly are.

The analysis gets calibrated lines, measured orbit and attitude, image points and the monitor's values. Truth enters
where errors are counted, and in two cases that are bounds: the true four parameters, and the true lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2, norm

from analysis.arrays import ARCSEC
from analysis.monitor.disturbances import Consistency
from analysis.monitor.monitoring import exact
from analysis.orbit.forward_intersection import IntersectionError, between
from optics.geometry.tree import Motion, State, compose
from optics.numerics.number_tree import FrozenMap
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.specs.instrument import BASE
from scenes.specs.orbit.monitor import PARAMETERS
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.truth import Truth
from twin.orbit.flight.line_camera import LineCamera, calibrated_line, look_angle
from twin.orbit.monitoring.loop_run import LoopRun, run_loop
from twin.orbit.monitoring.monitor_series import MonitorSeries, Readings, SmoothedReadings, states_of
from twin.orbit.monitoring.pair_flight import (
    TOO_FAR,
    CaseErrors,
    PairFlight,
    in_analysis,
    look_down,
    point_errors,
    traced_pair,
)
from twin.run.procedure import Advance, BenchError, silent

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.monitor import OrbitMonitorSpec
    from scenes.specs.orbit.setup import MonitorSetup

CASES = ("none", "monitored", "interval", "smoothed", "parameters", "true")
"""Cases of the line geometry: as calibrated; corrected at every time; corrected by values interpolated over the file's
interval; by values smoothed from the same measurements, if there is a prior; by the true four parameters; the true
lines. The last two are bounds that no measurement gives.
"""
FALSE_ALARM = 1e-4
"""Chance that right sigmas are called wrong, both sides together."""


@dataclass(frozen=True, eq=False)
class Cause:
    """One entry of the file alone, all others without effect.

    Attributes:
        what: temperature or motion.
        path: of the node.
        truth: camera -> (4,) true changes since the reference.
        error: camera -> (4,) what the monitor says, without noise, minus the truth.
    """

    what: str
    path: str
    truth: Mapping[str, np.ndarray]
    error: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class MonitorFlight(PairFlight):
    """Truth and measurements at T times, counted from the reference, at which the lines were calibrated.

    Attributes:
        spec: the test.
        looks: nominal look angles of the two cameras, radians.
        truth: camera -> (T, 4) true d_alpha, d_beta, d_gamma (rad) and d_f (m) since the reference.
        angle: (T,) true angle between the lines of sight, radians.
        estimator: by which the monitor's shifts are read.
        monitored: what the monitor says of the cameras' changes since the reference.
        smoothed: seconds -> what all its measurements at this interval say together; empty where nothing is stated to
            move.
        clean: camera -> (T, 4) as monitored, from expected images without noise.
        prisms: camera -> (T, 4) what temperatures that the file gives to prisms alone make it say, without noise.
        repeated: what the monitor says at time `worst`, measured again and again.
        worst: number of the time with the largest change of the angle.
        causes: what each temperature and motion of the file does alone at time `worst`, without noise.
        turned: camera -> its line at the reference when the whole camera is turned by 1 arcsec about its Y.
        doubts: where the monitor's sigmas do not hold, for its spots are not as calibrated.
    """

    spec: OrbitMonitorSpec
    looks: tuple[float, float]
    truth: Mapping[str, np.ndarray]
    angle: np.ndarray
    estimator: str
    monitored: Readings
    smoothed: Mapping[float, SmoothedReadings]
    clean: Mapping[str, np.ndarray]
    prisms: Mapping[str, np.ndarray]
    repeated: Readings
    worst: int
    causes: tuple[Cause, ...]
    turned: Mapping[str, LineCamera]
    doubts: tuple[str, ...] = ()

    @property
    def mask(self) -> np.ndarray:
        """(4,) 1 for parameters that are applied."""
        return np.array([float(name in self.spec.apply) for name in PARAMETERS])

    def height(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """(T,) of the mean height, metres, by parameters (T, 4) of each camera that the analysis is told too much."""
        every = [np.sum(self.slopes[n] * values[n], axis=1) for n in self.pair]
        return np.asarray(np.sum(every, axis=0))

    def variance(self, covariance: np.ndarray, at: int | None = None) -> np.ndarray:
        """Variance (S,) of the mean height by the pair's values, m^2.

        Args:
            covariance: (S, 8, 8) of the pair's values.
            at: number of the time to which all of them belong; None for one of each time.
        """
        both = np.concatenate([self.slopes[n] * self.mask for n in self.pair], axis=1)
        slope = both if at is None else both[at]
        return np.asarray(np.einsum("...i,...ij,...j->...", slope, covariance, slope))


def fly_monitored(setup: MonitorSetup, backend: Backend, seed: int, advance: Advance) -> MonitorFlight:
    """Trace, render, measure, look down.

    Raises:
        InputError: an unknown node or an impossible temperature.
        BenchError: the test cannot be carried out as its file says.
        AimError, BeamMissedError: light is lost.
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
    reference, bodies = states[spec.referred], {body.path: body for body in experiment.instrument.assembly.tree.bodies}

    def turned(camera: str) -> State:
        return compose(reference, {f"{BASE}/{camera}": Motion((0.0, ARCSEC, 0.0))}, bodies)

    lines = tuple(traced_pair(experiment, state, pair) for state in states)
    by_arcsec = {name: traced_pair(experiment, turned(name), pair)[name] for name in pair}
    advance("monitor", 2, parts)
    angle = np.array([look_angle(line[pair[0]], line[pair[1]]) for line in lines])
    worst = int(np.argmax(np.abs(angle - angle[spec.referred])))
    # before the images, which take longer
    views = look_down(spec, pair, lines, ground_seed, advance)
    monitor = MonitorSeries(experiment, spec, reference, pair)
    noisy, clean = monitor.measured(states, number)
    truth, distance = _changes(clean.truth, spec.referred)
    used = noisy if spec.errors.switched_on and spec.errors.monitor else clean
    gains = monitor.gains(used, range(len(states)))
    advance("monitor", 3, parts)
    prisms = monitor.of_prisms()
    advance("monitor", 4, parts)
    repeated = monitor.repeated(states[worst], spec.repeats, number + 1, worst)
    advance("monitor", 5, parts)
    causes = _causes(experiment, spec, monitor, worst, gains[worst])
    advance("monitor", 6, parts)
    axes, smoothed = experiment.sight.axes, {}
    if experiment.disturbances is not None:
        smoothed = {interval: monitor.smoothed(used, interval) for interval in {spec.every, *spec.compared}}
    return MonitorFlight(
        pair,
        np.array(spec.times),
        lines,
        FrozenMap({n: calibrated_line(lines[spec.referred][n], axes[n], distance[n]) for n in pair}),
        views,
        spec,
        (experiment.instrument.spec.cameras[pair[0]].look, experiment.instrument.spec.cameras[pair[1]].look),
        FrozenMap({name: truth[name] for name in pair}),
        angle,
        monitor.estimator,
        monitor.readings(used, range(len(states))),
        FrozenMap(smoothed),
        FrozenMap(monitor.by_camera(gains, clean.shifts)),
        FrozenMap(monitor.by_camera(gains, prisms)),
        monitor.readings(repeated, [worst] * spec.repeats),
        worst,
        causes,
        FrozenMap(by_arcsec),
        used.doubts(spec.times, [channel.key for channel in experiment.path.channels]),
    )


def _changes(truths: Sequence[Truth], reference: int) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Camera -> (T, 4) true changes since the reference, and camera -> principal distance there.

    The trace refers changes to the nominal camera; their differences are those between two states but for products of
    two arcseconds, 1e-11 rad.
    """
    out, distance = {}, {}
    for name in truths[0].cameras:
        every = [one.cameras[name] for one in truths]
        values = np.concatenate([change.vector for change in every])
        out[name] = values - values[reference]
        distance[name] = float(np.concatenate([c.principal_distance for c in every])[reference])
    return out, distance


def _causes(
    experiment: MonitorExperiment, spec: OrbitMonitorSpec, monitor: MonitorSeries, worst: int, gain: np.ndarray
) -> tuple[Cause, ...]:
    """Return what each temperature of the course and each motion does from the reference to time number ``worst``, at
    which the estimator has this gain (8, 2 C).
    """
    assert spec.course is not None
    named = [("temperature", path) for path in spec.course.temperature] + [("motion", path) for path in spec.motion]
    states = [s for what, path in named for s in states_of(experiment, spec, (spec.referred, worst), (what, path))]
    found = monitor.clean(states)
    truth, _ = _changes(found.truth, 0)
    estimates = monitor.by_camera(gain, found.shifts)
    out = []
    for k, (what, path) in enumerate(named):
        true, read = ({n: v[n][2 * k + 1] - v[n][2 * k] for n in monitor.pair} for v in (truth, estimates))
        error = {n: read[n] - true[n] for n in monitor.pair}
        out.append(Cause(what, path, FrozenMap(true), FrozenMap(error)))
    return tuple(out)


@dataclass(frozen=True, eq=False)
class Conversion:
    """Metres of height for one arcsecond, at the reference time.

    Attributes:
        traced: camera -> height change when this camera alone is turned by 1 arcsec about its Y, by the trace, m.
        theory: camera -> the same by base to height: slant range x 1 arcsec / cos(incidence) over the difference of the
            tangents of both incidences, m.
        base_to_height: that difference.
    """

    traced: Mapping[str, float]
    theory: Mapping[str, float]
    base_to_height: float

    @property
    def of_angle(self) -> float:
        """Metres per arcsec of the angle when both cameras turn by half of it against one another."""
        first, second = self.traced.values()
        return 0.5 * (first - second)

    @property
    def of_common(self) -> float:
        """Metres per arcsec by which both cameras turn alike, which leaves the angle as it is."""
        return float(sum(self.traced.values()))


@dataclass(frozen=True, eq=False)
class Scatter:
    """Height errors of one time's points when the monitor measures again and again.

    Attributes:
        heights: (R,) mean height error from the monitor's values alone, metres.
        sigma: by propagation of the claimed covariance, metres, mean over the repeats.
    """

    heights: np.ndarray
    sigma: float

    @property
    def spread(self) -> float:
        """Standard deviation seen, metres."""
        return float(np.std(self.heights, ddof=1))

    @property
    def limits(self) -> tuple[float, float]:
        """Limits of spread / sigma, exceeded with a chance of `FALSE_ALARM`."""
        free = len(self.heights) - 1
        low, high = chi2.ppf([0.5 * FALSE_ALARM, 1.0 - 0.5 * FALSE_ALARM], free)
        return float(np.sqrt(low / free)), float(np.sqrt(high / free))

    @property
    def agrees(self) -> bool:
        """The spread lies within the limits."""
        low, high = self.limits
        return low < self.spread / self.sigma < high


@dataclass(frozen=True, eq=False)
class Smoothing:
    """Heights by values smoothed from the measurements at one interval.

    Attributes:
        case: errors.
        interpolated: errors with values interpolated between the same measurements.
        error: (T,) mean height error by what the smoothed values are wrong, to first order, metres.
        sigma: (T,) of the same as the smoother states it, metres; 0 at the reference.
        consistency: chi-square of the measured shifts under the stated disturbances.
    """

    case: CaseErrors
    interpolated: CaseErrors
    error: np.ndarray
    sigma: np.ndarray
    consistency: Consistency

    @property
    def factor(self) -> float:
        """Factor by which the height error of the cameras is smaller than with interpolation."""
        return self.interpolated.camera_height_rms / self.case.camera_height_rms

    @property
    def ratios(self) -> np.ndarray:
        """Errors over their sigma, of the times at which there is one."""
        known = self.sigma > 0.0
        return np.asarray(self.error[known] / self.sigma[known])

    @property
    def furthest(self) -> float:
        """Largest of all ratios."""
        return float(np.max(np.abs(self.ratios), initial=0.0))

    @property
    def limit(self) -> float:
        """Limit of the largest ratio, exceeded with a chance of `FALSE_ALARM` at most whatever the correlations."""
        return float(norm.isf(0.5 * FALSE_ALARM / max(len(self.ratios), 1)))

    @property
    def agrees(self) -> bool:
        """No error lies beyond the limit."""
        return self.furthest <= self.limit


@dataclass(frozen=True, eq=False)
class MonitorRun:
    """A finished test.

    Attributes:
        setup: what its file says.
        seed: of all random numbers.
        flight: truth and measurements.
        cases: of `CASES` -> errors.
        intervals: seconds -> errors with values interpolated over it.
        angle: (T,) change of the intersection angle by the monitor, radians; angle_sigma: of its error, angle_noise: of
            that what the noise does.
        sigma: (T,) of the mean height by the noise of the monitor, propagated, metres.
        sigma_total: (T,) likewise of the whole error; None where nothing is stated to move.
        smoothing: seconds -> heights smoothed from measurements at this interval; empty likewise.
        parts: name -> (T,) parts of the monitored cameras' mean height error, metres.
        conversion: arcseconds to metres.
        scatter: of repeated measurements.
        residual: largest angle between a true line and the calibrated one corrected by the true four parameters, over
            the line and all times, radians.
    """

    setup: MonitorSetup
    seed: int
    flight: MonitorFlight
    cases: Mapping[str, CaseErrors]
    intervals: Mapping[float, CaseErrors]
    angle: np.ndarray
    angle_sigma: np.ndarray
    angle_noise: np.ndarray
    sigma: np.ndarray
    sigma_total: np.ndarray | None
    smoothing: Mapping[float, Smoothing]
    parts: Mapping[str, np.ndarray]
    conversion: Conversion
    scatter: Scatter
    residual: float

    @property
    def angle_change(self) -> np.ndarray:
        """(T,) true, radians."""
        return np.asarray(self.flight.angle - self.flight.angle[self.flight.spec.referred])

    @property
    def smoothed(self) -> Smoothing:
        """Heights smoothed from the measurements at the file's interval; there is none without a prior."""
        return self.smoothing[self.flight.spec.every]

    def cause_heights(self, cause: Cause) -> tuple[float, float]:
        """Height errors that a cause alone makes at its time, metres: without monitoring, and by what the monitor
        misreads.
        """
        flight, mask = self.flight, self.flight.mask
        slopes = {n: flight.slopes[n][flight.worst] for n in flight.pair}
        without = sum(float(-slopes[n] @ cause.truth[n]) for n in flight.pair)
        return without, sum(float(slopes[n] @ (mask * cause.error[n])) for n in flight.pair)


def run_monitor(setup: MonitorSetup, backend: Backend, seed: int, advance: Advance = silent) -> MonitorRun | LoopRun:
    """Fly, measure, intersect: ``python -m twin.orbit monitor``; with mechanisms the loop is closed.

    Raises:
        InputError: an unknown node, a mechanism that the instrument does not have, or an impossible temperature.
        BenchError: the test cannot be carried out as its file says.
    """
    spec = setup.test
    try:
        if spec.mechanisms is not None:
            return run_loop(setup, backend, seed, advance)
        return _analysed(fly_monitored(setup, backend, seed, advance), setup, seed)
    except (AimError, BeamMissedError) as error:
        raise BenchError(f"the instrument cannot be rendered: {error}", spec.times_key, TOO_FAR) from error
    except IntersectionError as error:
        raise BenchError(str(error), ("cameras",), "cameras that look different ways") from error


def _analysed(flight: MonitorFlight, setup: MonitorSetup, seed: int) -> MonitorRun:
    """All cases of a flight."""
    count, spec = len(flight.times), flight.spec
    monitored = {n: flight.monitored[n].vector * flight.mask for n in flight.pair}

    def interpolated(interval: float) -> CaseErrors:
        at = spec.measured(interval)
        return flight.case({n: between(flight.times, flight.times[at], v[at]) for n, v in monitored.items()})

    cases = {
        "none": flight.case({n: np.zeros((count, 4)) for n in flight.pair}),
        "monitored": flight.case(monitored),
        "interval": interpolated(spec.every),
        "parameters": flight.case(flight.truth),
        "true": flight.true_case,
    }
    intervals = {interval: interpolated(interval) for interval in spec.compared}
    smoothing = {
        interval: _smoothing(flight, interval, intervals.get(interval, cases["interval"]))
        for interval in sorted(flight.smoothed)
    }
    if smoothing:
        cases["smoothed"] = smoothing[spec.every].case
    first, second = (flight.monitored[n] for n in flight.pair)
    angle = exact(first, second, *flight.looks, *flight.monitored.across)
    total = flight.monitored.total
    return MonitorRun(
        setup,
        seed,
        flight,
        FrozenMap({name: cases[name] for name in CASES if name in cases}),
        FrozenMap(intervals),
        angle.change_rad,
        angle.sigma_rad,
        angle.noise_rad,
        np.sqrt(flight.variance(flight.monitored.noise)),
        None if total is None else np.sqrt(flight.variance(total)),
        FrozenMap(smoothing),
        FrozenMap(_parts(flight, cases)),
        _conversion(flight),
        _scatter(flight),
        max(_residual(flight, n, k) for n in flight.pair for k in range(count)),
    )


def _smoothing(flight: MonitorFlight, interval: float, interpolated: CaseErrors) -> Smoothing:
    found = flight.smoothed[interval]
    readings, mask = found.readings, flight.mask
    assert readings.total is not None
    case = flight.case({n: readings[n].vector * mask for n in flight.pair})
    wrong = flight.height({n: mask * (readings[n].vector - flight.truth[n]) for n in flight.pair})
    # what rounding leaves at the reference is no sigma
    variance = np.maximum(flight.variance(readings.total), 0.0)
    return Smoothing(case, interpolated, wrong, np.sqrt(variance), found.consistency)


def _parts(flight: MonitorFlight, cases: Mapping[str, CaseErrors]) -> dict[str, np.ndarray]:
    def applied(values: Mapping[str, np.ndarray]) -> np.ndarray:
        return flight.height({n: flight.mask * values[n] for n in flight.pair})

    system = {n: flight.clean[n] - flight.truth[n] for n in flight.pair}
    return {
        "prisms": applied(flight.prisms),
        "other_systematic": applied({n: system[n] - flight.prisms[n] for n in flight.pair}),
        "noise": applied({n: flight.monitored[n].vector - flight.clean[n] for n in flight.pair}),
        "not_applied": flight.height({n: -flight.truth[n] * (1.0 - flight.mask) for n in flight.pair}),
        "beyond_parameters": cases["parameters"].camera,
        "interpolation": cases["interval"].camera - cases["monitored"].camera,
    }


def _conversion(flight: MonitorFlight) -> Conversion:
    """At the reference, where the calibrated cameras are the true ones."""
    k = flight.spec.referred
    view, traced = flight.views[k], {}
    first, second = flight.pair
    calm = point_errors(flight.true_pair(k), view, exact_data=True)[:, 2].mean()
    slant, incidence = {}, {}
    up = view.ground / np.linalg.norm(view.ground, axis=1, keepdims=True)
    for i, name in enumerate(flight.pair):
        pair = flight.true_pair(k)
        pair[i] = in_analysis(flight.turned[name], flight.calibrated[name])
        traced[name] = float(point_errors(pair, view, exact_data=True)[:, 2].mean() - calm)
        arm = view.exact[i].station - view.ground
        slant[name] = np.linalg.norm(arm, axis=1)
        forward = np.cross(up, view.exact[i].attitude[:, :, 1])  # along the track, level
        incidence[name] = np.arctan2(-np.sum(arm * forward, axis=1), np.sum(arm * up, axis=1))
    ratio = np.tan(incidence[first]) - np.tan(incidence[second])
    # a ray that is taken to look farther forward passes above the point, and the other ray is met the higher, the more
    # it comes from ahead
    theory = {
        name: float(np.mean(sign * slant[name] * ARCSEC / np.cos(incidence[name]) / ratio))
        for name, sign in ((first, 1.0), (second, -1.0))
    }
    return Conversion(FrozenMap(traced), FrozenMap(theory), float(np.mean(np.abs(ratio))))


def _scatter(flight: MonitorFlight) -> Scatter:
    """Exact image points, so that the monitor's noise is all there is."""
    k = flight.worst
    monitored = {n: flight.repeated[n].vector * flight.mask for n in flight.pair}
    heights = []
    for row in range(flight.spec.repeats):
        pair = [flight.calibrated[n].corrected(monitored[n][row]) for n in flight.pair]
        heights.append(point_errors(pair, flight.views[k], exact_data=True)[:, 2].mean())
    variance = flight.variance(flight.repeated.noise, k)
    return Scatter(np.array(heights), float(np.sqrt(np.mean(variance))))


def _residual(flight: MonitorFlight, name: str, k: int) -> float:
    pixel = np.linspace(0.0, flight.lines[k][name].pixels - 1.0, 101)
    model = flight.calibrated[name].corrected(flight.truth[name][k]).look(pixel)
    return float(np.max(np.linalg.norm(model - flight.lines[k][name].look(pixel), axis=-1)))
