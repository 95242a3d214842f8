"""Result keys of a monitored orbit (monitor.json): times in s, changes in arcsec and µm, errors in m.

The results of a closed loop are under the key `loop`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from analysis.arrays import Array
from analysis.monitor.model_fit import UnobservableMode
from analysis.monitor.monitor_formulas import PER_SI
from analysis.statistics import rms
from scenes.specs.course import moment
from twin.framework.artefact import significant
from twin.framework.record import Quantity, Record
from twin.orbit.monitoring import loop_run
from twin.orbit.monitoring.monitoring_run import Cause, MonitorRun, Smoothing
from twin.orbit.monitoring.pair_flight import CaseErrors

MOST_MOTIONS = 8
"""Largest number of motions listed for an unobservable mode."""


def _unsigned(values: Array | None) -> Array | None:
    """Return the values with negative zeros replaced by positive ones; None stays None."""
    return None if values is None else np.asarray(values + 0.0)


CHANGES: Record[Array] = Record(
    "Changes of a camera's parameters.",
    Quantity("d_alpha_arcsec", lambda values: _unsigned(values[..., 0]), "Δα"),
    Quantity("d_beta_arcsec", lambda values: _unsigned(values[..., 1]), "Δβ"),
    Quantity("d_gamma_arcsec", lambda values: _unsigned(values[..., 2]), "Δγ"),
    Quantity("d_f_um", lambda values: _unsigned(values[..., 3]), "change of the principal distance"),
)
CAMERA: Record[tuple[MonitorRun, str]] = Record(
    "Changes of one camera since the reference, over the times.",
    Quantity("true", lambda of: of[0].truth[of[1]], "true changes", record=CHANGES),
    Quantity("monitored", lambda of: of[0].monitored[of[1]].to_dict(), "by the monitor, with sigmas"),
    Quantity("without_noise", lambda of: of[0].clean[of[1]], "by images without noise", record=CHANGES),
    Quantity("prisms_alone", lambda of: of[0].prisms[of[1]], "by temperatures of the prisms alone", record=CHANGES),
)
ANGLE: Record[MonitorRun] = Record(
    "Angle between the lines of sight at the reference, and its changes over the times.",
    Quantity("reference_deg", lambda run: run.true_angle[run.spec.reference_index], "true angle at the reference"),
    Quantity("true_change_arcsec", lambda run: _unsigned(run.angle_change), "true change since the reference"),
    Quantity("monitored_change_arcsec", lambda run: _unsigned(run.angle.change_rad), "change by the monitor"),
    Quantity("monitored_change_arcsec_sigma", lambda run: _unsigned(run.angle.sigma_rad), "total sigma"),
    Quantity("monitored_change_arcsec_sigma_noise", lambda run: _unsigned(run.angle.noise_rad), "sigma by noise"),
    Quantity("true_change_span_arcsec", lambda run: np.ptp(run.angle_change), "largest less smallest true change"),
)
SUMMARY: Record[CaseErrors] = Record(
    "RMS errors at the check points over all times.",
    Quantity("height_rms_m", lambda case: case.height_rms, "RMS in height", "height", 3),
    Quantity("height_worst_m", lambda case: case.worst, "RMS in height at the worst time", "worst", 3),
    Quantity("height_bias_rms_m", lambda case: rms(case.bias), "RMS of the points' mean height error"),
    Quantity("height_camera_rms_m", lambda case: case.camera_height_rms, "by the cameras", "height by the cameras", 4),
    Quantity("plan_rms_m", lambda case: case.plan_rms, "RMS in plan", "plan", 3),
    Quantity("plan_camera_rms_m", lambda case: rms(case.camera_plan), "by the cameras", "plan by the cameras", 4),
)
SERIES: Record[CaseErrors] = Record(
    "Errors at the check points of each time.",
    Quantity("height_rms_m", lambda case: _unsigned(case.height), "RMS in height"),
    Quantity("height_bias_m", lambda case: _unsigned(case.bias), "mean height error"),
    Quantity("height_camera_m", lambda case: _unsigned(case.camera), "mean height error by the cameras"),
    Quantity("plan_rms_m", lambda case: _unsigned(case.plan), "RMS in plan"),
)
CASE: Record[CaseErrors] = Record(
    "Errors with the cameras corrected by one method.", *SUMMARY, Quantity("series", lambda case: case, record=SERIES)
)
INTERVAL: Record[tuple[MonitorRun, float]] = Record(
    "Errors with values interpolated over an interval.",
    Quantity("interval_s", lambda of: of[1], "time between measurements", "interval", 1, shown="min"),
    Quantity("measurements", lambda of: len(of[0].spec.measured(of[1])), "number of measurements", "measurements"),
    *SUMMARY.of_part(lambda of: of[0].intervals[of[1]]),
)
CONVERSION: Record[MonitorRun] = Record(
    "Height change for an arcsecond, at the reference.",
    Quantity("by_angle_m_per_arcsec", lambda run: run.conversion.of_angle, "by the angle", converted=False),
    Quantity("by_common_turn_m_per_arcsec", lambda run: run.conversion.of_common, "by both cameras", converted=False),
    Quantity("by_camera_m_per_arcsec", lambda run: run.conversion.traced, "by one camera about Y", converted=False),
    Quantity("theory_by_camera_m_per_arcsec", lambda run: run.conversion.theory, "by base to height", converted=False),
    Quantity("base_to_height", lambda run: run.conversion.base_to_height, "base over height of the pair"),
)
SLOPES: Record[Array] = Record(
    "Change of the mean height with the parameters of one camera in the analysis, at the reference.",
    Quantity("d_alpha_m_per_arcsec", lambda slope: slope[0], "with Δα", "Δα", 4, converted=False),
    Quantity("d_beta_m_per_arcsec", lambda slope: slope[1], "with Δβ", "Δβ", 4, converted=False),
    Quantity("d_gamma_m_per_arcsec", lambda slope: slope[2], "with Δγ", "Δγ", 4, converted=False),
    Quantity("d_f_m_per_um", lambda slope: slope[3], "with the principal distance", "Δf", 6, converted=False),
)
BY_CAMERA: Record[tuple[MonitorRun, str]] = Record(
    "Height change by one camera, at the reference.",
    Quantity("traced_m_per_arcsec", lambda of: of[0].conversion.traced[of[1]], "", "traced", 4, converted=False),
    Quantity("theory_m_per_arcsec", lambda of: of[0].conversion.theory[of[1]], "", "theory", 4, converted=False),
    *SLOPES.of_part(lambda of: _sensitivity(of[0])[of[1]]),
)


def _scatter_differs(run: MonitorRun) -> str:
    ratio, (low, high) = run.scatter.spread / run.scatter.sigma, run.scatter.limits
    return f"scatter and predicted sigma of the heights differ: ratio {ratio:.3g}, limits {low:.2f} to {high:.2f}"


PROPAGATION: Record[MonitorRun] = Record(
    "Standard deviation of the mean height, and its test against repeats at one time.",
    Quantity("height_m_sigma_noise", lambda run: _unsigned(run.sigma), "over the times, by the monitor's noise"),
    Quantity("height_m_sigma", lambda run: _unsigned(run.sigma_total), "by the whole error; null without a prior"),
    Quantity("time_s", lambda run: run.times[run.worst], "time of the repeats"),
    Quantity("repeats", lambda run: len(run.scatter.heights), "number of repeats"),
    Quantity("sigma_m", lambda run: run.scatter.sigma, "predicted standard deviation"),
    Quantity("spread_m", lambda run: run.scatter.spread, "standard deviation over the repeats"),
    Quantity("ratio", lambda run: run.scatter.spread / run.scatter.sigma, "spread over sigma"),
    Quantity("lower_limit", lambda run: run.scatter.limits[0], "lower limit of the ratio"),
    Quantity("upper_limit", lambda run: run.scatter.limits[1], "upper limit of the ratio"),
    Quantity("agrees", lambda run: run.scatter.agrees, "true if it lies within", warning=_scatter_differs),
)
SMOOTHED: Record[tuple[MonitorRun, float, Smoothing]] = Record(
    "Heights with values smoothed from the measurements at one interval.",
    Quantity("interval_s", lambda of: of[1], "time between measurements", "interval", 1, shown="min"),
    Quantity("measurements", lambda of: len(of[0].spec.measured(of[1])), "number of measurements", "measurements"),
    Quantity("height_rms_m", lambda of: of[2].case.height_rms, "RMS error in height over all times"),
    Quantity("height_linear_rms_m", lambda of: of[2].interpolated.camera_height_rms, "interpolated", "linear", 3),
    Quantity("height_camera_rms_m", lambda of: of[2].case.camera_height_rms, "smoothed", "smoothed", 3),
    Quantity("better_than_interpolation", lambda of: of[2].factor, "interpolated over smoothed", "factor", 2),
    Quantity("height_sigma_rms_m", lambda of: rms(of[2].sigma), "RMS of the sigma by the smoother", "σ", 3),
    Quantity("largest_ratio", lambda of: of[2].largest_ratio, "largest error over its sigma", "largest/σ", 2),
    Quantity("ratio_limit", lambda of: of[2].limit, "limit of this ratio"),
    Quantity("agrees", lambda of: of[2].agrees, "true if the ratio lies within its limit"),
    Quantity("chi_square", lambda of: of[2].consistency.chi_square, "chi-square of the measured shifts", "χ²", 1),
    Quantity("degrees_of_freedom", lambda of: of[2].consistency.degrees, "of chi-square", "degrees of freedom"),
    Quantity("chi_square_limit", lambda of: of[2].consistency.limit, "limit of chi-square"),
    Quantity("shifts_agree", lambda of: of[2].consistency.agrees, "true if chi-square lies within its limit"),
)


def _readings(run: MonitorRun) -> dict[str, Any]:
    readings = run.together[run.spec.cadence].readings
    return {name: readings[name].to_dict() for name in run.pair}


def _wrong(run: MonitorRun) -> str:
    far, limit = run.smoothed.largest_ratio, run.smoothed.limit
    return f"errors of the smoothed heights reach {far:.3g} times their sigma, limit {limit:.2f}"


SMOOTHING: Record[MonitorRun] = Record(
    "Changes smoothed from all measurements, under the prior of disturbances.",
    Quantity("disturbances", lambda run: run.setup.disturbances and run.setup.disturbances.name, "name of the prior"),
    Quantity("cameras", _readings, "changes at the file's interval, with sigmas"),
    Quantity("height_error_m", lambda run: _unsigned(run.smoothed.error), "mean height error over the times"),
    Quantity("height_m_sigma", lambda run: _unsigned(run.smoothed.sigma), "its sigma by the smoother"),
    Quantity(
        "shifts_agree",
        lambda run: run.smoothed.consistency.agrees,
        "true if the measurements at the file's interval agree with the prior",
        warning=lambda run: (
            f"the measured shifts contradict the prior: chi-square {run.smoothed.consistency.chi_square:.4g}, limit "
            f"{run.smoothed.consistency.limit:.4g}; the sigmas are not reliable"
        ),
    ),
    Quantity("agrees", lambda run: run.smoothed.agrees, "true if smoothed heights agree with σ", warning=_wrong),
    Quantity("intervals", lambda run: [(run, *item) for item in run.smoothing.items()], record=SMOOTHED),
)
PART: Record[Array] = Record(
    "A part of the mean height error of the monitored cameras.",
    Quantity("height_rms_m", rms, "RMS over the times", "RMS", 4),
    Quantity("height_largest_m", lambda part: np.abs(part).max(), "largest over the times", "largest", 4),
    Quantity("height_m", _unsigned, "signed values over the times"),
)
CAUSE: Record[tuple[MonitorRun, Cause]] = Record(
    "Effect of one temperature or motion of the file alone, at one time.",
    Quantity("what", lambda of: of[1].what, "temperature or motion", "cause"),
    Quantity("node", lambda of: of[1].path, "node of the instrument's tree"),
    Quantity("true", lambda of: of[1].truth, "true changes, by camera", record=CHANGES),
    Quantity("monitor_error", lambda of: of[1].error, "reading without noise minus truth, by camera", record=CHANGES),
    Quantity("height_without_monitoring_m", lambda of: of[0].cause_heights(of[1])[0], "caused", "unmonitored", 3),
    Quantity("height_left_by_monitor_m", lambda of: of[0].cause_heights(of[1])[1], "by misreading", "misread", 3),
)


def _sensitivity(run: MonitorRun) -> dict[str, Array]:
    return {name: run.slopes[name][run.spec.reference_index] / PER_SI for name in run.pair}


MONITOR: Record[MonitorRun] = Record(
    "Content of monitor.json; errors at the top level are those with the file's interval.",
    Quantity("seed", lambda run: run.seed, "seed of all random numbers"),
    Quantity("interval_s", lambda run: run.spec.cadence, "time between measurements in the file"),
    Quantity("height_rms_m", lambda run: run.cases["interval"].height_rms, "RMS error in height"),
    Quantity("height_worst_m", lambda run: run.cases["interval"].worst, "RMS error in height at the worst time"),
    Quantity("height_camera_rms_m", lambda run: run.cases["interval"].camera_height_rms, "in height by the cameras"),
    Quantity("plan_rms_m", lambda run: run.cases["interval"].plan_rms, "RMS error in plan"),
    Quantity("height_m_per_arcsec", lambda run: run.conversion.of_angle, "height by the angle", converted=False),
    Quantity("times_s", lambda run: run.times, "times of the course"),
    Quantity("reference_time_s", lambda run: run.spec.reference_time, "when cameras and monitor are calibrated"),
    Quantity("monitored_times_s", lambda run: run.times[run.spec.measured(run.spec.cadence)], "times of measurements"),
    Quantity("cameras", lambda run: {name: (run, name) for name in run.pair}, record=CAMERA),
    Quantity("intersection_angle", lambda run: run, record=ANGLE),
    Quantity("cases", lambda run: run.cases, "errors by correction of the cameras", record=CASE),
    Quantity("intervals", lambda run: [(run, interval) for interval in run.intervals], record=INTERVAL),
    Quantity("conversion", lambda run: run, record=CONVERSION),
    Quantity("sensitivity", _sensitivity, record=SLOPES),
    Quantity("propagation", lambda run: run, record=PROPAGATION),
    Quantity("estimator", lambda run: run.estimator, "estimator of the monitor"),
    Quantity("smoothing", lambda run: run if run.smoothing else None, record=SMOOTHING),
    Quantity("parts", lambda run: run.parts, "parts of the height error by source", record=PART),
    Quantity("causes", lambda run: [(run, cause) for cause in run.causes], record=CAUSE),
    Quantity("correction_residual_arcsec", lambda run: run.residual, "largest direction error of the correction"),
)


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _defocus(of: tuple[loop_run.LoopRun, loop_run.LoopOutcome, str]) -> Array:
    return of[1].true(of[0].model.unit(of[2], "defocus"))


def _posterior_defocus(of: tuple[loop_run.LoopRun, loop_run.LoopOutcome, str]) -> tuple[Array, Array]:
    return of[1].posterior(of[0].model.unit(of[2], "defocus"))


FOCUS: Record[tuple[loop_run.LoopRun, loop_run.LoopOutcome, str]] = Record(
    "Focus of one camera, best focus less line CCD, over the moments.",
    Quantity("defocus_um", _defocus, "true defocus"),
    Quantity("estimated_um", lambda of: _posterior_defocus(of)[0], "posterior mean"),
    Quantity("estimated_um_sigma", lambda of: _posterior_defocus(of)[1], "posterior standard deviation"),
    Quantity("defocus_rms_um", lambda of: rms(_defocus(of)), "RMS over the moments"),
    Quantity("mtf_along_line", lambda o: o[1].mtf[o[2]][:, 0], "MTF with the pixel at Nyquist, mean over the fields"),
    Quantity("mtf_along_track", lambda o: o[1].mtf[o[2]][:, 1], "MTF with the pixel at Nyquist, mean over the fields"),
)
MOMENTS: Record[loop_run.LoopOutcome] = Record(
    "Errors of each moment.",
    Quantity("angle_arcsec", lambda o: o.true(o.angle) + 0.0, "true error of the angle"),
    Quantity("angle_estimated_arcsec", lambda o: o.posterior(o.angle)[0] + 0.0, "posterior mean"),
    Quantity("angle_estimated_arcsec_sigma", lambda o: o.posterior(o.angle)[1], "posterior standard deviation"),
    Quantity("height_m", lambda o: o.heights.camera + 0.0, "mean height error by the cameras"),
    Quantity("height_estimated_m", lambda o: o.posterior(o.slopes)[0] + 0.0, "posterior mean"),
    Quantity("height_estimated_m_sigma", lambda o: o.posterior(o.slopes)[1], "posterior standard deviation"),
    Quantity("height_rms_m", lambda o: o.heights.height, "RMS of all errors at the points"),
    Quantity("chi_square", lambda o: o.course.chi_square, "chi-square of each reading against its prediction"),
)


def _foci(of: tuple[loop_run.LoopRun, loop_run.LoopOutcome]) -> float:
    return rms(np.concatenate([_defocus((*of, name)) for name in of[0].pair]))


def _contradicted(of: tuple[loop_run.LoopRun, loop_run.LoopOutcome]) -> str:
    course, label = of[1].course, "closed" if of[1] is of[0].closed else "open"
    where = "" if (at := course.contradiction) is None else f", first at {moment(float(course.times[at]))}"
    return (
        f"with the loop {label} the readings contradict the prior of the motions{where}: chi-square "
        f"{course.chi_square.sum():.4g} for {course.degrees} degrees of freedom, limit {course.limit:.4g}; the "
        "posterior's sigmas are not reliable"
    )


PASS: Record[tuple[loop_run.LoopRun, loop_run.LoopOutcome]] = Record(
    "Errors over the moments with the loop closed or open.",
    Quantity("angle_rms_arcsec", lambda of: rms(of[1].true(of[1].angle)), "RMS error of the angle", "angle", 3),
    Quantity("angle_sigma_rms_arcsec", lambda of: rms(of[1].posterior(of[1].angle)[1]), "by the posterior", "σ", 3),
    Quantity(
        "height_camera_rms_m", lambda of: loop_run.height_rms(of[1]), "mean height error by the cameras", "height", 3
    ),
    Quantity("height_sigma_rms_m", lambda of: rms(of[1].posterior(of[1].slopes)[1]), "by the posterior", "σ", 3),
    Quantity("height_rms_m", lambda of: of[1].heights.height_rms, "RMS of all errors in height", "all errors", 3),
    Quantity("defocus_rms_um", _foci, "defocus of the pair's cameras together", "defocus", 2),
    Quantity(
        "mtf_least",
        lambda of: min(float(of[1].mtf[n].min()) for n in of[0].pair),
        "with the pixel, at Nyquist",
        "least MTF",
        3,
    ),
    Quantity("heights", lambda of: SUMMARY(of[1].heights), "errors at the check points", converted=False),
    Quantity("focus", lambda of: {name: (*of, name) for name in of[0].model.cameras}, "by camera", record=FOCUS),
    Quantity("series", lambda of: of[1], "over the moments", record=MOMENTS),
    Quantity("chi_square", lambda of: float(of[1].course.chi_square.sum()), "chi-square of all readings"),
    Quantity("degrees_of_freedom", lambda of: of[1].course.degrees, "degrees of freedom of chi-square"),
    Quantity("chi_square_limit", lambda of: of[1].course.limit, "limit of chi-square"),
    Quantity("agrees", lambda of: of[1].course.agrees, "true if readings agree with the prior", warning=_contradicted),
)


def positions(run: loop_run.LoopRun, name: str) -> Array:
    """Return the commanded positions of a mechanism when images are taken, (T,) for T moments, in its unit."""
    k = [corrector.name for corrector in run.model.correctors].index(name)
    return np.asarray(run.closed.course.positions[:, k] / run.model.correctors[k].unit[1] + 0.0)


def _unstable_alone(of: tuple[loop_run.LoopRun, str, loop_run.LoopAnalysis]) -> str:
    limit, delay = of[2].margins.limit, of[2].corrector.spec.delay
    return (
        f"{of[1]} is unstable by itself: its loop gain of {of[2].loop_gain:.3g} is not below {limit:.3g}, the limit of "
        f"a delay of {delay}"
    )


CORRECTION: Record[tuple[loop_run.LoopRun, str, loop_run.LoopAnalysis]] = Record(
    "One correction as a loop.",
    Quantity("camera", lambda of: of[2].corrector.spec.camera, "camera of the corrected quantity"),
    Quantity("quantity", lambda of: of[2].corrector.spec.quantity, "corrected quantity"),
    Quantity("mechanism", lambda of: of[2].corrector.spec.mechanism, "null for the processing on the ground"),
    Quantity("gain", lambda of: of[2].corrector.spec.gain, "stated gain", "gain", 3),
    Quantity("delay", lambda of: of[2].corrector.spec.delay, "delay in readings"),
    Quantity("loop_gain", lambda of: of[2].loop_gain, "gain with the observed response of the mechanism"),
    Quantity("observed_share", lambda o: _observed_share(*o), "share of its response error", "observed", 3, None, True),
    Quantity("gain_limit", lambda of: of[2].margins.limit, "below which this loop is stable", "limit", 4),
    Quantity("gain_margin", lambda of: _known(of[2].margins.gain), "limit over loop gain; null for gain 0", decimals=2),
    Quantity("phase_margin_deg", lambda of: _known(of[2].margins.phase_deg), "", "phase margin", 1, converted=False),
    Quantity("stable", lambda of: of[2].margins.stable, "true if stable by itself", warning=_unstable_alone),
    Quantity("cycle_steps", lambda of: of[2].cycle and of[2].cycle.steps, "of the limit cycle, peak to peak", "cycle"),
    Quantity("unit", lambda of: of[2].corrector.unit[0], "unit of positions"),
    Quantity("positions", lambda of: positions(of[0], of[1]), "when images are taken", converted=False),
    Quantity("saturated_s", lambda o: [float(o[0].closed.course.times[k]) for k in o[2].ends], "at its range's end"),
)


def _observed_share(run: loop_run.LoopRun, name: str, facts: loop_run.LoopAnalysis) -> float | None:
    k = [corrector.name for corrector in run.model.correctors].index(name)
    return None if facts.corrector.motion is None else float(run.model.observed_share[k])


def motions_of(run: loop_run.LoopRun, mode: UnobservableMode) -> list[dict[str, Any]]:
    """Return the largest motions in an unobservable mode, with their sizes for one standard deviation of the mode."""
    prior = run.model.prior
    order = np.argsort(-np.abs(mode.motions), kind="stable")[:MOST_MOTIONS]
    return [
        {"motion": prior.labels[k], "amount": float(mode.motions[k] * prior.sigmas[k]), "unit": prior.units[k]}
        for k in order.tolist()
    ]


MODE: Record[tuple[loop_run.LoopRun, UnobservableMode]] = Record(
    "Unobservable mode: a combination of motions that moves no spot, for one standard deviation.",
    Quantity("height_m", lambda of: float(of[1].quantities[0]), "height error", "height", 3),
    Quantity("angle_arcsec", lambda of: angle_of(*of), "change of the angle", "angle", 4),
    Quantity("defocus_first_um", lambda of: float(of[1].quantities[1]), "of the pair's first camera", decimals=2),
    Quantity("defocus_second_um", lambda of: float(of[1].quantities[2]), "of its second camera", decimals=2),
    Quantity("largest_spot_px", lambda of: of[1].spots, "largest shift of a spot"),
    Quantity("bodies", lambda of: dict(of[1].bodies), "body -> share of the variance"),
    Quantity("motions", lambda of: motions_of(*of), "motions and amounts", "largest motions", converted=False),
)


def angle_of(run: loop_run.LoopRun, mode: UnobservableMode) -> float:
    """Return the change of the intersection angle for one standard deviation of an unobservable mode, in radians."""
    return float(run.open.angle @ run.model.prior.parameters @ mode.motions)


def _near_limit(run: loop_run.LoopRun) -> str:
    gains = f"{significant(run.margin, 3)} times the stated ones"
    if not run.stable:
        return f"the loops together are unstable: largest eigenvalue {run.radius:.3g}; gains below {gains} are stable"
    nearest = min(run.loops, key=lambda name: run.loops[name].margins.gain)
    return (
        f"the loop is barely stable: gains of {gains} make it unstable, phase margin {run.phase_deg:.0f} deg; it "
        f"amplifies disturbances near its crossover. Usual are {loop_run.GAIN_MARGIN:g} times and "
        f"{loop_run.PHASE_MARGIN_DEG:g} deg at least: lower the gains, that of {nearest} first"
    )


LOOP: Record[loop_run.LoopRun] = Record(
    "Results with the loop closed and open.",
    Quantity("height_closed_rms_m", lambda run: loop_run.height_rms(run.closed), "by the cameras, loop closed"),
    Quantity("height_open_rms_m", lambda run: loop_run.height_rms(run.open), "by the cameras, loop open"),
    Quantity("height_sigma_rms_m", lambda run: rms(run.closed.posterior(run.closed.slopes)[1]), "by the posterior"),
    Quantity(
        "height_unobservable_rms_m",
        lambda run: rms(run.unobservable_sigma[0]),
        "unobservable part, one standard deviation",
    ),
    Quantity("angle_closed_rms_arcsec", lambda run: rms(run.closed.true(run.closed.angle)), "loop closed"),
    Quantity("angle_open_rms_arcsec", lambda run: rms(run.open.true(run.open.angle)), "loop open"),
    Quantity("gain_margin", lambda run: _known(run.margin), "gain margin of all loops together"),
    Quantity("phase_margin_deg", lambda run: _known(run.phase_deg), "smallest phase margin", converted=False),
    Quantity("spectral_radius", lambda run: run.radius, "of all loops together; below 1 errors decay"),
    Quantity("stable", lambda run: run.stable, "true if all loops together are stable"),
    Quantity("margins_hold", lambda run: run.margins_hold, "true if margins are large enough", warning=_near_limit),
    Quantity("made_worse", lambda run: list(run.worse), "errors that are larger with the loop closed"),
    Quantity("largest_ratios", lambda run: run.ratios, "quantity -> largest error of the posterior over its sigma"),
    Quantity("ratio_limit", lambda run: run.ratio_limit, "limit of these ratios"),
    Quantity("corrections", lambda run: {n: (run, n, loop) for n, loop in run.loops.items()}, record=CORRECTION),
    Quantity("closed", lambda run: PASS((run, run.closed)), "with the corrections", converted=False),
    Quantity("open", lambda run: PASS((run, run.open)), "without the corrections", converted=False),
    Quantity("bare", lambda run: SUMMARY(run.closed.flight.true_case), "by the true cameras", converted=False),
    Quantity("unobservable_modes", lambda run: [(run, mode) for mode in run.modes], record=MODE),
    Quantity("unobservable_height_m", lambda run: run.unobservable_sigma[0], "1σ, over the moments"),
    Quantity("unobservable_defocus_um", lambda run: run.unobservable_sigma[1:, 0], "1σ, of the pair"),
)
CLOSED: Record[loop_run.LoopRun] = Record(
    "Content of monitor.json with mechanisms.",
    Quantity("seed", lambda run: run.seed, "seed of all random numbers"),
    Quantity("times_s", lambda run: run.closed.course.times, "times of the readings"),
    Quantity("loop", lambda run: run, "with the loop closed and open", record=LOOP),
)


def monitor_numbers(run: MonitorRun | loop_run.LoopRun) -> dict[str, Any]:
    """Return the numbers that monitor.json contains: changes, angle, heights and their errors."""
    return CLOSED(run) if isinstance(run, loop_run.LoopRun) else MONITOR(run)
