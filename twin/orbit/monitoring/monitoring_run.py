"""Heights with and without on-board monitoring: points of every time intersected by cameras as calibrated, corrected by
the monitor, corrected by values interpolated over an interval, and as they truly are.

The analysis gets calibrated lines, measured orbit and attitude, image points and the monitor's values. Truth enters
where errors are counted, and in two cases that are bounds: the true four parameters, and the true lines.
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

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.monitor import OrbitMonitorSpec
    from scenes.specs.orbit.setup import MonitorSetup

FALSE_ALARM = 1e-4
"""Chance that right sigmas are called wrong, both sides together."""


@dataclass(frozen=True, eq=False)
class Cause:
    """One entry of the file alone, all others without effect.

    Attributes
    ----------
    what : str
        Temperature or motion.
    path : str
        Of the node.
    truth : Mapping[str, np.ndarray]
        Camera -> (4,) true changes since the reference.
    error : Mapping[str, np.ndarray]
        Camera -> (4,) what the monitor says, without noise, minus the truth.
    """

    what: str
    path: str
    truth: Mapping[str, np.ndarray]
    error: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Conversion:
    """Metres of height for one arcsecond, at the reference time.

    Attributes
    ----------
    traced : Mapping[str, float]
        Camera -> height change when this camera alone is turned by 1 arcsec about its Y, by the trace, m.
    theory : Mapping[str, float]
        Camera -> the same by base to height: slant range x 1 arcsec / cos(incidence) over the difference of the
        tangents of both incidences, m.
    base_to_height : float
        That difference.
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

    Attributes
    ----------
    heights : np.ndarray
        (R,) mean height error from the monitor's values alone, metres.
    sigma : float
        By propagation of the claimed covariance, metres, mean over the repeats.
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

    Attributes
    ----------
    case : CaseErrors
        errors.
    interpolated : CaseErrors
        Errors with values interpolated between the same measurements.
    error : np.ndarray
        (T,) mean height error by what the smoothed values are wrong, to first order, metres.
    sigma : np.ndarray
        (T,) of the same as the smoother states it, metres; 0 at the reference.
    consistency : Consistency
        Chi-square of the measured shifts under the stated disturbances.
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
class MonitorRun(PairFlight):
    """A finished test: truth and measurements at T times, counted from the reference, at which the lines were
    calibrated, and what follows from them for heights.

    Attributes
    ----------
    setup : MonitorSetup
        What its file says.
    seed : int
        Of all random numbers.
    looks : tuple[float, float]
        Nominal look angles of the two cameras, radians.
    truth : Mapping[str, np.ndarray]
        Camera -> (T, 4) true d_alpha, d_beta, d_gamma (rad) and d_f (m) since the reference.
    true_angle : np.ndarray
        (T,) true angle between the lines of sight, radians.
    estimator : str
        By which the monitor's shifts are read.
    monitored : Readings
        What the monitor says of the cameras' changes since the reference.
    together : Mapping[float, SmoothedReadings]
        Seconds -> what all its measurements at this interval say together; empty where nothing is stated to move.
    clean : Mapping[str, np.ndarray]
        Camera -> (T, 4) as monitored, from expected images without noise.
    prisms : Mapping[str, np.ndarray]
        Camera -> (T, 4) what temperatures that the file gives to prisms alone make it say, without noise.
    repeated : Readings
        What the monitor says at time `worst`, measured again and again.
    worst : int
        Number of the time with the largest change of the angle.
    causes : tuple[Cause, ...]
        What each temperature and motion of the file does alone at time `worst`, without noise.
    turned : Mapping[str, LineCamera]
        Camera -> its line at the reference when the whole camera is turned by 1 arcsec about its Y.
    doubts : tuple[str, ...]
        Where the monitor's sigmas do not hold, for its spots are not as calibrated.
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
    turned: Mapping[str, LineCamera]
    doubts: tuple[str, ...] = ()

    @property
    def spec(self) -> OrbitMonitorSpec:
        """The test."""
        return self.setup.test

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

        Parameters
        ----------
        covariance : np.ndarray
            (S, 8, 8) of the pair's values.
        at : int | None
            Number of the time to which all of them belong; None for one of each time.
        """
        both = np.concatenate([self.slopes[n] * self.mask for n in self.pair], axis=1)
        slope = both if at is None else both[at]
        return np.asarray(np.einsum("...i,...ij,...j->...", slope, covariance, slope))

    def applied(self, readings: Readings) -> dict[str, np.ndarray]:
        """Camera -> (S, 4) values that correct it: of the parameters that are applied."""
        return {name: readings[name].vector * self.mask for name in self.pair}

    def _interpolated(self, interval: float) -> CaseErrors:
        at = self.spec.measured(interval)
        every = self.applied(self.monitored)
        return self.case({name: between(self.times, self.times[at], v[at]) for name, v in every.items()})

    @cached_property
    def cases(self) -> Mapping[str, CaseErrors]:
        """Errors by what corrects the cameras.

        none: as calibrated; monitored: at every time; interval: by values interpolated over the file's interval;
        smoothed: by values smoothed from the same measurements, if there is a prior; parameters: by the true four
        parameters; true: the true lines. The last two are bounds that no measurement gives.
        """
        found = {
            "none": self.case({name: np.zeros((len(self.times), 4)) for name in self.pair}),
            "monitored": self.case(self.applied(self.monitored)),
            "interval": self._interpolated(self.spec.every),
        }
        if self.smoothing:
            found["smoothed"] = self.smoothed.case
        return FrozenMap(found | {"parameters": self.case(self.truth), "true": self.true_case})

    @cached_property
    def intervals(self) -> Mapping[float, CaseErrors]:
        """Seconds -> errors with values interpolated over the interval."""
        return FrozenMap({interval: self._interpolated(interval) for interval in self.spec.compared})

    @cached_property
    def angle(self) -> IntersectionAngleChange:
        """Changes (T,) of the intersection angle by the monitor."""
        first, second = (self.monitored[name] for name in self.pair)
        return exact(first, second, *self.looks, *self.monitored.across)

    @property
    def angle_change(self) -> np.ndarray:
        """(T,) true, radians."""
        return np.asarray(self.true_angle - self.true_angle[self.spec.referred])

    @property
    def sigma(self) -> np.ndarray:
        """(T,) of the mean height by the noise of the monitor, propagated, metres."""
        return np.sqrt(self.variance(self.monitored.noise))

    @property
    def sigma_total(self) -> np.ndarray | None:
        """(T,) likewise of the whole error; None where nothing is stated to move."""
        total = self.monitored.total
        return None if total is None else np.sqrt(self.variance(total))

    @cached_property
    def smoothing(self) -> Mapping[float, Smoothing]:
        """Seconds -> heights smoothed from measurements at this interval; empty where nothing is stated to move."""
        return FrozenMap({interval: self._smoothing(interval) for interval in sorted(self.together)})

    @property
    def smoothed(self) -> Smoothing:
        """Heights smoothed from the measurements at the file's interval; there is none without a prior."""
        return self.smoothing[self.spec.every]

    def _smoothing(self, interval: float) -> Smoothing:
        found, mask = self.together[interval], self.mask
        readings = found.readings
        assert readings.total is not None
        case = self.case(self.applied(readings))
        wrong = self.height({n: mask * (readings[n].vector - self.truth[n]) for n in self.pair})
        # what rounding leaves at the reference is no sigma
        variance = np.maximum(self.variance(readings.total), 0.0)
        interpolated = self.intervals[interval] if interval in self.intervals else self._interpolated(interval)
        return Smoothing(case, interpolated, wrong, np.sqrt(variance), found.consistency)

    @cached_property
    def parts(self) -> Mapping[str, np.ndarray]:
        """Name -> (T,) parts of the monitored cameras' mean height error, metres."""

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
        """Arcseconds to metres, at the reference, where the calibrated cameras are the true ones."""
        k = self.spec.referred
        view, traced = self.views[k], {}
        first, second = self.pair
        calm = point_errors(self.true_pair(k), view, exact_data=True)[:, 2].mean()
        slant, incidence = {}, {}
        up = view.ground / np.linalg.norm(view.ground, axis=1, keepdims=True)
        for i, name in enumerate(self.pair):
            pair = self.true_pair(k)
            pair[i] = in_analysis(self.turned[name], self.calibrated[name])
            traced[name] = float(point_errors(pair, view, exact_data=True)[:, 2].mean() - calm)
            arm = view.exact[i].station - view.ground
            slant[name] = np.linalg.norm(arm, axis=1)
            forward = np.cross(up, view.exact[i].attitude[:, :, 1])  # along the track, level
            incidence[name] = np.arctan2(-np.sum(arm * forward, axis=1), np.sum(arm * up, axis=1))
        ratio = np.tan(incidence[first]) - np.tan(incidence[second])
        # a ray that is taken to look farther forward passes above the point, and the other ray is met the higher, the
        # more it comes from ahead
        theory = {
            name: float(np.mean(sign * slant[name] * ARCSEC / np.cos(incidence[name]) / ratio))
            for name, sign in ((first, 1.0), (second, -1.0))
        }
        return Conversion(FrozenMap(traced), FrozenMap(theory), float(np.mean(np.abs(ratio))))

    @cached_property
    def scatter(self) -> Scatter:
        """Heights of repeated measurements, by exact image points, so that the monitor's noise is all there is."""
        monitored, heights = self.applied(self.repeated), []
        for row in range(self.spec.repeats):
            pair = [self.calibrated[n].corrected(monitored[n][row]) for n in self.pair]
            heights.append(point_errors(pair, self.views[self.worst], exact_data=True)[:, 2].mean())
        variance = self.variance(self.repeated.noise, self.worst)
        return Scatter(np.array(heights), float(np.sqrt(np.mean(variance))))

    @cached_property
    def residual(self) -> float:
        """Largest angle between a true line and the calibrated one corrected by the true four parameters, over the
        line and all times, radians.
        """
        away = []
        for k, lines in enumerate(self.lines):
            for name, line in lines.items():
                pixel = np.linspace(0.0, line.pixels - 1.0, 101)
                model = self.calibrated[name].corrected(self.truth[name][k]).look(pixel)
                away.append(float(np.max(np.linalg.norm(model - line.look(pixel), axis=-1))))
        return max(away)

    def cause_heights(self, cause: Cause) -> tuple[float, float]:
        """Height errors that a cause alone makes at its time, metres: without monitoring, and by what the monitor
        misreads.
        """
        slopes = {n: self.slopes[n][self.worst] for n in self.pair}
        without = sum(float(-slopes[n] @ cause.truth[n]) for n in self.pair)
        return without, sum(float(slopes[n] @ (self.mask * cause.error[n])) for n in self.pair)


