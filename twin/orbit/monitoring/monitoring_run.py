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

from analysis.monitor.disturbances import Consistency
from analysis.monitor.intersection_angle import exact
from analysis.orbit.forward_intersection import CalibratedLine, IntersectionError, between, check_errors, intersect_pair
from analysis.units import ARCSEC
from optics.numerics.frozen_map import FrozenMap
from scenes.specs.orbit.monitor import PARAMETERS
from twin.orbit.monitoring.monitor_series import Readings
from twin.orbit.monitoring.monitoring_flight import Cause, MonitorFlight, View, fly_monitored, in_analysis
from twin.run.procedure import Advance, BenchError, silent

if TYPE_CHECKING:
    from optics.numerics.backend import Backend
    from scenes.specs.orbit.setup import MonitorSetup

CASES = ("none", "monitored", "interval", "smoothed", "parameters", "true")
"""Cases of the line geometry: as calibrated; corrected at every time; corrected by values interpolated over the file's
interval; by values smoothed from the same measurements, if there is a prior; by the true four parameters; the true
lines. The last two are bounds that no measurement gives.
"""
FALSE_ALARM = 1e-4
"""Chance that right sigmas are called wrong, both sides together."""
_STEP = np.array([ARCSEC, ARCSEC, ARCSEC, 10e-6])
"""Steps of the derivatives, rad and m: over them the intersection is linear to 1e-5."""


@dataclass(frozen=True, eq=False)
class CaseErrors:
    """Errors at the check points over T times.

    Attributes:
        plan: (T,) RMS, both axes, metres; height: (T,) likewise.
        bias: (T,) mean of the height errors, found minus true.
        camera: (T,) the same less that of the true cameras at the same image points, orbit and attitude: what the
            cameras alone do.
        camera_plan: (T,) RMS over the points of what the cameras alone do in plan; camera_height: likewise in height.
    """

    plan: np.ndarray
    height: np.ndarray
    bias: np.ndarray
    camera: np.ndarray
    camera_plan: np.ndarray
    camera_height: np.ndarray

    @property
    def plan_rms(self) -> float:
        """RMS error in plan over all times, metres."""
        return rms(self.plan)

    @property
    def height_rms(self) -> float:
        """RMS error in height over all times, metres."""
        return rms(self.height)

    @property
    def camera_height_rms(self) -> float:
        """RMS of what the cameras alone do in height over all times, metres."""
        return rms(self.camera_height)

    @property
    def worst(self) -> float:
        """Largest RMS in height of one time, metres."""
        return float(self.height.max())


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
        slopes: camera -> (T, 4) change of the mean height with the parameters that the analysis assumes, m/rad, m/m.
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
    slopes: Mapping[str, np.ndarray]
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
        return self.smoothing[self.flight.spec.interval]

    def cause_heights(self, cause: Cause) -> tuple[float, float]:
        """Height errors that a cause alone makes at its time, metres: without monitoring, and by what the monitor
        misreads.
        """
        flight, mask = self.flight, _mask(self.flight)
        slopes = {n: self.slopes[n][flight.worst] for n in flight.pair}
        without = sum(float(-slopes[n] @ cause.truth[n]) for n in flight.pair)
        return without, sum(float(slopes[n] @ (mask * cause.error[n])) for n in flight.pair)


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def run_monitor(setup: MonitorSetup, backend: Backend, seed: int, advance: Advance = silent) -> MonitorRun:
    """Fly, measure, intersect: ``python -m twin.orbit monitor``. Raises BenchError, InputError as `fly_monitored`."""
    flight = fly_monitored(setup, backend, seed, advance)
    try:
        return _analysed(flight, setup, seed)
    except IntersectionError as error:
        raise BenchError(str(error), ("cameras",), "cameras that look different ways") from error


