"""Numbers of a monitored orbit, as monitor.json has them: times in seconds, changes in arcseconds and micrometres,
errors in metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from analysis.monitor.monitoring import PER_SI
from analysis.units import ARCSEC
from scenes.specs.orbit.monitor import PARAMETERS
from twin.orbit.monitoring.monitoring_flight import Cause, MonitorFlight
from twin.orbit.monitoring.monitoring_run import CaseErrors, MonitorRun, rms
from twin.run.plain_data import plain_data

Array = NDArray[np.float64]


def cause_heights(run: MonitorRun, cause: Cause) -> tuple[float, float]:
    """Metres of height that a cause alone makes at its time: without monitoring, and what the monitor is wrong by."""
    flight = run.flight
    slopes = {n: run.slopes[n][flight.worst] for n in flight.pair}
    without = sum(float(-slopes[n] @ cause.truth[n]) for n in flight.pair)
    applied = np.array([float(name in flight.spec.apply) for name in PARAMETERS])
    left = sum(float(slopes[n] @ (applied * cause.error[n])) for n in flight.pair)
    return without, left


@dataclass(frozen=True)
class ChangeNumbers:
    """Changes of a camera: numbers, or (T,) over the times."""

    d_alpha_arcsec: Array
    d_beta_arcsec: Array
    d_gamma_arcsec: Array
    d_f_um: Array

    @classmethod
    def of(cls, values: Array) -> Self:
        """Of (..., 4), radians and metres."""
        return cls(*np.moveaxis(values * PER_SI, -1, 0))


@dataclass(frozen=True)
class CameraNumbers:
    """Changes of one camera since the reference; those monitored with their sigmas."""

    true: ChangeNumbers
    monitored: Mapping[str, Any]
    without_noise: ChangeNumbers
    prisms_alone: ChangeNumbers

    @classmethod
    def of(cls, flight: MonitorFlight, name: str) -> Self:
        """Of one camera by name."""
        true, clean, prisms = (
            ChangeNumbers.of(unsigned(values[name])) for values in (flight.truth, flight.clean, flight.prisms)
        )
        return cls(true, flight.monitored[name].to_dict(), clean, prisms)


def unsigned(values: Array) -> Array:
    """The same with plain zeros for negative ones."""
    return np.asarray(values + 0.0)


@dataclass(frozen=True)
class AngleNumbers:
    """The intersection angle at the reference, and its changes over the times."""

    reference_deg: float
    true_change_arcsec: Array
    monitored_change_arcsec: Array
    monitored_change_sigma_arcsec: Array
    monitored_change_sigma_noise_arcsec: Array
    true_change_span_arcsec: float

    @classmethod
    def of(cls, run: MonitorRun) -> Self:
        """Of a run."""
        change = run.angle_change / ARCSEC
        return cls(
            reference_deg=float(np.degrees(run.flight.angle[run.flight.spec.referred])),
            true_change_arcsec=unsigned(change),
            monitored_change_arcsec=unsigned(run.angle / ARCSEC),
            monitored_change_sigma_arcsec=unsigned(run.angle_sigma / ARCSEC),
            monitored_change_sigma_noise_arcsec=unsigned(run.angle_noise / ARCSEC),
            true_change_span_arcsec=float(np.ptp(change)),
        )


@dataclass(frozen=True)
class SummaryNumbers:
    """Errors at the check points over all times; worst: the RMS of the worst time; camera: what the cameras do."""

    height_rms_m: float
    height_worst_m: float
    height_bias_rms_m: float
    height_camera_rms_m: float
    plan_rms_m: float
    plan_camera_rms_m: float

    @classmethod
    def of(cls, case: CaseErrors) -> SummaryNumbers:
        """Of one case."""
        return cls(**_summary(case))


def _summary(case: CaseErrors) -> dict[str, Any]:
    """Fields of `SummaryNumbers`."""
    return {
        "height_rms_m": case.height_rms,
        "height_worst_m": case.worst,
        "height_bias_rms_m": rms(case.bias),
        "height_camera_rms_m": case.camera_height_rms,
        "plan_rms_m": case.plan_rms,
        "plan_camera_rms_m": rms(case.camera_plan),
    }


@dataclass(frozen=True)
class SeriesNumbers:
    """The same at each time, (T,)."""

    height_rms_m: Array
    height_bias_m: Array
    height_camera_m: Array
    plan_rms_m: Array


@dataclass(frozen=True)
class CaseNumbers(SummaryNumbers):
    """One case with its series."""

    series: SeriesNumbers

    @classmethod
    def of(cls, case: CaseErrors) -> CaseNumbers:
        """Of one case."""
        series = SeriesNumbers(*map(unsigned, (case.height, case.bias, case.camera, case.plan)))
        return cls(**_summary(case), series=series)


@dataclass(frozen=True)
class ConversionNumbers:
    """Metres of height for an arcsecond; of the angle, of both cameras alike, of each camera."""

    by_angle_m_per_arcsec: float
    by_common_turn_m_per_arcsec: float
    by_camera_m_per_arcsec: Mapping[str, float]
    theory_by_camera_m_per_arcsec: Mapping[str, float]
    base_to_height: float


@dataclass(frozen=True)
class SlopeNumbers:
    """Change of the mean height with what the analysis is told of one camera, at the reference."""

    d_alpha_m_per_arcsec: float
    d_beta_m_per_arcsec: float
    d_gamma_m_per_arcsec: float
    d_f_m_per_um: float

    @classmethod
    def of(cls, run: MonitorRun, name: str) -> Self:
        """Of one camera by name."""
        return cls(*(float(v) for v in run.slopes[name][run.flight.spec.referred] / PER_SI))


@dataclass(frozen=True)
class PropagationNumbers:
    """Sigma of the mean height over the times, by the monitor's noise and of its whole error (none where nothing is
    stated to move), and that of the noise against repeats at one time.
    """

    height_sigma_m: Array
    height_total_sigma_m: Array | None
    time_s: float
    repeats: int
    sigma_m: float
    spread_m: float
    ratio: float
    lower_limit: float
    upper_limit: float
    agrees: bool

    @classmethod
    def of(cls, run: MonitorRun) -> Self:
        """Of a run."""
        scatter, (low, high) = run.scatter, run.scatter.limits
        return cls(
            height_sigma_m=unsigned(run.sigma),
            height_total_sigma_m=None if run.sigma_total is None else unsigned(run.sigma_total),
            time_s=float(run.flight.times[run.flight.worst]),
            repeats=len(scatter.heights),
            sigma_m=scatter.sigma,
            spread_m=scatter.spread,
            ratio=scatter.spread / scatter.sigma,
            lower_limit=low,
            upper_limit=high,
            agrees=scatter.agrees,
        )


@dataclass(frozen=True)
class SmoothedNumbers:
    """Heights by values smoothed from the measurements at one interval: RMS errors of all and of the cameras alone, how
    many times smaller than with interpolation, and the sigma that the smoother states, RMS over the times. Then the
    largest error over its sigma with its limit, and the chi-square of the measured shifts with its own.
    """

    interval_s: float
    measurements: int
    height_rms_m: float
    height_camera_rms_m: float
    height_sigma_rms_m: float
    better_than_interpolation: float
    largest_ratio: float
    ratio_limit: float
    agrees: bool
    chi_square: float
    degrees_of_freedom: int
    chi_square_limit: float
    shifts_agree: bool

    @classmethod
    def of(cls, run: MonitorRun, interval: float) -> Self:
        """Of one interval."""
        one = run.smoothing[interval]
        return cls(
            interval_s=interval,
            measurements=len(run.flight.spec.measured(interval)),
            height_rms_m=one.case.height_rms,
            height_camera_rms_m=one.case.camera_height_rms,
            height_sigma_rms_m=rms(one.sigma),
            better_than_interpolation=one.factor,
            largest_ratio=one.furthest,
            ratio_limit=one.limit,
            agrees=one.agrees,
            chi_square=one.consistency.chi_square,
            degrees_of_freedom=one.consistency.degrees,
            chi_square_limit=one.consistency.limit,
            shifts_agree=one.consistency.agrees,
        )


@dataclass(frozen=True)
class SmoothingNumbers:
    """What all measurements say together: changes at the file's interval with their sigmas, errors of the height over
    the times with the sigma that is stated, and the comparison over the intervals.
    """

    disturbances: str
    cameras: Mapping[str, Any]
    height_error_m: Array
    height_sigma_m: Array
    intervals: Sequence[SmoothedNumbers]

    @classmethod
    def of(cls, run: MonitorRun) -> Self | None:
        """Of a run; None where nothing is stated to move."""
        flight, stated = run.flight, run.setup.disturbances
        if stated is None:
            return None
        chosen, readings = run.smoothing[flight.spec.interval], flight.smoothed[flight.spec.interval].readings
        return cls(
            disturbances=stated.name,
            cameras={name: readings[name].to_dict() for name in flight.pair},
            height_error_m=unsigned(chosen.error),
            height_sigma_m=unsigned(chosen.sigma),
            intervals=[SmoothedNumbers.of(run, interval) for interval in run.smoothing],
        )


@dataclass(frozen=True)
class PartNumbers:
    """A part of the monitored cameras' height error, signed over the times."""

    height_rms_m: float
    height_m: Array