def run_monitor(setup: MonitorSetup, backend: Backend, seed: int, advance: Advance = silent) -> MonitorRun | LoopRun:
    """Fly, measure, intersect: ``python -m twin.orbit monitor``; with mechanisms the loop is closed.

    Raises
    ------
    InputError
        An unknown node, a mechanism that the instrument does not have, or an impossible temperature.
    BenchError
        The test cannot be carried out as its file says.
    """
    spec = setup.test
    try:
        if spec.mechanisms is not None:
            return run_loop(setup, backend, seed, advance)
        run = fly_monitored(setup, backend, seed, advance)
        # intersections that fail are told here
        run.cases, run.intervals, run.conversion, run.scatter  # noqa: B018
        return run
    except (AimError, BeamMissedError) as error:
        raise BenchError(f"the instrument cannot be rendered: {error}", spec.times_key, TOO_FAR) from error
    except IntersectionError as error:
        raise BenchError(str(error), ("cameras",), "cameras that look different ways") from error


def fly_monitored(setup: MonitorSetup, backend: Backend, seed: int, advance: Advance) -> MonitorRun:
    """Trace, render, measure, look down.

    Raises
    ------
    InputError
        An unknown node or an impossible temperature.
    BenchError
        The test cannot be carried out as its file says.
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
    return MonitorRun(
        pair,
        np.array(spec.times),
        lines,
        FrozenMap({n: calibrated_line(lines[spec.referred][n], axes[n], distance[n]) for n in pair}),
        views,
        setup,
        seed,
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
