"""Result quantities of an in-orbit calibration, written to calibration.json, in metres and radians."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from analysis.arrays import Array
from analysis.calibration.adjustment import FALSE_ALARM, Adjustment
from analysis.calibration.strip_adjustment import Datum
from analysis.orbit.calibration_parameters import RATE, Combination
from analysis.orbit.forward_intersection import CheckErrors
from analysis.orbit.three_line_model import BIAS
from twin.framework.record import Quantity, Record
from twin.orbit.calibration import schemes
from twin.orbit.calibration.calibration_run import CalibrationRun, FieldResult, Unknown, unit, unknowns
from twin.orbit.calibration.campaign import Campaign, FieldImages, FieldPass, Screening, interior_names
from twin.orbit.calibration.campaign_adjustment import LatitudeFit, ground_sample, intersection_fit
from twin.orbit.calibration.influences import AttitudeDrift, ChipStep, UnexpectedChange
from twin.orbit.images.patch import LineComparison
from twin.orbit.images.simulate_run import MATCH_COUNTS

# --- errors at check points, by scheme -------------------------------------------------------------------

ERRORS: Record[CheckErrors | schemes.FieldErrors] = Record(
    "RMS errors at check points, in metres.",
    Quantity("plan_rms_m", lambda e: e.plan_rms, "RMS error in plan, east and north together", "plan", 2),
    Quantity("height_rms_m", lambda e: e.height_rms, "RMS error in height", "height", 2),
)
MEANS: Record[schemes.SchemeMeans] = Record(
    "RMS errors over the fields, for each scheme of averaged parameters.",
    Quantity("plan_mean_m", lambda means: means.plan, "mean over the fields in plan"),
    Quantity("plan_spread_m", lambda means: means.plan_spread, "standard deviation over the fields in plan"),
    Quantity("height_mean_m", lambda means: means.height, "mean over the fields in height"),
    Quantity("height_spread_m", lambda means: means.height_spread, "standard deviation over the fields in height"),
)
TREATMENT: Record[schemes.Treatment] = Record(
    "Errors of drifting cameras, adjusted with the monitor's readings or without.",
    Quantity("all_fields", lambda t: t.together, "errors with all fields adjusted at once", record=ERRORS),
    Quantity("p_value", lambda t: t.p_value, "probability of a chi-square at least as large in that adjustment"),
    Quantity("schemes", lambda t: t.schemes, "errors without ground control, by scheme", record=ERRORS),
)
MONITORING: Record[schemes.Monitoring] = Record(
    "Cameras that drift from field to field, with and without the on-board monitor.",
    Quantity("noise_counts_as", lambda m: "independent", "model of the noise of orbit and attitude"),
    Quantity("without_monitor", lambda m: m.without, "adjusted as if no camera drifted", record=TREATMENT),
    Quantity("with_monitor", lambda m: m.monitored, "adjusted with the monitor's readings", record=TREATMENT),
)
TIES: Record[tuple[Mapping[str, CheckErrors], Mapping[str, CheckErrors]]] = Record(
    "Errors of a scheme without and with tie points, over the check points of all fields.",
    Quantity("without_ties", lambda e: schemes.FieldErrors.pooled(e[0].values()), head="without ties", record=ERRORS),
    Quantity("with_ties", lambda e: schemes.FieldErrors.pooled(e[1].values()), head="with ties", record=ERRORS),
)
DATUM_SIGMA: Record[Datum] = Record(
    "Uncertainty of a rotation of the whole pass.",
    Quantity("sigma_before", lambda d: d.before, "standard deviation from the readings alone", shown="arcsec"),
    Quantity("sigma_after", lambda d: d.after, "standard deviation with the tie points", shown="arcsec"),
    Quantity("unit", lambda d: "rad/s" if "rate" in d.name else "rad", "unit of both sigmas"),
)


def _strips(run: CalibrationRun) -> schemes.Strips:
    assert run.strips is not None
    return run.strips


STRIPS: Record[CalibrationRun] = Record(
    "Passes adjusted on tie points.",
    Quantity("ties", lambda run: _strips(run).ties, "number of tie points that two lines or more see, by field"),
    Quantity("p_value", lambda run: _strips(run).p_values, "probability of a chi-square at least as large, by field"),
    Quantity("schemes", lambda r: {k: (r.schemes[k], tied) for k, tied in _strips(r).schemes.items()}, record=TIES),
    Quantity("datum", lambda run: {d.name: d for d in _strips(run).datum}, record=DATUM_SIGMA),
)
MAP_LIMITS: Record[CalibrationRun] = Record(
    "Compliance of the schemes with the limits of a map in every field.",
    Quantity("scale", lambda run: "1:50000", "scale of the map"),
    Quantity("plan_limit_m", lambda run: run.setup.test.limits.plan, "largest RMS error in plan"),
    Quantity("height_limit_m", lambda run: run.setup.test.limits.height, "largest RMS error in height"),
    Quantity("source", lambda run: "of the file", "source of the limits"),
    Quantity(
        "before",
        lambda run: schemes.meets(run.before, run.setup.test.limits),
        "true if the laboratory's camera meets it",
    ),
    Quantity("schemes", lambda run: {k: schemes.meets(e, run.setup.test.limits) for k, e in run.schemes.items()}),
)

# --- points measured in images ---------------------------------------------------------------------------


_SCREENED = {
    "entered": "image points of control and tie points before screening",
    "left": "image points after screening",
    "wrong_entered": "wrong positions before screening",
    "wrong_left": "wrong positions after screening",
    "check_entered": "check points before the test of their intersection",
    "check_left": "check points after the test of their intersection",
    "wrong_check_left": "check points after that test with a wrong position in a line",
}
"""Counts of image points and check points before and after screening: attribute of `Screening` -> meaning."""


def _sums(meanings: Mapping[str, str], parts: Callable[[Any], Any] = lambda parts: parts) -> list[Quantity[Any]]:
    """Return quantities that are sums of a count over line images or fields.

    Parameters
    ----------
    meanings : Mapping[str, str]
        Attribute of a part, which is also the key of the result -> what it counts.
    parts : Callable
        Function that returns the parts of a source; by default the source itself is the sequence of parts.
    """

    def total(name: str) -> Callable[[Any], int]:
        return lambda source: sum(getattr(part, name) for part in parts(source))

    return [Quantity(name, total(name), meaning) for name, meaning in meanings.items()]


SCREENED: Record[Screening] = Record(
    "Image points of a field in the adjustment.", *_sums(_SCREENED, lambda screening: [screening])
)


def _degrees(parts: Sequence[LineComparison]) -> Array:
    return np.array([j.degrees_of_freedom for j in parts], float)


def _rms(parts: Sequence[LineComparison]) -> Array:
    """Return the (2,) RMS error of correctly matched positions, along the track and along the line, in pixels."""
    degrees = _degrees(parts)
    square = np.sum([np.nan_to_num(j.rms) ** 2 * n for j, n in zip(parts, degrees, strict=True)], axis=0)
    return np.asarray(np.sqrt(square / max(degrees.sum(), 1.0)))


MATCHING: Record[Sequence[LineComparison]] = Record(
    "Matches of one sort of points in the images of one line, over the patches of a field.",
    *_sums(MATCH_COUNTS),
    Quantity("rms_lines_px", lambda parts: _rms(parts)[0], "RMS error along track of correct positions", "RMS track"),
    Quantity("rms_pixels_px", lambda parts: _rms(parts)[1], "RMS error along line of correct positions", "RMS line"),
    Quantity(
        "chi_square_ratio",
        lambda parts: sum(j.chi_square for j in parts) / max(_degrees(parts).sum(), 1.0),
        "chi-square of the errors of these positions over its degrees of freedom",
        "χ²/dof",
    ),
)


def _by_line(images: FieldImages) -> dict[str, dict[str, list[LineComparison]]]:
    """Return the comparisons of a field's matched points with the truth.

    The result maps the sort of points (control or tie), then the line, to a list with one comparison per patch.
    """
    parts: dict[str, dict[str, list[LineComparison]]] = {}
    for patch in images.patches:
        for sort, lines in patch.judgements.items():
            for line, judgement in lines.items():
                parts.setdefault(sort, {}).setdefault(line, []).append(judgement)
    return parts


def _judgements(campaign: Campaign) -> list[LineComparison]:
    by_line = [lines for images in campaign.images or () for lines in _by_line(images).values()]
    return [judgement for lines in by_line for parts in lines.values() for judgement in parts]


def _screenings(campaign: Campaign) -> list[Screening]:
    return [images.screening for images in campaign.images or () if images.screening is not None]


TOTAL: Record[Campaign] = Record(
    "Counts of points in images, over all fields and lines; wrong positions are known from the truth.",
    *_sums(MATCH_COUNTS, _judgements),
    *_sums(_SCREENED, _screenings),
    Quantity(
        "right_rejected_by_adjustment",
        lambda campaign: sum(s.right_lost for s in _screenings(campaign)),
        "correct positions that the adjustment rejected",
    ),
)
IMAGES: Record[Campaign] = Record(
    "Points measured in rendered images.",
    Quantity("total", lambda campaign: campaign, "sums over all fields and lines", record=TOTAL),
    Quantity(
        "fields",
        lambda campaign: {images.name: _by_line(images) for images in campaign.images or ()},
        "by sort of points and line",
        record=MATCHING,
    ),
)

# --- parameters and fields -------------------------------------------------------------------------------

UNKNOWN: Record[Unknown] = Record(
    "An unknown of the adjustment of all fields.",
    Quantity("value", lambda u: u.value, "estimated value"),
    Quantity("sigma", lambda u: u.sigma, "standard deviation with the held unknowns of the gauge taken as exact"),
    Quantity(
        "sigma_with_gauge", lambda u: u.sigma_with_gauge, "standard deviation with the held unknowns' launch sigmas"
    ),
    Quantity(
        "share_from_launch",
        lambda u: u.prior_share,
        "share of its variance that comes from the sigmas of launch and season and not from the points, 0 to 1",
    ),
    Quantity("held", lambda u: u.held, "true if the gauge holds it"),
    Quantity("truth", lambda u: u.truth, "true value, where a simulation knows it"),
    Quantity("unit", lambda u: u.unit, "unit of value, sigmas and truth"),
)


def _conditions(run: CalibrationRun) -> str:
    names = run.together.names
    rates = any(name in RATE for name in names)
    by_pass = any(name.endswith(RATE) for name in names) and not rates
    return (
        "with the held unknowns of the gauge taken as exact"
        + ", and with the drift of the biases during the passes predicted by the latitude fit" * rates
        + ", and with the stated or detected drift of the attitude in each pass" * by_pass
    )


SIGMAS: Record[CalibrationRun] = Record(
    "Conditions under which the sigmas hold.",
    Quantity("sigma", _conditions),
    Quantity("sigma_with_gauge", lambda run: "with the launch sigmas of the held unknowns, propagated to all others"),
    Quantity("fixed_start_m_sigma", lambda run: run.setup.test.launch.interior, "sigma of fixed unknowns after launch"),
    Quantity("fields", lambda run: "for each field by itself: without the drift of the biases during the pass"),
)


def _free(adjustment: Adjustment) -> list[int]:
    """Return the indices of the estimated unknowns, those that the gauge does not fix."""
    sigma = adjustment.sigma
    return [k for k, name in enumerate(adjustment.names) if sigma[name] > 0.0]


CORRELATIONS: Record[Adjustment] = Record(
    "Correlations of the unknowns that are not held.",
    Quantity("names", lambda a: [a.names[k] for k in _free(a)], "unknowns of rows and columns"),
    Quantity("matrix", lambda a: np.round(a.correlation[np.ix_(_free(a), _free(a))], 6), "correlation matrix"),
)
COMBINATION: Record[Combination] = Record(
    "A combination of unknowns that the measurements do not determine, or only weakly.",
    Quantity(
        "change",
        lambda c: dict(zip(c.names, c.change, strict=True)),
        "change of each unknown, scaled so that none of them moves an image point by more than 1 mm",
    ),
    Quantity("strength", lambda c: c.strength, "its uncertainty over that of its unknowns alone"),
    Quantity("sigma_m", lambda c: c.sigma, "standard deviation, as motion in the image"),
)
ATTITUDE_DRIFT: Record[AttitudeDrift] = Record(
    "Test of a drift of the attitude within the passes.",
    Quantity("seconds", lambda d: d.seconds, "time from when the first line sees a field to when the last one does"),
    Quantity(
        "sigmas_per_arcsec",
        lambda d: d.sigmas_per_arcsec,
        "change of each unknown, in its sigmas, for a drift of 1 arcsec in these seconds that is not estimated",
        converted=False,
    ),
    Quantity("detectable_arcsec", lambda d: d.detectable, "drift about body X, Y, Z detected in half of all cases"),
    Quantity("undetected_sigmas", lambda d: d.undetected_sigmas, "error of the most sensitive unknown then, in sigmas"),
    Quantity("rate_p_value", lambda d: d.rate_p_value, "p-value of the residuals without rates of the attitude"),
    Quantity("course_p_value", lambda d: d.course_p_value, "p-value of the residuals without slow errors of the lines"),
    Quantity("false_alarm", lambda d: FALSE_ALARM, "false-alarm probability of either test"),
    Quantity(
        "assumed_rate_rad_s", lambda d: d.assumed and d.assumed.rate, "sigma of the rates assumed after detection"
    ),
    Quantity(
        "assumed_walk_rad", lambda d: d.assumed and d.assumed.walk, "sigma of the random walk assumed, in one second"
    ),
)
UNLIKELY = 1e-3
"""p-value of chi-square below which the adjustment is reported as inconsistent with its sigmas."""


def _fits(run: CalibrationRun) -> bool | None:
    return run.together.p_value >= UNLIKELY if run.campaign.spec.errors.switched_on else None


def _misfit(run: CalibrationRun) -> str:
    drifts = run.truth is not None and bool(run.campaign.simulated.drift)
    return (
        f"the residuals of the adjustment are larger than their sigmas predict (p = {run.together.p_value:.1g}): "
        f"biases may drift during a pass{', and the cameras drift from field to field' * drifts}"
    )


FIT: Record[CalibrationRun] = Record(
    "Fit of the adjustment of all fields.",
    Quantity("chi_square", lambda run: run.together.chi_square, "chi-square of the residuals"),
    Quantity("degrees_of_freedom", lambda run: run.together.degrees_of_freedom, "degrees of freedom of chi-square"),
    Quantity("p_value", lambda run: run.together.p_value, "probability of a chi-square at least as large"),
    Quantity("agrees", _fits, "true if residuals agree with their sigmas; null for exact points", warning=_misfit),
    Quantity("iterations", lambda run: run.together.iterations, "number of iterations of the adjustment"),
    Quantity("attitude_drift", lambda run: run.drift, "test of a drift", record=ATTITUDE_DRIFT),
)
CHIP_STEP: Record[ChipStep] = Record(
    "A step of x (along the track) or y within a line, at a joint between chips.",
    Quantity("line", lambda step: step.line, "line camera"),
    Quantity("axis", lambda step: step.axis, "direction of the step, x or y"),
    Quantity("place_m", lambda step: step.position, "position y of the joint in the focal plane", shown="mm"),
    Quantity("step_m", lambda step: step.step, "step estimated from the residuals", shown="um"),
    Quantity("sigma_m", lambda step: step.sigma, "its standard deviation, all steps estimated together", shown="um"),
    Quantity("detectable_m", lambda step: step.detectable, "step that is detected in half of all cases", shown="um"),
    Quantity("detected", lambda step: step.detected, "true if it is significant, false alarm 1e-4 for all together"),
)
STEPWISE: Record[CalibrationRun] = Record(
    "Stepwise solution of one field, interior orientation and biases in turn.",
    Quantity("field", lambda run: run.setup.test.schemes[0][0], "name of the field"),
    Quantity("rounds", lambda run: run.stepwise.rounds, "number of rounds until the steps are small"),
    Quantity("rate", lambda run: run.stepwise.rate, "convergence rate: remaining part of the slowest error per round"),
    Quantity(
        "converged",
        lambda run: run.stepwise.converged,
        "true if the steps become small",
        warning=lambda run: f"the stepwise solution has not converged after {run.stepwise.rounds} rounds",
    ),
)
BIAS_OF_FIELD: Record[tuple[float, float, float | None]] = Record(
    "Attitude bias of a field calibrated by itself.",
    Quantity("value", lambda bias: bias[0], "estimated value", "bias", 3, shown="arcsec"),
    Quantity("sigma", lambda bias: bias[1], "standard deviation", "σ", 3, shown="arcsec"),
    Quantity("truth", lambda bias: bias[2], "true value, where a simulation knows it", "truth", 3, shown="arcsec"),
    Quantity("unit", lambda bias: "rad", "unit of value, sigma and truth"),
)
INTERIOR_OF_FIELD: Record[tuple[float, float]] = Record(
    "Parameter of the interior orientation from one field.",
    Quantity("value", lambda parameter: parameter[0], "estimated value"),
    Quantity("sigma", lambda parameter: parameter[1], "standard deviation"),
    Quantity("unit", lambda parameter: "m", "unit of both"),
)


def _biases(result: tuple[FieldPass, FieldResult]) -> dict[str, tuple[float, float, float | None]]:
    field, adjustment = result[0], result[1].adjustment
    truth = [None] * len(BIAS) if field.known_truth is None else field.bias.tolist()
    sigma = adjustment.sigma
    return {
        name: (float(value), sigma[f"{field.name} {name}"], true)
        for name, value, true in zip(BIAS, adjustment.bias(field.name), truth, strict=True)
    }


def _interior(result: tuple[FieldPass, FieldResult]) -> dict[str, tuple[float, float]]:
    adjustment = result[1].adjustment
    sigma, inner = adjustment.sigma, interior_names(tuple(adjustment.cameras))
    return {name: (adjustment.value(name), sigma[name]) for name in adjustment.names if name in inner}


FIELD: Record[tuple[FieldPass, FieldResult]] = Record(
    "A field calibrated by itself.",
    Quantity("latitude_rad", lambda f: f[0].latitude, "mean latitude of the control points"),
    Quantity("bias", _biases, "roll, pitch and yaw of the attitude bias", record=BIAS_OF_FIELD),
    Quantity("interior", _interior, "interior orientation", record=INTERIOR_OF_FIELD),
    Quantity("p_value", lambda f: f[1].adjustment.p_value, "probability of a chi-square at least as large"),
    Quantity("orbit_third_difference_rms_m", lambda f: f[1].orbit and f[1].orbit.rms, "RMS for positions x, y, z"),
    Quantity(
        "attitude_third_difference_rms_rad", lambda f: f[1].attitude and f[1].attitude.rms, "RMS for roll, pitch, yaw"
    ),
)
MEASURED: Record[tuple[Campaign, FieldPass, Adjustment]] = Record(
    "Points of a measured pass, points rejected by screening, and ground sample distance.",
    Quantity("control_points", lambda m: int(m[1].is_control.sum()), "number of control points"),
    Quantity("tie_points", lambda m: m[1].tie_count, "number of tie points of calibration and strip"),
    Quantity("check_points", lambda m: len(m[1].check_ground), "number of check points"),
    Quantity(
        "image_points", lambda m: {k: len(row.point) for k, row in m[1].measurements.images.items()}, "number by line"
    ),
    Quantity(
        "gsd_m",
        lambda m: {name: ground_sample(m[1], name) for name in m[1].data.sensors},
        "ground sample distance along and across the track, by line camera",
    ),
    Quantity(
        "rejected",
        lambda m: _rejected(m, "points", []),
        "points with a rejected image point, and the line of that image point",
    ),
    Quantity("rejected_check_points", lambda m: _rejected(m, "check_points", []), "those whose rays do not intersect"),
    Quantity("sigma_factor", lambda m: _rejected(m, "factors"), "factor on the sigmas of image points, by line"),
    Quantity("check_chi_square", lambda m: intersection_fit(*m).chi_square, "chi-square of the check points' rays"),
    Quantity("check_degrees_of_freedom", lambda m: intersection_fit(*m).degrees_of_freedom, "its degrees of freedom"),
)


def _rejected(measured: tuple[Campaign, FieldPass, Adjustment], what: str, none: Any = None) -> Any:
    campaign, field, _ = measured
    rejected = campaign.rejected.get(field.name)
    return none if rejected is None else getattr(rejected, what)


LATITUDE: Record[LatitudeFit] = Record(
    "Fit of one axis of the biases: amplitude x sin(latitude - reference) + constant.",
    Quantity("amplitude_rad", lambda fit: fit.amplitude, "amplitude of the drift with latitude", shown="arcsec"),
    Quantity("amplitude_rad_sigma", lambda fit: fit.amplitude_sigma, "includes the remainder", "σ", shown="arcsec"),
    Quantity("constant_rad", lambda fit: fit.constant, "bias at the reference", shown="arcsec"),
    Quantity("constant_rad_sigma", lambda fit: fit.constant_sigma, "includes the remainder", "σ", shown="arcsec"),
    Quantity("reference_rad", lambda fit: fit.reference, "latitude in the middle of the fields"),
    Quantity("remainder_rad", lambda fit: fit.remainder, "standard deviation beyond the fit: season", shown="arcsec"),
    Quantity("chi_square", lambda fit: fit.chi_square, "chi-square with the biases' own covariance"),
    Quantity("degrees_of_freedom", lambda fit: fit.degrees_of_freedom, "degrees of freedom of this chi-square"),
    Quantity("p_value", lambda fit: fit.p_value, "probability of a chi-square at least as large by latitude alone"),
)
REPEATABILITY: Record[schemes.Repeatability] = Record(
    "Scatter of a parameter from field to field.",
    Quantity("name", lambda r: r.name, "name of the parameter"),
    Quantity("unit", lambda r: unit(r.name), "unit of scatter and sigma"),
    Quantity("scatter", lambda r: r.scatter, "standard deviation over the fields"),
    Quantity("sigma", lambda r: r.sigma, "sigma predicted by the adjustments of single fields, root mean square"),
    Quantity("p_value", lambda r: r.p_value, "p-value of this scatter if the parameter is the same in all fields"),
)

# --- errors that the fit hardly shows --------------------------------------------------------------------

UNEXPECTED_CHANGE: Record[UnexpectedChange] = Record(
    "Estimate that differs from its prior by more than launch and orbit explain.",
    Quantity("name", lambda u: u.name, "name of the unknown"),
    Quantity("change", lambda u: u.change, "estimated minus expected value"),
    Quantity("expected_sigma", lambda u: u.expected, "expected standard deviation of the change"),
    Quantity("ratio", lambda u: u.ratio, "absolute change over the expected sigma"),
    Quantity("unit", lambda u: unit(u.name), "unit of change and sigma"),
)

# --- the file --------------------------------------------------------------------------------------------


def _measured(run: CalibrationRun) -> dict[str, tuple[Campaign, FieldPass, Adjustment]] | None:
    if run.truth is not None:
        return None
    return {p.name: (run.campaign, p, run.fields[p.name].adjustment) for p in run.campaign.passes}


def _scheme_fields(run: CalibrationRun) -> dict[str, Sequence[str] | str]:
    return dict(zip(run.schemes, (*run.setup.test.schemes, "each its own"), strict=True))


CALIBRATION: Record[CalibrationRun] = Record(
    "Content of calibration.json, in metres and radians; undefined values are null.",
    Quantity("seed", lambda run: run.seed, "seed of all random numbers"),
    Quantity("parameters", unknowns, "unknowns of the adjustment of all fields", record=UNKNOWN),
    Quantity("sigmas", lambda run: run, record=SIGMAS),
    Quantity("correlations", lambda run: run.together, record=CORRELATIONS),
    Quantity("null_vectors", lambda run: run.together.open, "unobservable combinations", record=COMBINATION),
    Quantity("weak_vectors", lambda run: run.together.weak, "weakly observable combinations", record=COMBINATION),
    Quantity("gauge", lambda run: str(run.together.gauge), "unknowns that are held"),
    Quantity("images", lambda run: None if run.campaign.images is None else run.campaign, record=IMAGES),
    Quantity("measured", _measured, "measured points by pass; null for a simulation", record=MEASURED),
    Quantity("fit", lambda run: run, record=FIT),
    Quantity("chip_steps", lambda run: run.chip_steps, record=CHIP_STEP),
    Quantity("stepwise", lambda run: run, record=STEPWISE),
    Quantity("fields", lambda run: {p.name: (p, run.fields[p.name]) for p in run.campaign.passes}, record=FIELD),
    Quantity("schemes", lambda run: run.schemes, "errors by scheme and field, without ground control", record=ERRORS),
    Quantity("scheme_fields", _scheme_fields, "fields whose parameters each scheme averages"),
    Quantity("before", lambda run: run.before, "errors with the laboratory's camera, by field", record=ERRORS),
    Quantity("finding", lambda run: run.scheme_means, record=MEANS),
    Quantity("bias_latitude", lambda run: {fit.axis: fit for fit in run.latitude}, record=LATITUDE),
    Quantity("repeatability", lambda run: run.repeatability, record=REPEATABILITY),
    Quantity("unexpected_changes", lambda run: run.unexpected_changes, "largest ratio first", record=UNEXPECTED_CHANGE),
    Quantity("monitoring", lambda run: run.monitoring, record=MONITORING),
    Quantity("strips", lambda run: None if run.strips is None else run, record=STRIPS),
    Quantity("map_limits", lambda run: run, record=MAP_LIMITS),
)