@dataclass(frozen=True)
class CauseNumbers:
    """One cause alone, at one time; by camera."""

    what: str
    node: str
    true: Mapping[str, ChangeNumbers]
    monitor_error: Mapping[str, ChangeNumbers]
    height_without_monitoring_m: float
    height_left_by_monitor_m: float

    @classmethod
    def of(cls, run: MonitorRun, cause: Cause) -> Self:
        """Of one cause."""
        true, error = (
            {name: ChangeNumbers.of(values) for name, values in by_camera.items()}
            for by_camera in (cause.truth, cause.error)
        )
        return cls(cause.what, cause.path, true, error, *cause_heights(run, cause))


@dataclass(frozen=True)
class MonitorNumbers:
    """monitor.json; errors at the top are those with the file's interval."""

    seed: int
    interval_s: float
    height_rms_m: float
    height_worst_m: float
    height_camera_rms_m: float
    plan_rms_m: float
    metres_per_arcsec: float
    times_s: Array
    reference_time_s: float
    monitored_times_s: Array
    cameras: Mapping[str, CameraNumbers]
    intersection_angle: AngleNumbers
    cases: Mapping[str, CaseNumbers]
    intervals: Sequence[Mapping[str, float]]
    conversion: ConversionNumbers
    sensitivity: Mapping[str, SlopeNumbers]
    propagation: PropagationNumbers
    estimator: str
    smoothing: SmoothingNumbers | None
    parts: Mapping[str, PartNumbers]
    causes: Sequence[CauseNumbers]
    correction_residual_arcsec: float

    @classmethod
    def of(cls, run: MonitorRun) -> Self:
        """Of a run."""
        flight, spec, conversion = run.flight, run.flight.spec, run.conversion
        chosen = run.cases["interval"]
        return cls(
            seed=run.seed,
            interval_s=spec.interval,
            height_rms_m=chosen.height_rms,
            height_worst_m=chosen.worst,
            height_camera_rms_m=chosen.camera_height_rms,
            plan_rms_m=chosen.plan_rms,
            metres_per_arcsec=conversion.of_angle,
            times_s=flight.times,
            reference_time_s=spec.reference,
            monitored_times_s=flight.times[spec.measured(spec.interval)],
            cameras={name: CameraNumbers.of(flight, name) for name in flight.pair},
            intersection_angle=AngleNumbers.of(run),
            cases={name: CaseNumbers.of(case) for name, case in run.cases.items()},
            intervals=[
                {"interval_s": interval, **vars(SummaryNumbers.of(case))} for interval, case in run.intervals.items()
            ],
            conversion=ConversionNumbers(
                conversion.of_angle,
                conversion.of_common,
                conversion.traced,
                conversion.theory,
                conversion.base_to_height,
            ),
            sensitivity={name: SlopeNumbers.of(run, name) for name in flight.pair},
            propagation=PropagationNumbers.of(run),
            estimator=flight.estimator,
            smoothing=SmoothingNumbers.of(run),
            parts={name: PartNumbers(rms(part), unsigned(part)) for name, part in run.parts.items()},
            causes=[CauseNumbers.of(run, cause) for cause in flight.causes],
            correction_residual_arcsec=run.residual / ARCSEC,
        )


def monitor_numbers(run: MonitorRun) -> dict[str, Any]:
    """Contents of monitor.json without its frames."""
    return dict(plain_data(MonitorNumbers.of(run)))