def _analysed(flight: MonitorFlight, setup: MonitorSetup, seed: int) -> MonitorRun:
    """All cases of a flight."""
    count, spec = len(flight.times), flight.spec
    monitored = {n: flight.monitored[n].vector * _mask(flight) for n in flight.pair}
    changes = {
        "none": {n: np.zeros((count, 4)) for n in flight.pair},
        "monitored": monitored,
        "interval": _interpolated(flight, monitored, spec.interval),
        "parameters": dict(flight.truth),
    }
    true = _intersected(flight, [_true_pair(flight, k) for k in range(count)])
    cases = {name: case_errors(_intersected(flight, _corrected(flight, each)), true) for name, each in changes.items()}
    cases["true"] = case_errors(true, true)

    def interpolated(interval: float) -> CaseErrors:
        changes = _interpolated(flight, monitored, interval)
        return case_errors(_intersected(flight, _corrected(flight, changes)), true)

    intervals = {interval: interpolated(interval) for interval in spec.compared}
    slopes = _slopes(flight)
    smoothing = {
        interval: _smoothing(flight, slopes, interval, true, intervals.get(interval, cases["interval"]))
        for interval in sorted(flight.smoothed)
    }
    if smoothing:
        cases["smoothed"] = smoothing[spec.interval].case
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
        FrozenMap(slopes),
        np.sqrt(_propagated(flight, slopes, flight.monitored.noise)),
        None if total is None else np.sqrt(_propagated(flight, slopes, total)),
        FrozenMap(smoothing),
        FrozenMap(_parts(flight, slopes, cases)),
        _conversion(flight),
        _scatter(flight, slopes),
        max(_residual(flight, n, k) for n in flight.pair for k in range(count)),
    )


def _smoothing(
    flight: MonitorFlight, slopes: Mapping[str, np.ndarray], interval: float, true: np.ndarray, between: CaseErrors
) -> Smoothing:
    found, mask = flight.smoothed[interval], _mask(flight)
    readings: Readings = found.readings
    assert readings.total is not None
    changes = {n: readings[n].vector * mask for n in flight.pair}
    case = case_errors(_intersected(flight, _corrected(flight, changes)), true)
    wrong = [np.sum(slopes[n] * mask * (readings[n].vector - flight.truth[n]), axis=1) for n in flight.pair]
    # what rounding leaves at the reference is no sigma
    variance = np.maximum(_propagated(flight, slopes, readings.total), 0.0)
    return Smoothing(case, between, np.sum(wrong, axis=0), np.sqrt(variance), found.consistency)


def _mask(flight: MonitorFlight) -> np.ndarray:
    """(4,) 1 for parameters that are applied."""
    return np.array([float(name in flight.spec.apply) for name in PARAMETERS])


def _interpolated(flight: MonitorFlight, monitored: Mapping[str, np.ndarray], interval: float) -> dict[str, np.ndarray]:
    at = flight.spec.measured(interval)
    return {n: between(flight.times, flight.times[at], values[at]) for n, values in monitored.items()}


def _corrected(flight: MonitorFlight, changes: Mapping[str, np.ndarray]) -> list[list[CalibratedLine]]:
    return [[flight.calibrated[n].corrected(changes[n][k]) for n in flight.pair] for k in range(len(flight.times))]


def _true_pair(flight: MonitorFlight, k: int) -> list[CalibratedLine]:
    return [flight.true_line(n, k) for n in flight.pair]


def _found(flight: MonitorFlight, cameras: Sequence[CalibratedLine], k: int, exact_data: bool = False) -> np.ndarray:
    return point_errors(cameras, flight.views[k], exact_data)


def point_errors(cameras: Sequence[CalibratedLine], view: View, exact_data: bool = False) -> np.ndarray:
    """Errors (n, 3) east, north, up of points that two cameras intersect, metres.

    Args:
        cameras: the two, as the analysis takes them.
        view: the points.
        exact_data: with exact image points, orbit and attitude.

    Raises:
        IntersectionError: rays that are parallel.
    """
    seen = view.exact if exact_data else view.seen
    return check_errors(intersect_pair(cameras[0], cameras[1], *seen).ground, view.ground).error


def _intersected(flight: MonitorFlight, cameras: list[list[CalibratedLine]]) -> np.ndarray:
    """(T, n, 3) errors."""
    return np.array([_found(flight, pair, k) for k, pair in enumerate(cameras)])


def case_errors(found: np.ndarray, true: np.ndarray) -> CaseErrors:
    """Errors of a case.

    Args:
        found: (T, n, 3) errors east, north, up of the points, metres.
        true: (T, n, 3) those by the true cameras with the same image points, orbit and attitude.
    """
    alone = found - true
    return CaseErrors(
        plan=np.sqrt(np.mean(np.sum(found[..., :2] ** 2, axis=-1), axis=1)),
        height=np.sqrt(np.mean(found[..., 2] ** 2, axis=1)),
        bias=found[..., 2].mean(axis=1),
        camera=alone[..., 2].mean(axis=1),
        camera_plan=np.sqrt(np.mean(np.sum(alone[..., :2] ** 2, axis=-1), axis=1)),
        camera_height=np.sqrt(np.mean(alone[..., 2] ** 2, axis=1)),
    )


def _slopes(flight: MonitorFlight) -> dict[str, np.ndarray]:
    return height_slopes(flight.calibrated, flight.pair, flight.views)


