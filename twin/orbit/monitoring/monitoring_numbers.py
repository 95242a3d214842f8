"""Numbers of a monitored orbit, as monitor.json has them: times in seconds, changes in arcseconds and micrometres,
errors in metres.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.arrays import Array
from analysis.monitor.monitoring import PER_SI
from twin.orbit.monitoring.monitoring_flight import Cause, MonitorFlight
from twin.orbit.monitoring.monitoring_run import CaseErrors, MonitorRun, Smoothing, rms
from twin.run.quantity import Quantity, Record


def _unsigned(values: Array) -> Array:
    """Values with plain zeros in place of negative ones."""
    return np.asarray(values + 0.0)


CHANGES: Record[Array] = Record(
    "Changes of a camera.",
    Quantity("d_alpha_arcsec", lambda values: _unsigned(values[..., 0]), "Δα"),
    Quantity("d_beta_arcsec", lambda values: _unsigned(values[..., 1]), "Δβ"),
    Quantity("d_gamma_arcsec", lambda values: _unsigned(values[..., 2]), "Δγ"),
    Quantity("d_f_um", lambda values: _unsigned(values[..., 3]), "change of the principal distance"),
)
CAMERA: Record[tuple[MonitorFlight, str]] = Record(
    "Changes of one camera since the reference, over the times.",
    Quantity("true", lambda one: one[0].truth[one[1]], record=CHANGES),
    Quantity("monitored", lambda one: one[0].monitored[one[1]].to_dict(), "by the monitor, with sigmas"),
    Quantity("without_noise", lambda one: one[0].clean[one[1]], "by images without noise", record=CHANGES),
    Quantity("prisms_alone", lambda one: one[0].prisms[one[1]], "by temperatures of the prisms", record=CHANGES),
)
ANGLE: Record[MonitorRun] = Record(
    "The angle between the lines of sight at the reference, and its changes over the times.",
    Quantity("reference_deg", lambda run: run.flight.angle[run.flight.spec.referred], "true, at the reference"),
    Quantity("true_change_arcsec", lambda run: _unsigned(run.angle_change), "true change since the reference"),
    Quantity("monitored_change_arcsec", lambda run: _unsigned(run.angle), "change by the monitor"),
    Quantity(
        "monitored_change_arcsec_sigma", lambda run: _unsigned(run.angle_sigma), "standard deviation of its error"
    ),
    Quantity("monitored_change_arcsec_sigma_noise", lambda run: _unsigned(run.angle_noise), "of that the noise's part"),
    Quantity("true_change_span_arcsec", lambda run: np.ptp(run.angle_change), "largest less smallest true change"),
)
SUMMARY: Record[CaseErrors] = Record(
    "RMS errors at the check points over all times.",
    Quantity("height_rms_m", lambda case: case.height_rms, "in height", "height", 3),
    Quantity("height_worst_m", lambda case: case.worst, "in height at the worst time", "worst", 3),
    Quantity("height_bias_rms_m", lambda case: rms(case.bias), "of the points' mean height error"),
    Quantity(
        "height_camera_rms_m",
        lambda case: case.camera_height_rms,
        "in height by the cameras",
        "height by the cameras",
        4,
    ),
    Quantity("plan_rms_m", lambda case: case.plan_rms, "in plan", "plan", 3),
    Quantity(
        "plan_camera_rms_m", lambda case: rms(case.camera_plan), "in plan by the cameras", "plan by the cameras", 4
    ),
)
SERIES: Record[CaseErrors] = Record(
    "Errors at the check points of each time.",
    Quantity("height_rms_m", lambda case: _unsigned(case.height), "RMS in height"),
    Quantity("height_bias_m", lambda case: _unsigned(case.bias), "mean height error"),
    Quantity("height_camera_m", lambda case: _unsigned(case.camera), "mean height error by the cameras"),
    Quantity("plan_rms_m", lambda case: _unsigned(case.plan), "RMS in plan"),
)
CASE: Record[CaseErrors] = Record(
    "Errors with the cameras of one case.", *SUMMARY, Quantity("series", lambda case: case, record=SERIES)
)
INTERVAL: Record[tuple[float, CaseErrors]] = Record(
    "Errors where values are interpolated over an interval.",
    Quantity("interval_s", lambda one: one[0], "between measurements"),
    *SUMMARY.of_part(lambda one: one[1]),
)
CONVERSION: Record[MonitorRun] = Record(
    "Metres of height for an arcsecond, at the reference.",
    Quantity("by_angle_m_per_arcsec", lambda run: run.conversion.of_angle, "of the angle", converted=False),
    Quantity(
        "by_common_turn_m_per_arcsec", lambda run: run.conversion.of_common, "by which both turn alike", converted=False
    ),
    Quantity("by_camera_m_per_arcsec", lambda run: run.conversion.traced, "of one camera's Y, traced", converted=False),
    Quantity(
        "theory_by_camera_m_per_arcsec",
        lambda run: run.conversion.theory,
        "of one camera's Y, by base to height",
        converted=False,
    ),
    Quantity("base_to_height", lambda run: run.conversion.base_to_height, "base over height of the pair"),
)
SLOPES: Record[Array] = Record(
    "Change of the mean height with what the analysis is told of one camera, at the reference.",
    Quantity("d_alpha_m_per_arcsec", lambda slope: slope[0], "with Δα", converted=False),
    Quantity("d_beta_m_per_arcsec", lambda slope: slope[1], "with Δβ", converted=False),
    Quantity("d_gamma_m_per_arcsec", lambda slope: slope[2], "with Δγ", converted=False),
    Quantity("d_f_m_per_um", lambda slope: slope[3], "with the principal distance", converted=False),
)


def _scatter_differs(run: MonitorRun) -> str:
    ratio, (low, high) = run.scatter.spread / run.scatter.sigma, run.scatter.limits
    return f"scatter and propagated sigma of the heights differ: ratio {ratio:.3g}, limits {low:.2f} to {high:.2f}"


PROPAGATION: Record[MonitorRun] = Record(
    "Standard deviation of the mean height, and that of the noise against repeats at one time.",
    Quantity("height_m_sigma_noise", lambda run: _unsigned(run.sigma), "over the times, by the monitor's noise"),
    Quantity(
        "height_m_sigma",
        lambda run: None if run.sigma_total is None else _unsigned(run.sigma_total),
        "over the times, of the whole error; null without a prior on disturbances",
    ),
    Quantity("time_s", lambda run: run.flight.times[run.flight.worst], "of the repeats"),
    Quantity("repeats", lambda run: len(run.scatter.heights), "how often the monitor measures"),
    Quantity("sigma_m", lambda run: run.scatter.sigma, "propagated"),
    Quantity("spread_m", lambda run: run.scatter.spread, "standard deviation over the repeats"),
    Quantity("ratio", lambda run: run.scatter.spread / run.scatter.sigma, "spread over sigma"),
    Quantity("lower_limit", lambda run: run.scatter.limits[0], "of the ratio"),
    Quantity("upper_limit", lambda run: run.scatter.limits[1], "of the ratio"),
    Quantity(
        "agrees", lambda run: run.scatter.agrees, "whether the ratio lies within the limits", warning=_scatter_differs
    ),
)
SMOOTHED: Record[tuple[MonitorRun, float, Smoothing]] = Record(
    "Heights by values smoothed from the measurements at one interval.",
    Quantity("interval_s", lambda one: one[1], "between measurements"),
    Quantity("measurements", lambda one: len(one[0].flight.spec.measured(one[1])), "how many there are"),
    Quantity("height_rms_m", lambda one: one[2].case.height_rms, "RMS error in height over all times"),
    Quantity("height_camera_rms_m", lambda one: one[2].case.camera_height_rms, "the same by the cameras"),
    Quantity("height_sigma_rms_m", lambda one: rms(one[2].sigma), "RMS of the sigma that the smoother states"),
    Quantity("better_than_interpolation", lambda one: one[2].factor, "by which factor the cameras' error is smaller"),
    Quantity("largest_ratio", lambda one: one[2].furthest, "largest error over its sigma"),
    Quantity("ratio_limit", lambda one: one[2].limit, "of this ratio"),
    Quantity("agrees", lambda one: one[2].agrees, "whether the ratio lies within its limit"),
    Quantity("chi_square", lambda one: one[2].consistency.chi_square, "of the measured shifts under the prior"),
    Quantity("degrees_of_freedom", lambda one: one[2].consistency.degrees, "of chi-square"),
    Quantity("chi_square_limit", lambda one: one[2].consistency.limit, "of chi-square"),
    Quantity("shifts_agree", lambda one: one[2].consistency.agrees, "whether chi-square lies within its limit"),
)


def _readings(run: MonitorRun) -> dict[str, Any]:
    readings = run.flight.smoothed[run.flight.spec.interval].readings
    return {name: readings[name].to_dict() for name in run.flight.pair}


def _wrong(run: MonitorRun) -> str:
    far, limit = run.smoothed.furthest, run.smoothed.limit
    return f"smoothed heights are wrong by up to {far:.3g} of their sigma, limit {limit:.2f}"


SMOOTHING: Record[MonitorRun] = Record(
    "What all measurements say together under the prior on disturbances.",
    Quantity("disturbances", lambda run: run.setup.disturbances and run.setup.disturbances.name, "name of the prior"),
    Quantity("cameras", _readings, "changes at the file's interval, with sigmas"),
    Quantity("height_error_m", lambda run: _unsigned(run.smoothed.error), "mean height error over the times"),
    Quantity("height_m_sigma", lambda run: _unsigned(run.smoothed.sigma), "its standard deviation by the smoother"),
    Quantity(
        "shifts_agree",
        lambda run: run.smoothed.consistency.agrees,
        "whether the measurements at the file's interval agree with the prior",
        warning=lambda run: (
            f"the measured shifts contradict the prior: chi-square {run.smoothed.consistency.chi_square:.4g}, limit "
            f"{run.smoothed.consistency.limit:.4g}; the sigmas are not reliable"
        ),
    ),
    Quantity("agrees", lambda run: run.smoothed.agrees, "whether smoothed heights are as good as said", warning=_wrong),
    Quantity("intervals", lambda run: [(run, *item) for item in run.smoothing.items()], record=SMOOTHED),
)
PART: Record[Array] = Record(
    "A part of the mean height error of the monitored cameras.",
    Quantity("height_rms_m", rms, "over the times"),
    Quantity("height_m", _unsigned, "signed, over the times"),
)
CAUSE: Record[tuple[MonitorRun, Cause]] = Record(
    "One temperature or motion of the file alone, at one time.",
    Quantity("what", lambda one: one[1].what, "temperature or motion"),
    Quantity("node", lambda one: one[1].path, "of the instrument's tree"),
    Quantity("true", lambda one: one[1].truth, "true changes, by camera", record=CHANGES),
    Quantity("monitor_error", lambda one: one[1].error, "reading without noise minus truth, by camera", record=CHANGES),
    Quantity("height_without_monitoring_m", lambda one: one[0].cause_heights(one[1])[0], "height error that it makes"),
    Quantity(
        "height_left_by_monitor_m", lambda one: one[0].cause_heights(one[1])[1], "height error that a misreading makes"
    ),
)


def _sensitivity(run: MonitorRun) -> dict[str, Array]:
    return {name: run.slopes[name][run.flight.spec.referred] / PER_SI for name in run.flight.pair}


MONITOR: Record[MonitorRun] = Record(
    "monitor.json. Errors at the top are those with the file's interval.",
    Quantity("seed", lambda run: run.seed, "of all random numbers"),
    Quantity("interval_s", lambda run: run.flight.spec.interval, "between measurements, of the file"),
    Quantity("height_rms_m", lambda run: run.cases["interval"].height_rms, "RMS error in height"),
    Quantity("height_worst_m", lambda run: run.cases["interval"].worst, "RMS error in height at the worst time"),
    Quantity("height_camera_rms_m", lambda run: run.cases["interval"].camera_height_rms, "in height by the cameras"),
    Quantity("plan_rms_m", lambda run: run.cases["interval"].plan_rms, "RMS error in plan"),
    Quantity(
        "height_m_per_arcsec",
        lambda run: run.conversion.of_angle,
        "of height for the intersection angle",
        converted=False,
    ),
    Quantity("times_s", lambda run: run.flight.times, "of the course"),
    Quantity("reference_time_s", lambda run: run.flight.spec.reference, "when cameras and monitor are calibrated"),
    Quantity("monitored_times_s", lambda run: run.flight.times[run.flight.spec.measured(run.flight.spec.interval)]),
    Quantity("cameras", lambda run: {name: (run.flight, name) for name in run.flight.pair}, record=CAMERA),
    Quantity("intersection_angle", lambda run: run, record=ANGLE),
    Quantity("cases", lambda run: run.cases, "by what the cameras are corrected with", record=CASE),
    Quantity("intervals", lambda run: list(run.intervals.items()), record=INTERVAL),
    Quantity("conversion", lambda run: run, record=CONVERSION),
    Quantity("sensitivity", _sensitivity, record=SLOPES),
    Quantity("propagation", lambda run: run, record=PROPAGATION),
    Quantity("estimator", lambda run: run.flight.estimator, "by which the monitor's shifts are read"),
    Quantity("smoothing", lambda run: run if run.smoothing else None, record=SMOOTHING),
    Quantity("parts", lambda run: run.parts, "by source", record=PART),
    Quantity("causes", lambda run: [(run, cause) for cause in run.flight.causes], record=CAUSE),
    Quantity("correction_residual_arcsec", lambda run: run.residual, "largest direction error of the correction"),
)
