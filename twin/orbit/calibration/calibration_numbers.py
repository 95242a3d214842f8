"""Numbers of an in-orbit calibration, as calibration.json has them: metres and radians."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from analysis.arrays import Array
from analysis.calibration.adjustment import FALSE_ALARM, Adjustment
from analysis.calibration.strip_adjustment import Datum
from analysis.orbit.calibration_parameters import OFFSET, RATE, Combination
from analysis.orbit.forward_intersection import CheckErrors
from analysis.orbit.three_line_model import BIAS
from twin.framework.record import Quantity, Record
from twin.orbit.calibration.calibration_run import CalibrationRun, FieldResult, Unknown, unit, unknowns
from twin.orbit.calibration.campaign import Campaign, FieldImages, FieldPass, Screening, interior_names
from twin.orbit.calibration.campaign_adjustment import LatitudeFit
from twin.orbit.calibration.influences import AttitudeDrift, ChipStep, DatumRow, LightRow, Surprise
from twin.orbit.calibration.schemes import (
    DriftSize,
    FieldErrors,
    Monitoring,
    Repeatability,
    Repeats,
    SchemeMeans,
    Strips,
    Treatment,
    meets,
)
from twin.orbit.calibration.screening import ground_sample, meeting_of
from twin.orbit.images.patch import LineJudgement
from twin.orbit.images.simulate_run import MATCH_COUNTS

# --- errors at check points, by scheme -------------------------------------------------------------------

ERRORS: Record[CheckErrors | FieldErrors] = Record(
    "RMS errors at check points.",
    Quantity("plan_rms_m", lambda e: e.plan_rms, "in plan, east and north together"),
    Quantity("height_rms_m", lambda e: e.height_rms, "in height"),
)
MEANS: Record[SchemeMeans] = Record(
    "RMS errors over the fields, of each scheme of averaged parameters.",
    Quantity("plan_mean_m", lambda means: means.plan, "mean over the fields in plan"),
    Quantity("plan_spread_m", lambda means: means.plan_spread, "standard deviation over the fields in plan"),
    Quantity("height_mean_m", lambda means: means.height, "mean over the fields in height"),
    Quantity("height_spread_m", lambda means: means.height_spread, "standard deviation over the fields in height"),
)
REPEATED: Record[tuple[Array, Array, float]] = Record(
    "A scheme over the repeated campaigns.",
    Quantity("plan_rms_m", lambda r: r[0].mean(axis=1), "mean of the fields' RMS in plan, campaign by campaign"),
    Quantity("plan_spread_m", lambda r: r[0].std(axis=1), "standard deviation over the fields in plan"),
    Quantity("height_rms_m", lambda r: r[1].mean(axis=1), "mean of the fields' RMS in height, campaign by campaign"),
    Quantity("height_spread_m", lambda r: r[1].std(axis=1), "standard deviation over the fields in height"),
    Quantity("share_within_limits", lambda r: r[2], "share of the campaigns in which every field meets the limits"),
)


def _repeats(run: CalibrationRun) -> Repeats:
    assert run.repeats is not None
    return run.repeats


def _repeated(run: CalibrationRun) -> dict[str, tuple[Array, Array, float]]:
    repeats, limits = _repeats(run), run.setup.test.limits
    met = repeats.met(limits.plan, limits.height).tolist()
    return {name: (repeats.plan[:, k], repeats.height[:, k], met[k]) for k, name in enumerate(repeats.schemes)}


CAMPAIGNS: Record[CalibrationRun] = Record(
    "Campaigns repeated with everything drawn anew.",
    Quantity("count", lambda run: len(_repeats(run).plan), "number of campaigns"),
    Quantity("schemes", _repeated, record=REPEATED),
)
TREATMENT: Record[Treatment] = Record(
    "Drifting cameras, adjusted with the monitor's readings or without.",
    Quantity("all_fields", lambda one: one.together, "all fields adjusted at once", record=ERRORS),
    Quantity("p_value", lambda one: one.p_value, "chance of a chi-square as large in that adjustment"),
    Quantity("schemes", lambda one: one.schemes, "without ground control, by scheme", record=ERRORS),
)
CAMERA_DRIFT: Record[tuple[Monitoring, DriftSize]] = Record(
    "One size of the cameras' drift from field to field.",
    Quantity("factor", lambda d: d[1].factor, "size against that of the file"),
    Quantity("d_alpha_rad_sigma", lambda d: d[1].factor * d[0].angle, "standard deviation of Δα of an outer line"),
    Quantity("without_monitor", lambda d: d[1].without, "as if no camera drifted", record=TREATMENT),
    Quantity("with_monitor", lambda d: d[1].monitored, "with the monitor's readings", record=TREATMENT),
)
MONITORING: Record[Monitoring] = Record(
    "Cameras that drift from field to field, with and without the on-board monitor.",
    Quantity("d_alpha_rad_sigma", lambda found: found.angle, "standard deviation of Δα of an outer line in the file"),
    Quantity("height_for_1_arcsec_m", lambda found: found.metres, "height change for 1 arcsec of Δα of the first line"),
    Quantity("noise_counts_as", lambda found: "independent", "how the noise of orbit and attitude enters"),
    Quantity("sizes", lambda found: [(found, size) for size in found.sizes], record=CAMERA_DRIFT),
)
TIES: Record[tuple[Mapping[str, CheckErrors], Mapping[str, CheckErrors]]] = Record(
    "A scheme without tie points and with them, over the check points of all fields.",
    Quantity("without_ties", lambda e: FieldErrors.pooled(e[0].values()), record=ERRORS),
    Quantity("with_ties", lambda e: FieldErrors.pooled(e[1].values()), record=ERRORS),
)
DATUM_SIGMA: Record[Datum] = Record(
    "How well a turn of the whole pass is known.",
    Quantity("sigma_before", lambda d: d.before, "standard deviation from the readings alone"),
    Quantity("sigma_after", lambda d: d.after, "standard deviation with the tie points"),
    Quantity("unit", lambda d: "rad/s" if "rate" in d.name else "rad", "of both"),
)


def _strips(run: CalibrationRun) -> Strips:
    assert run.strips is not None
    return run.strips


STRIPS: Record[CalibrationRun] = Record(
    "Passes adjusted on tie points.",
    Quantity("ties", lambda run: _strips(run).ties, "tie points that two lines or more see, by field"),
    Quantity("p_value", lambda run: _strips(run).p_values, "chance of a chi-square as large, by field"),
    Quantity(
        "schemes", lambda run: {k: (run.schemes[k], tied) for k, tied in _strips(run).schemes.items()}, record=TIES
    ),
    Quantity("datum", lambda run: {d.name: d for d in _strips(run).datum}, record=DATUM_SIGMA),
)
MAP_LIMITS: Record[CalibrationRun] = Record(
    "Which schemes meet the limits of a map in every field.",
    Quantity("scale", lambda run: "1:50000", "of the map"),
    Quantity("plan_limit_m", lambda run: run.setup.test.limits.plan, "largest RMS error in plan"),
    Quantity("height_limit_m", lambda run: run.setup.test.limits.height, "largest RMS error in height"),
    Quantity("source", lambda run: "of the file", "of the limits"),
    Quantity("before", lambda run: meets(run.before, run.setup.test.limits), "whether the laboratory's camera does"),
    Quantity("schemes", lambda run: {k: meets(e, run.setup.test.limits) for k, e in run.schemes.items()}),
)

# --- points measured in images ---------------------------------------------------------------------------


_SCREENED = {
    "entered": "image points of control and tie points that enter the adjustment",
    "left": "image points that the adjustment keeps",
    "wrong_entered": "wrong places among those that enter",
    "wrong_left": "wrong places among those that are kept",
    "check_entered": "check points before the test of their intersection",
    "check_left": "check points after the test of their intersection",
    "wrong_check_left": "kept check points with a wrong place in a line",
}


def _sums(meanings: Mapping[str, str], parts: Callable[[Any], Any] = lambda parts: parts) -> list[Quantity[Any]]:
    """Counts that are sums over line images or fields.

    Parameters
    ----------
    meanings : Mapping[str, str]
        Attribute of a part, which is the key, too -> what it counts.
    parts : Callable[[Any], Any]
        Of a source; the source itself if not given.
    """

    def total(name: str) -> Callable[[Any], int]:
        return lambda source: sum(getattr(one, name) for one in parts(source))

    return [Quantity(name, total(name), said) for name, said in meanings.items()]


SCREENED: Record[Screening] = Record("Image points of a field in the adjustment.", *_sums(_SCREENED, lambda one: [one]))


def _degrees(parts: Sequence[LineJudgement]) -> Array:
    return np.array([j.degrees_of_freedom for j in parts], float)


def _rms(parts: Sequence[LineJudgement]) -> Array:
    """(2,) along the track and along the line, over the places of all parts."""
    degrees = _degrees(parts)
    square = np.sum([np.nan_to_num(j.rms) ** 2 * n for j, n in zip(parts, degrees, strict=True)], axis=0)
    return np.asarray(np.sqrt(square / max(degrees.sum(), 1.0)))


MATCHING: Record[Sequence[LineJudgement]] = Record(
    "Points of one sort in the images of one line, over the patches of a field.",
    *_sums(MATCH_COUNTS),
    Quantity("rms_lines_px", lambda parts: _rms(parts)[0], "RMS error along track of right places", "RMS track"),
    Quantity("rms_pixels_px", lambda parts: _rms(parts)[1], "RMS error along line of right places", "RMS line"),
    Quantity(
        "chi_square_ratio",
        lambda parts: sum(j.chi_square for j in parts) / max(_degrees(parts).sum(), 1.0),
        "chi-square of the errors of these places over its degrees of freedom",
        "χ²/dof",
    ),
)


def _by_line(one: FieldImages) -> dict[str, dict[str, list[LineJudgement]]]:
    """Sort of points -> line -> judgements of the patches."""
    parts: dict[str, dict[str, list[LineJudgement]]] = {}
    for patch in one.patches:
        for sort, lines in patch.judgements.items():
            for line, judgement in lines.items():
                parts.setdefault(sort, {}).setdefault(line, []).append(judgement)
    return parts


def _judgements(campaign: Campaign) -> list[LineJudgement]:
    every = [lines for one in campaign.images or () for lines in _by_line(one).values()]
    return [judgement for lines in every for parts in lines.values() for judgement in parts]


def _screenings(campaign: Campaign) -> list[Screening]:
    return [one.screening for one in campaign.images or () if one.screening is not None]


TOTAL: Record[Campaign] = Record(
    "Points in images, over all fields and lines; what is wrong is known from the truth.",
    *_sums(MATCH_COUNTS, _judgements),
    *_sums(_SCREENED, _screenings),
    Quantity(
        "right_rejected_by_adjustment",
        lambda campaign: sum(s.right_lost for s in _screenings(campaign)),
        "right places that the adjustment left out",
    ),
)
IMAGES: Record[Campaign] = Record(
    "Points measured in rendered images.",
    Quantity("total", lambda campaign: campaign, record=TOTAL),
    Quantity(
        "fields",
        lambda campaign: {one.name: _by_line(one) for one in campaign.images or ()},
        "by sort of points and line",
        record=MATCHING,
    ),
)

# --- parameters and fields -------------------------------------------------------------------------------

UNKNOWN: Record[Unknown] = Record(
    "An unknown of the adjustment of all fields.",
    Quantity("value", lambda one: one.value, "estimated"),
    Quantity("sigma", lambda one: one.sigma, "standard deviation with the gauge's held unknowns exact"),
    Quantity(
        "sigma_with_gauge", lambda one: one.sigma_with_gauge, "with what launch leaves to expect of the held unknowns"
    ),
    Quantity(
        "share_from_launch",
        lambda one: one.from_start,
        "share of its variance that comes from the sigmas of launch and season and not from the points, 0 to 1",
    ),
    Quantity("held", lambda one: one.held, "whether the gauge holds it"),
    Quantity("truth", lambda one: one.truth, "true value, where a simulation knows it"),
    Quantity("unit", lambda one: one.unit, "of value, sigmas and truth"),
)


def _conditions(run: CalibrationRun) -> str:
    names = run.together.names
    rates = any(name in RATE for name in names)
    own = any(name.endswith(RATE) for name in names) and not rates
    return (
        "with the gauge's held unknowns exact"
        + ", and with the drift of the biases during the passes as the latitude fit tells it" * rates
        + ", and with a drift of the attitude in each pass as it is stated or was found" * own
    )


SIGMAS: Record[CalibrationRun] = Record(
    "What the sigmas hold.",
    Quantity("sigma", _conditions),
    Quantity(
        "sigma_with_gauge",
        lambda run: "with what launch leaves to expect of the held unknowns, and all that follows them",
    ),
    Quantity("held_start_m_sigma", lambda run: run.setup.test.launch.interior, "of held unknowns after a launch"),
    Quantity("fields", lambda run: "of each field by itself: without the drift of the biases during the pass"),
)


def _free(found: Adjustment) -> list[int]:
    """Numbers of the unknowns that are not held."""
    sigma = found.sigma
    return [k for k, name in enumerate(found.names) if sigma[name] > 0.0]


CORRELATIONS: Record[Adjustment] = Record(
    "Correlations of the unknowns that are not held.",
    Quantity("names", lambda found: [found.names[k] for k in _free(found)], "of rows and columns"),
    Quantity("matrix", lambda found: np.round(found.correlation[np.ix_(_free(found), _free(found))], 6)),
)
COMBINATION: Record[Combination] = Record(
    "A change of unknowns together that the measurements do not see, or hardly.",
    Quantity(
        "change",
        lambda one: dict(zip(one.names, one.change, strict=True)),
        "of each unknown, for an image motion of any one of them of at most 1 mm",
    ),
    Quantity("strength", lambda one: one.strength, "how much less well it is known than its unknowns alone would be"),
    Quantity("sigma_m", lambda one: one.sigma, "what one sigma of the data allows it, as motion in the image"),
)
ATTITUDE_DRIFT: Record[AttitudeDrift] = Record(
    "Drift of the attitude within the passes.",
    Quantity("seconds", lambda d: d.seconds, "from when the first line sees a field to when the last one does"),
    Quantity(
        "sigmas_per_arcsec",
        lambda d: d.sigmas_per_arcsec,
        "change of each unknown in its sigmas for a drift of 1 arcsec in these seconds that is no unknown",
        converted=False,
    ),
    Quantity("seen_arcsec", lambda d: d.seen, "drift about body X, Y, Z that residuals show in half of all cases"),
    Quantity("unseen_sigmas", lambda d: d.unseen_sigmas, "sigmas by which the most sensitive unknown is then wrong"),
    Quantity("rate_p_value", lambda d: d.rate_p_value, "chance of the residuals without rates of the attitude"),
    Quantity("course_p_value", lambda d: d.course_p_value, "chance of the residuals without slow errors of the lines"),
    Quantity("false_alarm", lambda d: FALSE_ALARM, "of either test"),
    Quantity("assumed_rate_rad_s", lambda d: d.assumed and d.assumed.rate, "sigma of the rates that are assumed since"),
    Quantity("assumed_walk_rad", lambda d: d.assumed and d.assumed.walk, "likewise of a random walk, in one second"),
)
UNLIKELY = 1e-3
"""Chance of a chi-square as large below which the adjustment does not fit."""


def _fits(run: CalibrationRun) -> bool | None:
    return run.together.p_value >= UNLIKELY if run.campaign.spec.errors.switched_on else None


def _misfit(run: CalibrationRun) -> str:
    drifts = run.truth is not None and bool(run.campaign.simulated.drift)
    return (
        f"the adjustment does not fit: a chi-square as large has a chance of {run.together.p_value:.1g}; biases may "
        f"drift during a pass{', and the cameras drift from field to field' * drifts}"
    )


FIT: Record[CalibrationRun] = Record(
    "How the adjustment of all fields fits.",
    Quantity("chi_square", lambda run: run.together.chi_square, "of the residuals"),
    Quantity("degrees_of_freedom", lambda run: run.together.degrees_of_freedom, "of chi-square"),
    Quantity("p_value", lambda run: run.together.p_value, "chance of a chi-square as large"),
    Quantity("agrees", _fits, "whether residuals are as their sigmas say; null of exact points", warning=_misfit),
    Quantity("iterations", lambda run: run.together.iterations, "steps of the adjustment"),
    Quantity("attitude_drift", lambda run: run.drift, record=ATTITUDE_DRIFT),
)
CHIP_STEP: Record[ChipStep] = Record(
    "A step of x (along the track) or y within a line, at a joint between chips.",
    Quantity("line", lambda step: step.line, "camera"),
    Quantity("axis", lambda step: step.axis, "x or y"),
    Quantity("place_m", lambda step: step.place, "y of the joint in the focal plane", shown="mm"),
    Quantity("step_m", lambda step: step.step, "what the residuals say of it", shown="um"),
    Quantity("sigma_m", lambda step: step.sigma, "its standard deviation, all steps together", shown="um"),
    Quantity("seen_from_m", lambda step: step.seen_from, "step that is told in half of all cases", shown="um"),
    Quantity("found", lambda step: step.found, "whether this one is told, false alarm 1e-4 for all together"),
)
STEPWISE: Record[CalibrationRun] = Record(
    "One field by turns of interior orientation and biases.",
    Quantity("field", lambda run: run.setup.test.schemes[0][0], "its name"),
    Quantity("rounds", lambda run: run.stepwise.rounds, "until the steps are small"),
    Quantity("rate", lambda run: run.stepwise.rate, "what a round leaves of the slowest error"),
    Quantity(
        "converged",
        lambda run: run.stepwise.converged,
        "whether the steps become small",
        warning=lambda run: f"the stepwise solution has not settled after {run.stepwise.rounds} rounds",
    ),
)
BIAS_OF_FIELD: Record[tuple[float, float, float | None]] = Record(
    "A bias of a field by itself.",
    Quantity("value", lambda bias: bias[0], "estimated"),
    Quantity("sigma", lambda bias: bias[1], "standard deviation"),
    Quantity("truth", lambda bias: bias[2], "true value, where a simulation knows it"),
    Quantity("unit", lambda bias: "rad", "of all of them"),
)
INTERIOR_OF_FIELD: Record[tuple[float, float]] = Record(
    "A parameter of the interior orientation by one field.",
    Quantity("value", lambda found: found[0], "estimated"),
    Quantity("sigma", lambda found: found[1], "standard deviation"),
    Quantity("unit", lambda found: "m", "of both"),
)


def _biases(one: tuple[FieldPass, FieldResult]) -> dict[str, tuple[float, float, float | None]]:
    here, found = one[0], one[1].adjustment
    truth = [None] * len(BIAS) if here.known_truth is None else here.bias.tolist()
    sigma = found.sigma
    return {
        name: (float(value), sigma[f"{here.name} {name}"], true)
        for name, value, true in zip(BIAS, found.bias(here.name), truth, strict=True)
    }


def _interior(one: tuple[FieldPass, FieldResult]) -> dict[str, tuple[float, float]]:
    found = one[1].adjustment
    sigma, inner = found.sigma, interior_names(tuple(found.cameras))
    return {name: (found.value(name), sigma[name]) for name in found.names if name in inner}


FIELD: Record[tuple[FieldPass, FieldResult]] = Record(
    "A field calibrated by itself.",
    Quantity("latitude_rad", lambda one: one[0].latitude, "mean of the control points"),
    Quantity("bias", _biases, record=BIAS_OF_FIELD),
    Quantity("interior", _interior, record=INTERIOR_OF_FIELD),
    Quantity("p_value", lambda one: one[1].adjustment.p_value, "chance of a chi-square as large"),
    Quantity("orbit_third_difference_rms_m", lambda f: f[1].orbit and f[1].orbit.rms, "of positions, x, y, z"),
    Quantity("attitude_third_difference_rms_rad", lambda f: f[1].attitude and f[1].attitude.rms, "roll, pitch, yaw"),
)
MEASURED: Record[tuple[Campaign, FieldPass, Adjustment]] = Record(
    "A measured pass: its points, what screening left out, ground sample distance.",
    Quantity("control_points", lambda m: int(m[1].is_control.sum()), "that calibrate"),
    Quantity("tie_points", lambda m: m[1].tie_count, "that calibrate or tie the strip"),
    Quantity("check_points", lambda m: len(m[1].check_ground), "that test"),
    Quantity(
        "image_points", lambda m: {name: len(row.point) for name, row in m[1].measurements.images.items()}, "by line"
    ),
    Quantity(
        "gsd_m",
        lambda m: {name: ground_sample(m[1], name) for name in m[1].data.sensors},
        "ground sample distance along and across the track, by line camera",
    ),
    Quantity("rejected", lambda m: _rejected(m, "points", []), "points with a rejected image point, and its line"),
    Quantity("rejected_check_points", lambda m: _rejected(m, "check_points", []), "whose rays do not meet"),
    Quantity("sigma_factor", lambda m: _rejected(m, "factors"), "by line, on the sigmas of its image points"),
    Quantity("check_chi_square", lambda m: meeting_of(*m).chi_square, "of the rays of the check points"),
    Quantity("check_degrees_of_freedom", lambda m: meeting_of(*m).degrees_of_freedom, "of this chi-square"),
)


def _rejected(measured: tuple[Campaign, FieldPass, Adjustment], what: str, none: Any = None) -> Any:
    campaign, one, _ = measured
    gone = campaign.rejected.get(one.name)
    return none if gone is None else getattr(gone, what)


LATITUDE: Record[LatitudeFit] = Record(
    "Amplitude x sin(latitude - reference) + constant, of one axis of the biases.",
    Quantity("amplitude_rad", lambda fit: fit.amplitude, "of the drift with latitude", shown="arcsec"),
    Quantity("amplitude_rad_sigma", lambda fit: fit.amplitude_sigma, "with what remains", "σ", shown="arcsec"),
    Quantity("constant_rad", lambda fit: fit.constant, "bias at the reference", shown="arcsec"),
    Quantity("constant_rad_sigma", lambda fit: fit.constant_sigma, "with what remains", "σ", shown="arcsec"),
    Quantity("reference_rad", lambda fit: fit.reference, "latitude in the middle of the fields"),
    Quantity("remainder_rad", lambda fit: fit.remainder, "what remains, 1 sigma: the season", shown="arcsec"),
    Quantity("chi_square", lambda fit: fit.chi_square, "by the biases' own covariance"),
    Quantity("degrees_of_freedom", lambda fit: fit.degrees_of_freedom, "of this chi-square"),
    Quantity("p_value", lambda fit: fit.p_value, "chance of a chi-square as large if latitude is all that matters"),
)
REPEATABILITY: Record[Repeatability] = Record(
    "Scatter of a parameter from field to field.",
    Quantity("name", lambda one: one.name, "of the parameter"),
    Quantity("unit", lambda one: unit(one.name), "of scatter and sigma"),
    Quantity("scatter", lambda one: one.scatter, "standard deviation over the fields"),
    Quantity("sigma", lambda one: one.sigma, "that the adjustments of single fields claim, root mean square"),
    Quantity("p_value", lambda one: one.p_value, "chance of such a scatter if the parameter is the same in all fields"),
)

# --- errors that the fit hardly shows --------------------------------------------------------------------

CHANGE: Record[tuple[str, float]] = Record(
    "Change of a parameter.",
    Quantity("value", lambda change: change[1], "the change"),
    Quantity("unit", lambda change: unit(change[0]), "its unit"),
)
LIGHT: Record[LightRow] = Record(
    "Effects on the light that are left in the image points, and what they do.",
    Quantity("left_in", lambda row: row.left, "the effects"),
    Quantity("moved_rms_m", lambda row: row.moved, "RMS of how far they move image points, x and y, by line camera"),
    Quantity("before", lambda row: row.before, "with the laboratory's camera, mean of the fields", record=ERRORS),
    Quantity("after", lambda row: row.after, "with each field's own parameters, mean of the fields", record=ERRORS),
    Quantity("parameter_change", lambda row: {n: (n, v) for n, v in row.shift.items()}, record=CHANGE),
    Quantity(
        "parameter_change_sigmas",
        lambda row: {n: v / row.sigma[n] for n, v in row.shift.items() if row.sigma[n] > 0.0},
        "changes in sigmas of the parameter",
    ),
    Quantity("p_value", lambda row: row.p_value, "chance of a chi-square as large"),
)
DATUM: Record[DatumRow] = Record(
    "What a datum does that is off by a shift, or a clock of the lines that is late.",
    Quantity("shift_east_north_up_m", lambda row: row.shift, "of all control points"),
    Quantity("late_s", lambda row: row.late, "by how much the clock is late"),
    Quantity("bias_change_rad", lambda row: dict(zip(BIAS, row.bias, strict=True)), "mean over the fields"),
    Quantity("interior_change_m", lambda row: row.interior, "by element of the interior orientation"),
    Quantity("offset_change_m", lambda row: dict(zip(OFFSET, row.offset, strict=True)), "mean over the fields"),
    Quantity("most", lambda row: row.most_sigmas[0], "the element that moves by the most of its sigmas"),
    Quantity("most_sigmas", lambda row: row.most_sigmas[1], "by how many"),
    Quantity(
        "one_sigma_at",
        lambda row: row.size / row.most_sigmas[1] if row.most_sigmas[1] else None,
        "shift or delay that moves it by one sigma, metres or seconds",
    ),
    Quantity("warned_from", lambda row: row.warned, "shift or delay from which on there is a warning; null for never"),
    Quantity("chi_square_change", lambda row: row.fit, "of the adjustment"),
    Quantity("p_value", lambda row: row.p_value, "chance of a chi-square as large"),
    Quantity("after", lambda row: row.after, "with each field's own parameters, mean of the fields", record=ERRORS),
)
SURPRISE: Record[Surprise] = Record(
    "An estimate beyond what launch and orbit leave to expect.",
    Quantity("name", lambda one: one.name, "of the unknown"),
    Quantity("change", lambda one: one.change, "from the value that is expected"),
    Quantity("expected_sigma", lambda one: one.expected, "standard deviation that is expected"),
    Quantity("ratio", lambda one: one.ratio, "of both"),
    Quantity("unit", lambda one: unit(one.name), "of change and sigma"),
)

# --- the file --------------------------------------------------------------------------------------------


def _measured(run: CalibrationRun) -> dict[str, tuple[Campaign, FieldPass, Adjustment]] | None:
    if run.truth is not None:
        return None
    return {p.name: (run.campaign, p, run.fields[p.name].adjustment) for p in run.campaign.passes}


def _scheme_fields(run: CalibrationRun) -> dict[str, Sequence[str] | str]:
    return dict(zip(run.schemes, (*run.setup.test.schemes, "each its own"), strict=True))


CALIBRATION: Record[CalibrationRun] = Record(
    "calibration.json. Metres and radians; what is not defined is null.",
    Quantity("seed", lambda run: run.seed, "of all random numbers"),
    Quantity("parameters", unknowns, "of the adjustment of all fields", record=UNKNOWN),
    Quantity("sigmas", lambda run: run, record=SIGMAS),
    Quantity("correlations", lambda run: run.together, record=CORRELATIONS),
    Quantity("null_vectors", lambda run: run.together.open, "what the points cannot tell", record=COMBINATION),
    Quantity("weak_vectors", lambda run: run.together.weak, "what the points tell badly", record=COMBINATION),
    Quantity("gauge", lambda run: str(run.together.gauge), "what is held"),
    Quantity("images", lambda run: None if run.campaign.images is None else run.campaign, record=IMAGES),
    Quantity("measured", _measured, "by pass, of a calibration on measurements", record=MEASURED),
    Quantity("fit", lambda run: run, record=FIT),
    Quantity("chip_steps", lambda run: run.chip_steps, record=CHIP_STEP),
    Quantity("stepwise", lambda run: run, record=STEPWISE),
    Quantity("fields", lambda run: {p.name: (p, run.fields[p.name]) for p in run.campaign.passes}, record=FIELD),
    Quantity("schemes", lambda run: run.schemes, "by scheme and field, without ground control", record=ERRORS),
    Quantity("scheme_fields", _scheme_fields, "whose parameters each scheme averages"),
    Quantity("before", lambda run: run.before, "with the laboratory's camera, by field", record=ERRORS),
    Quantity("finding", lambda run: run.scheme_means, record=MEANS),
    Quantity("bias_latitude", lambda run: {fit.axis: fit for fit in run.latitude}, record=LATITUDE),
    Quantity("repeatability", lambda run: run.repeatability, record=REPEATABILITY),
    Quantity("light", lambda run: run.light, record=LIGHT),
    Quantity("light_corrected", lambda run: bool(run.setup.test.effects.corrected), "whether effects are taken out"),
    Quantity("datum", lambda run: run.datum, record=DATUM),
    Quantity("surprises", lambda run: run.surprises, "the largest first", record=SURPRISE),
    Quantity("campaigns", lambda run: None if run.repeats is None else run, record=CAMPAIGNS),
    Quantity("monitoring", lambda run: run.monitoring, record=MONITORING),
    Quantity("strips", lambda run: None if run.strips is None else run, record=STRIPS),
    Quantity("map_limits", lambda run: run, record=MAP_LIMITS),
)