def height_slopes(
    calibrated: Mapping[str, CalibratedLine], pair: tuple[str, str], views: Sequence[View]
) -> dict[str, np.ndarray]:
    """Camera -> (T, 4) slopes of the mean height by d_alpha, d_beta, d_gamma and d_f that the analysis is told, m/rad
    and m/m: central differences of the intersection of exact image points.

    Args:
        calibrated: camera -> its line, about which they are taken.
        pair: the two cameras.
        views: of T times.
    """
    out = {}
    for i, name in enumerate(pair):
        table = np.empty((len(views), 4))
        for k, view in enumerate(views):
            for j, step in enumerate(_STEP):
                ends = []
                for sign in (1.0, -1.0):
                    both = [calibrated[n] for n in pair]
                    both[i] = both[i].corrected(sign * step * np.eye(4)[j])
                    ends.append(float(point_errors(both, view, exact_data=True)[:, 2].mean()))
                table[k, j] = (ends[0] - ends[1]) / (2.0 * step)
        out[name] = table
    return out


def _propagated(
    flight: MonitorFlight, slopes: Mapping[str, np.ndarray], covariance: np.ndarray, at: int | None = None
) -> np.ndarray:
    """Variance (S,) of the mean height by the pair's values, m^2.

    Args:
        flight: truth and measurements.
        slopes: camera -> (T, 4).
        covariance: (S, 8, 8) of the pair's values.
        at: number of the time to which all of them belong; None for one of each time.
    """
    both = np.concatenate([slopes[n] * _mask(flight) for n in flight.pair], axis=1)
    slope = both if at is None else both[at]
    return np.asarray(np.einsum("...i,...ij,...j->...", slope, covariance, slope))


def _parts(
    flight: MonitorFlight, slopes: Mapping[str, np.ndarray], cases: Mapping[str, CaseErrors]
) -> dict[str, np.ndarray]:
    def height(values: Mapping[str, np.ndarray]) -> np.ndarray:
        every = [np.sum(slopes[n] * _mask(flight) * values[n], axis=1) for n in flight.pair]
        return np.asarray(np.sum(every, axis=0))

    system = {n: flight.clean[n] - flight.truth[n] for n in flight.pair}
    left_out = {n: -flight.truth[n] * (1.0 - _mask(flight)) for n in flight.pair}
    unused = np.sum([np.sum(slopes[n] * left_out[n], axis=1) for n in flight.pair], axis=0)
    return {
        "prisms": height(flight.prisms),
        "other_systematic": height({n: system[n] - flight.prisms[n] for n in flight.pair}),
        "noise": height({n: flight.monitored[n].vector - flight.clean[n] for n in flight.pair}),
        "not_applied": np.asarray(unused),
        "beyond_parameters": cases["parameters"].camera,
        "interpolation": cases["interval"].camera - cases["monitored"].camera,
    }


def _conversion(flight: MonitorFlight) -> Conversion:
    """At the reference, where the calibrated cameras are the true ones."""
    k = flight.spec.referred
    view, traced = flight.views[k], {}
    first, second = flight.pair
    calm = _found(flight, _true_pair(flight, k), k, exact_data=True)[:, 2].mean()
    slant, incidence = {}, {}
    up = view.ground / np.linalg.norm(view.ground, axis=1, keepdims=True)
    for i, name in enumerate(flight.pair):
        pair = _true_pair(flight, k)
        pair[i] = in_analysis(flight.turned[name], flight.calibrated[name])
        traced[name] = float(_found(flight, pair, k, exact_data=True)[:, 2].mean() - calm)
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


def _scatter(flight: MonitorFlight, slopes: Mapping[str, np.ndarray]) -> Scatter:
    """Exact image points, so that the monitor's noise is all there is."""
    k, mask = flight.worst, _mask(flight)
    monitored = {n: flight.repeated[n].vector * mask for n in flight.pair}
    heights = []
    for row in range(flight.spec.repeats):
        pair = [flight.calibrated[n].corrected(monitored[n][row]) for n in flight.pair]
        heights.append(_found(flight, pair, k, exact_data=True)[:, 2].mean())
    variance = _propagated(flight, slopes, flight.repeated.noise, k)
    return Scatter(np.array(heights), float(np.sqrt(np.mean(variance))))


def _residual(flight: MonitorFlight, name: str, k: int) -> float:
    pixel = np.linspace(0.0, flight.lines[k][name].pixels - 1.0, 101)
    model = flight.calibrated[name].corrected(flight.truth[name][k]).look(pixel)
    return float(np.max(np.linalg.norm(model - flight.lines[k][name].look(pixel), axis=-1)))
