"""Sections of the report of an in-orbit calibration: schemes, parameters, fields, biases, influences and observability.

docs/orbit.md explains how averaging, drifting cameras, tie points and effects on the light change the result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple
from typing import Any

import numpy as np

from analysis.arrays import ARCSEC
from analysis.calibration.adjustment import Adjustment
from analysis.orbit.calibration_parameters import OFFSET, RATE
from analysis.orbit.three_line_model import BIAS
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.framework.artefact import Cell, DecimalNumber, PngFigure, SvgFigure, Table
from twin.framework.report import Section
from twin.orbit.calibration.calibration_numbers import CHIP_STEP, LATITUDE, MATCHING, SCREENED
from twin.orbit.calibration.calibration_plots import figure_svg
from twin.orbit.calibration.calibration_run import STEPWISE_TOLERANCE, CalibrationRun
from twin.orbit.calibration.campaign_adjustment import ground_sample, intersection_fit
from twin.orbit.calibration.influences import UNEXPECTED_SIGMAS, LightRow
from twin.orbit.calibration.schemes import RMS, FieldErrors, SchemeMeans, meets, values_of
from twin.orbit.images.image_points import UNMODELLED_SIGMA
from twin.orbit.images.patch import WRONG
from twin.orbit.images.simulate_report import SORTS, points_png

_SCALES = {"rad": (ARCSEC, "arcsec"), "rad/s": (1e-3 * ARCSEC, "mas/s"), "m": (1.0, "m")}
"""Unit of an unknown in result files -> unit of the tables of the report, as its size in SI units and its name."""
MOSTLY = 0.5
"""Share of an unknown's variance above which it counts as determined by the prior (change at launch), not the points.
"""
Rows = list[tuple[Cell, ...]]


def sections(run: CalibrationRun, data: Mapping[str, Any]) -> tuple[Section, ...]:
    """Return the sections of a calibration's report.

    Parameters
    ----------
    run : CalibrationRun
        Results of the calibration.
    data : Mapping[str, Any]
        Content of calibration.json.
    """
    candidates = (
        _schemes(run),
        None if run.repeats is None else _repeats(run),
        _measured(run) if run.truth is None else None,
        None if run.campaign.images is None else _images(run, data["images"]),
        None if run.monitoring is None else _monitoring(run),
        None if run.strips is None else _strips(run),
        _parameters(run, data),
        _fields(run),
        _biases(run, data),
        _light(run),
        _datum(run),
        _rank(run),
        _data(run),
    )
    return tuple(section for section in candidates if section is not None)


def _figure(run: CalibrationRun, name: str, title: str, caption: str) -> SvgFigure:
    return SvgFigure(name, title, caption, figure_svg(name, run))


def scheme_names(run: CalibrationRun) -> list[str]:
    """Return the names of the schemes, each a list of fields whose parameters are averaged; the last averages none."""
    names = [f"{k + 1}: {', '.join(s)}" for k, s in enumerate(run.campaign.spec.schemes)]
    return [*names, f"{len(names) + 1}: each field its own"]


def summary(run: CalibrationRun) -> Table:
    """Return the table of the schemes' errors at the check points of all fields."""
    rows: Rows = []
    for name, errors in zip(["laboratory", *scheme_names(run)], (run.before, *run.schemes.values()), strict=True):
        values = [values_of(errors, what) for what in RMS]
        numbers = [float(v) for rms in values for v in (rms.mean(), rms.std(), rms.max())]
        rows.append((name, *numbers, "yes" if meets(errors, run.campaign.spec.limits) else "no"))
    return Table(
        "schemes",
        "Schemes of parameters, tested on all fields without ground control",
        "RMS at check points, metres: mean, standard deviation and largest of the fields.",
        ("parameters", "plan [m]", "spread", "largest", "height [m]", "spread", "largest", "meets 1:50 000"),
        rows,
        (None, 2, 2, 2, 2, 2, 2, None),
    )


def scheme_summary(means: SchemeMeans | None) -> str:
    """Return a sentence on how averaging the parameters of several fields changes the errors in plan and height."""
    if means is None:
        return "There is only one scheme of averaged parameters, so schemes are not compared."
    plan, spread, height = means.plan, means.plan_spread, means.height
    return (
        f"From the first to the last scheme of averaged parameters, the mean RMS in plan changes from {plan[0]:.2f} m "
        f"to {plan[-1]:.2f} m and its spread over the fields from {spread[0]:.2f} m to {spread[-1]:.2f} m; the mean "
        f"RMS in height changes from {height[0]:.2f} m to {height[-1]:.2f} m, by "
        f"{100.0 * means.height_change:.1f}% at most between any two schemes."
    )


def _schemes(run: CalibrationRun) -> Section:
    columns = {"laboratory": run.before} | {f"scheme {name}": errors for name, errors in run.schemes.items()}
    tables = [
        Table(
            what.removesuffix("_rms"),
            f"RMS in {what.removesuffix('_rms')} at check points without ground control, metres",
            "",
            ("field", *columns),
            [(name, *(getattr(errors[name], what) for errors in columns.values())) for name in run.before],
            (None, *(2,) * len(columns)),
        )
        for what in RMS
    ]
    text = (
        f"Every field is calibrated by itself (three attitude biases and {len(run.campaign.inner)} elements of the "
        f"interior orientation, of which two are held). Each scheme uses the mean of the parameters of its "
        f"fields: {'; '.join(scheme_names(run))}.",
        scheme_summary(run.scheme_means),
    )
    check = "Arrows: errors in plan; colours: errors in height. Before calibration and with the field's own parameters."
    title = f"Errors at check points of {run.campaign.passes[0].name}"
    figures = (
        _figure(run, "schemes-of-fields", "Schemes", "RMS errors at check points; each line is a field."),
        _figure(run, "check-points", title, check),
    )
    return Section("Schemes of averaged parameters", text, (figures[0], *tables, figures[1]))


def _repeats(run: CalibrationRun) -> Section:
    assert run.repeats is not None
    limits, count = run.campaign.spec.limits, len(run.repeats.plan)
    met = run.repeats.met(limits.plan, limits.height)
    rows: Rows = []
    for k, name in enumerate(scheme_names(run)):
        cells: list[Cell] = [name]
        for values in (run.repeats.plan[:, k], run.repeats.height[:, k]):
            mean = values.mean(axis=1)
            cells += [float(mean.mean()), float(mean.std(ddof=1)) if count > 1 else None]
            cells += [float(values.std(axis=1).mean())]
        rows.append((*cells, f"{100.0 * met[k]:.0f}%"))
    heads = [head for what in ("plan", "height") for head in (f"{what} [m]", "± campaign", "spread of fields")]
    table = Table(
        "campaigns",
        f"{count} campaigns over the same fields",
        "RMS at check points, metres: mean of the fields, averaged over the campaigns, with its standard deviation "
        "from campaign to campaign; spread over the fields; share of campaigns in which every field meets 1:50 000. "
        "Biases, orbits, points and noise are drawn anew; the camera, the fields and the drift with latitude are the "
        "same.",
        ("parameters", *heads, "1:50 000"),
        rows,
        (None, 2, 2, 2, 2, 2, 2, None),
    )
    return Section("Other campaigns", (), (table,))


def _measured(run: CalibrationRun) -> Section:
    campaign = run.campaign
    rows: Rows = []
    sizes: Rows = []
    for flight in campaign.passes:
        rejected, alone = campaign.rejected.get(flight.name), run.fields[flight.name].adjustment
        fit, errors = intersection_fit(campaign, flight, alone), list(run.schemes.values())[-1][flight.name]
        factors = {} if rejected is None else {line: f"{factor:.2f}" for line, factor in rejected.factors.items()}
        alike = len(set(factors.values())) == 1
        factor = factors.popitem()[1] if alike else ", ".join(f"{line} {v}" for line, v in factors.items())
        lost = (None, None, None) if rejected is None else (len(rejected.points), len(rejected.check_points), factor)
        points = (int(flight.is_control.sum()), flight.tie_count, len(flight.check_ground))
        ratio, check = (v.chi_square / max(v.degrees_of_freedom, 1) for v in (alone, fit))
        rows.append((flight.name, *points, *lost, ratio, alone.p_value, check))
        for line in flight.data.sensors:
            along, across = ground_sample(flight, line)
            pixel = float(np.sqrt(along * across))
            both = errors.plan_rms / pixel, errors.height_rms / pixel
            sizes.append((flight.name, line, along, across, *both, errors.count))
    heads = ("image points rejected", "check rejected", "factor", "χ²/dof", "p", "check χ²/dof")
    tables = (
        Table(
            "measured-points",
            "Points of every pass",
            "Rejected: image points by robust weights, and check points whose rays do not intersect. Factor: applied "
            "to the given sigmas of image points by line, from the remaining residuals. Chi-square over its degrees of "
            "freedom: of the pass adjusted by itself, and of the rays of its check points with these parameters.",
            ("pass", "control", "ties", "check", *heads),
            rows,
            (None, None, None, None, None, None, None, 2, 3, 2),
        ),
        Table(
            "measured-pixels",
            "Ground sample distance, and errors of check points in ground pixels",
            "Ground sample distance of the middle of each line, metres; RMS errors of the check points with the pass's "
            "own parameters, in ground pixels (geometric mean of along and across).",
            ("pass", "line", "along the track [m]", "across [m]", "plan [px]", "height [px]", "check points"),
            sizes,
            (None, None, 3, 3, 2, 2, None),
        ),
    )
    none = () if campaign.rejected else ("No image point was rejected: the file has `screening: none`.",)
    return Section("Measurements", (*none, _limits(run)), tables)


def _limits(run: CalibrationRun) -> str:
    noise, flight = run.campaign.noise, run.campaign.passes[0]
    ground = flight.altitude / float(np.mean([m.interior[0] for m in run.campaign.laboratory.values()]))
    control = np.trace(flight.control_covariance[flight.is_control], axis1=1, axis2=2)
    # white noise of the readings by their spline, in metres on the ground, beside that of the image
    parts = {
        "image points": noise.image * ground,
        "readings of the attitude": noise.attitude * flight.altitude,
        "slow errors of the attitude": noise.slow_attitude * flight.altitude,
        "readings of the orbit": noise.station,
        "control points": float(np.sqrt(np.mean(control / 3.0))),
    }
    texts = ", ".join(f"{name} {value:.2g} m" for name, value in sorted(parts.items(), key=lambda v: -v[1]) if value)
    return (
        f"Error budget on the ground at nadir (1σ) of a single ray to a single point of {flight.name}: {texts}. "
        "The largest of these errors limits the accuracy. More points reduce all of them but slow errors of the"
        " attitude."
    )


def _images(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    campaign, total, spec = run.campaign, data["total"], run.campaign.simulated.images
    assert campaign.images is not None
    assert spec is not None
    screened = SCREENED.table(
        "image-points",
        "Image points in the adjustment",
        "Points that every line sees, before and after screening by robust weights (IGG) and, for check points, by the "
        "intersection of their rays.",
        {images.name: SCREENED(images.screening) for images in campaign.images if images.screening is not None},
        label="field",
    )
    judgements = {
        f"{field}, {SORTS[sort]}, {line}": numbers
        for field, sorts in data["fields"].items()
        for sort, lines in sorts.items()
        for line, numbers in lines.items()
    }
    caption = (
        f"Wrong: {WRONG}; before any test, after the thresholds of matching, after consensus with the neighbours. RMS "
        "and chi-square of correct positions."
    )
    counts = ("wrong_found", "found", "wrong_matched", "matched", "wrong_accepted", "accepted")
    keys = (*counts, "right_rejected_by_consensus", "rms_lines_px", "rms_pixels_px", "chi_square_ratio")
    matching = MATCHING.table("image-matching", "Matching", caption, judgements, keys, "field, points, line", digits=4)
    remaining = " and ".join(str(int(p.control.control.sum())) for p in campaign.passes)
    text = (
        f"In each field {len(spec.patches)} patches of {spec.lines} x {spec.pixels} pixels are rendered by every line. "
        f"Of {total['found']} matched positions, {total['wrong_found']} are wrong "
        f"({100.0 * total['wrong_found'] / total['found']:.1f}%), mostly on parcels that look different in the "
        f"orthophoto. After the thresholds of matching {total['wrong_matched']} of {total['matched']} are wrong, after "
        f"the test of the neighbours {total['wrong_accepted']} of {total['accepted']}, after the adjustment "
        f"{total['wrong_left']} of {total['left']} image points and {total['wrong_check_left']} of "
        f"{total['check_left']} check points. The test of the neighbours rejects "
        f"{total['right_rejected_by_consensus']} correct positions, the adjustment "
        f"{total['right_rejected_by_adjustment']}. {remaining} control points remain. Their image points are weighted "
        f"by the covariances of the matching, with {UNMODELLED_SIGMA:g} px added for errors that the fit does not "
        "show.",
    )
    first = campaign.images[0]
    figures = [
        PngFigure(
            f"points-{sort}",
            f"Predicted to matched positions, {SORTS[sort]} points, first patch of {first.name}",
            "Arrows: displacement less its median, enlarged as the title says; crosses: rejected by the test of the "
            "neighbours; points: not matched.",
            points_png(first.shown, points),
        )
        for sort, points in first.patches[0].points.sorts.items()
    ]
    return Section("Points in images", text, (matching, screened, *figures))


def monitor_gain(run: CalibrationRun) -> str:
    """Return a sentence on the height error with and without the on-board monitor."""
    assert run.monitoring is not None
    none, nominal = run.monitoring.at(0.0), run.monitoring.at(1.0)
    scheme = list(none.without.schemes)[-2]
    still, blind = none.without.schemes[scheme].height_rms, nominal.without.schemes[scheme].height_rms
    text = (
        f"With cameras that drift by {run.monitoring.angle / ARCSEC:.2g} arcsec (Δα, 1σ) from field to field, the "
        f"height error without ground control (scheme {scheme}) is {blind:.2f} m RMS, against {still:.2f} m without "
        "drift"
    )
    if nominal.monitored is None:
        return f"{text}."
    return f"{text}; with the on-board monitor's readings, {nominal.monitored.schemes[scheme].height_rms:.2f} m."


def _monitoring(run: CalibrationRun) -> Section:
    study, spec = run.monitoring, run.campaign.simulated
    assert study is not None
    drifts = "; ".join(
        f"{name} {', '.join(format_quantity(v, ANGLE) for v in drift.angles)}, "
        f"Δf {format_quantity(drift.principal_distance, LENGTH)}"
        for name, drift in spec.drift.items()
    )
    text = [
        f"Each line camera differs in every field from its reference state, 1σ of Δα, Δβ, Δγ: {drifts}. "
        f"1 arcsec of Δα of the forward line is {abs(study.metres):.2f} m of height."
    ]
    if spec.monitor is not None:
        angles = ", ".join(format_quantity(v, ANGLE) for v in spec.monitor.angles)
        length = format_quantity(spec.monitor.principal_distance, LENGTH)
        text.append(f"The monitor reads each camera in each pass with {angles} and Δf {length}, 1σ.")
    rows: Rows = []
    for size in study.sizes:
        cells: list[Cell] = [size.factor, size.factor * study.angle / ARCSEC]
        for treatment in (size.without, size.monitored):
            cells += (None,) * 3 if treatment is None else (*astuple(treatment.together), treatment.p_value)
        rows.append(tuple(cells))
    none, nominal = study.at(0.0).without, study.at(1.0)
    cases = {"no drift": none.schemes, "no monitor": nominal.without.schemes}
    cases["monitor"] = {} if nominal.monitored is None else nominal.monitored.schemes
    figure = _figure(
        run,
        "monitor-heights",
        "Height errors and the drift of the cameras",
        "Left: one campaign, its drift drawn once and scaled; the dashed line is the mean of many campaigns. "
        "Right: RMS over all fields.",
    )
    by_size = Table(
        "monitor-sizes",
        "All fields adjusted at once",
        "RMS at check points of all fields, metres, each field with its own bias; p-value of the fit, with the noise "
        "of the readings of attitude and orbit treated as independent (which brings it too near to 1).",
        ("drift × file's", "σ Δα [arcsec]", "plan", "height", "p", "plan, monitor", "height, monitor", "p, monitor"),
        rows,
        (1, 2, 2, 2, 3, 2, 2, 3),
    )
    evaluate_schemes = Table(
        "monitor-schemes",
        "Schemes without ground control, with the file's drift",
        "RMS at check points of all fields, metres; the last scheme lets each field use its own parameters.",
        ("scheme", *(f"{what}, {case}" for what in ("plan", "height") for case in cases)),
        [
            (scheme, *(getattr(case.get(scheme), what, None) for what in RMS for case in cases.values()))
            for scheme in none.schemes
        ],
        (None, 2, 2, 2, 2, 2, 2),
    )
    return Section("Cameras that drift, and the on-board monitor", tuple(text), (figure, by_size, evaluate_schemes))


def strip_gain(run: CalibrationRun) -> str:
    """Return a sentence on the check points' errors with and without the adjustment of passes on tie points."""
    assert run.strips is not None
    scheme = list(run.schemes)[-2]
    old, new = (FieldErrors.pooled(e[scheme].values()) for e in (run.schemes, run.strips.schemes))
    return (
        f"With at least {min(run.strips.ties.values())} tie points per pass in the calibration and in an adjustment of "
        f"each pass, the height RMS of scheme {scheme} changes from {old.height_rms:.2f} m to {new.height_rms:.2f} m "
        f"and the plan RMS from {old.plan_rms:.2f} m to {new.plan_rms:.2f} m."
    )


def _strips(run: CalibrationRun) -> Section:
    strips = run.strips
    assert strips is not None
    rows: Rows = []
    for scheme, fields in strips.schemes.items():
        old, new = (FieldErrors.pooled(e.values()) for e in (run.schemes[scheme], fields))
        rows.append((scheme, old.plan_rms, new.plan_rms, old.height_rms, new.height_rms))
    table = Table(
        "strips",
        "Check points with and without tie points",
        "RMS at check points of all fields without ground control, metres. Without ties: calibrated on control points, "
        "intersected with the measured attitude and orbit. With ties: calibrated on control and tie points, "
        "intersected with the adjusted attitude and orbit. In the last scheme each field uses its own parameters.",
        ("scheme", "plan", "plan, with ties", "height", "height, with ties"),
        rows,
        (None, 2, 2, 2, 2),
    )
    common = Table(
        "strip-datum",
        f"Rotations of a whole pass, {run.campaign.passes[0].name}",
        "Sigma from the readings' noise alone and with tie points, in arcseconds, or arcseconds per second for rates. "
        "A ratio near 1 means that tie points do not determine the rotation.",
        ("rotation", "before", "after", "ratio"),
        [(d.name, d.before / ARCSEC, d.after / ARCSEC, d.after / d.before) for d in strips.datum],
        (None, 4, 4, 3),
    )
    tracker = run.campaign.spec.errors.star_tracker
    slow = max(tracker.slow.noise) / ARCSEC
    noise = f"{max(tracker.noise) / ARCSEC:g} arcsec from reading to reading"
    if slow:
        noise += f" and {slow:g} arcsec that change within {tracker.slow.interval:g} s"
    counts = ", ".join(f"{k} {n}" for k, n in strips.ties.items())
    text = (
        f"Every pass is adjusted on points that the lines see in common ({counts}), without ground coordinates. Check "
        f"points, which are not among them, are then intersected with the adjusted attitude and orbit. The attitude's "
        f"noise is {noise}.",
    )
    return Section("Adjustment of the strips", text, (table, common))


def _parameters(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    campaign, names = run.campaign, run.together.names
    interior = np.ravel([campaign.laboratory[line].interior for line in campaign.lines]).tolist()
    start = dict(zip(campaign.inner, interior, strict=True))
    drift = run.drift.sigmas_per_arcsec or {}
    rows: Rows = []
    for name, unknown in data["parameters"].items():
        scale, shown = (1e-6, "µm") if name in start else _SCALES[unknown["unit"]]
        first, held = start.get(name, 0.0), unknown["sigma"] == 0.0
        cells: list[Cell] = [
            (unknown["value"] - first) / scale,
            None if held else unknown["sigma"] / scale,
            drift.get(name),
        ]
        if run.truth is not None:
            z = None if held else (unknown["value"] - unknown["truth"]) / unknown["sigma"]
            cells += [(unknown["truth"] - first) / scale, z]
        rows.append((name, shown, *cells))
    apart = f"The lines see a field up to {campaign.passes[0].seconds_apart:.0f} s apart, and"
    if any(name in RATE for name in names):
        text = f"{apart} the fit of the biases against latitude predicts their drift in this time, with its sigma."
    elif any(name.endswith(RATE) for name in names):
        text = f"{apart} a rate of the attitude is estimated in each pass, with the stated or detected sigma as prior."
    else:
        text = f"{apart} a drift of the biases is not observable: the outer lines' principal points absorb it."
    table = Table(
        "parameters",
        "Unknowns of all fields at once",
        "Elements of the interior orientation: changes from the laboratory; biases and offsets: from measured to true. "
        "Without sigma: held (gauge). Drift: change of an unknown, in its sigmas, if the attitude drifts by 1 arcsec "
        f"in {run.drift.seconds:.0f} s and the adjustment does not model it; empty where rates are "
        "unknowns. z: error in sigmas.",
        ("unknown", "unit", "value", "σ", "σ per arcsec of drift", *(("truth", "z") if run.truth is not None else ())),
        rows,
        (None, None, 3, 3, 2, *((3, 2) if run.truth is not None else ())),
    )
    steps = CHIP_STEP.table(
        "chip-steps",
        "Steps between chips",
        "Steps are not unknowns of the adjustment: each is estimated from the residuals, at the joints of the camera's "
        "file or, for a line of one chip, at its middle. Detectable: size that is detected in half of all cases, with "
        "one false alarm in 10 000 runs.",
        data["chip_steps"],
        ("line", "axis", "place_m", "step_m", "sigma_m", "detectable_m"),
        digits=4,
    )
    title = f"Residuals of the control points in the images, {campaign.passes[0].name}"
    caption = "Titles: RMS of x and y. The residuals contain noise of the image and of the attitude."
    along = _figure(
        run,
        "residuals-along",
        "Residuals along the lines, all fields",
        "A mean that leaves zero over part of a line is an error that the parameters of the interior orientation do "
        "not describe.",
    )
    return Section("Parameters", (text,), (along, table, steps, _figure(run, "residuals", title, caption)))


def _fields(run: CalibrationRun) -> Section:
    rows: Rows = []
    for flight in run.campaign.passes:
        alone = run.fields[flight.name].adjustment
        bias = alone.bias(flight.name) / ARCSEC
        errors = [] if flight.known_truth is None else (bias - flight.bias / ARCSEC).tolist()
        rows.append((flight.name, float(np.degrees(flight.latitude)), *map(float, bias), *errors, alone.p_value))
    truth = ("Δ roll", "Δ pitch", "Δ yaw") if run.truth is not None else ()
    table = Table(
        "fields",
        "Each field by itself",
        f"Roll, pitch and yaw of the bias, arcseconds{', and minus the truth at the middle' * bool(truth)}. "
        "Offsets of the orbit are not among these unknowns; roll and pitch absorb them: 0.3 m are 0.1 arcsec.",
        ("field", "latitude [deg]", *BIAS, *truth, "p of the fit"),
        rows,
        (None, 1, *(3,) * (len(BIAS) + len(truth) + 1)),
    )
    if not run.repeatability:
        return Section("Fields", ("Repeatability needs two fields or more.",), (table,))
    scatter: Rows = []
    for r in run.repeatability:
        scale, shown = (ARCSEC, "arcsec") if r.name in BIAS else (1e-3, "mm")
        held = r.sigma == 0.0
        scatter.append((r.name, shown, *(None if held else v / scale for v in (r.scatter, r.sigma)), r.p_value))
    inner = [r for r in run.repeatability if r.name not in BIAS and r.sigma > 0.0]
    worst, largest = (
        max(rows_of_sort, key=lambda r: r.scatter)
        for rows_of_sort in (inner, [r for r in run.repeatability if r.name in BIAS])
    )
    text = (
        f"From field to field the interior orientation repeats to {1e3 * worst.scatter:.4f} mm or better (largest "
        f"standard deviation, {worst.name}). The biases scatter by up to {largest.scatter / ARCSEC:.2f} arcsec "
        f"({largest.name}).",
    )
    repeats = Table(
        "repeatability",
        "Repeatability over the fields",
        "Standard deviation over the fields, sigma predicted by a field's adjustment, and p-value of the scatter under "
        "this sigma. A small p-value for a bias means that it really differs from field to field. Without numbers: "
        "held (gauge).",
        ("parameter", "unit", "scatter", "predicted σ", "p"),
        scatter,
        (None, None, 4, 4, 3),
    )
    return Section("Fields", text, (repeats, table))


def _biases(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    figure = _figure(
        run,
        "bias-latitude",
        "Bias of the attitude against latitude",
        "From the adjustment of all fields, which includes the orbit's offsets. The errors of yaw are mostly common to "
        "all fields (y of the outer lines); differences between fields are determined far better.",
    )
    if not run.latitude:
        few = "There are too few fields, or all at one latitude, to separate a drift with latitude from the season."
        return Section("Biases against latitude", (few,), (figure,))
    keys = ("amplitude_rad", "amplitude_rad_sigma", "constant_rad", "constant_rad_sigma", "chi_square")
    table = LATITUDE.table(
        "bias-fits",
        "Amplitude × sin(latitude − reference) + constant",
        f"The reference is the middle of the fields, {np.degrees(run.latitude[0].reference):.1f}°. Chi-square: with "
        "the biases' own covariance. The remainder is the season; the sigmas include it.",
        data["bias_latitude"],
        (*keys, "degrees_of_freedom", "p_value", "remainder_rad"),
        "axis",
        digits=4,
    )
    truth = ""
    if run.truth is not None:
        # measured to true is the inverse of the drift of the measured attitude
        errors = run.campaign.simulated.errors
        drift = -np.array(errors.star_tracker.thermal.amplitude) * errors.switched_on
        drawn = (", ".join(f"{v / ARCSEC:.3g}" for v in values_drawn) for values_drawn in (drift, errors.season))
        truth = " The true amplitudes are {} arcsec, the season's standard deviations {} arcsec.".format(*drawn)
    values = np.array([[run.together.value(f"{p.name} {axis}") for p in run.campaign.passes] for axis in BIAS[:2]])
    spread = float(np.hypot(*values.std(axis=1, ddof=1)))
    metres, largest = spread * run.campaign.passes[0].altitude, max(len(s) for s in run.campaign.spec.schemes)
    weak = [f.axis for f in run.latitude if abs(f.amplitude) < 2.0 * f.amplitude_sigma]
    seen = f"the drift is not significant in {', '.join(weak)}" if weak else "the drift is significant in all axes"
    change = np.ptp(np.sin(run.latitude[0].latitude - run.latitude[0].reference))
    remainders = ", ".join(f"{f.remainder / ARCSEC:.2f} arcsec in {f.axis}" for f in run.latitude)
    text = (
        f"The fields lie within {np.degrees(np.ptp(run.latitude[0].latitude)):.0f}° of latitude, where the sine "
        f"changes by {change:.2f}. Beside the drift, the season of each field remains, {remainders}: {seen} at two "
        f"sigmas.{truth}",
        f"Roll and pitch of the fields scatter by {spread / ARCSEC:.2f} arcsec together, {metres:.1f} m on the "
        f"ground. The bias of one field therefore causes errors of {np.sqrt(2.0) * metres:.1f} m RMS in plan in "
        f"another field, and the mean bias of {largest} fields {np.sqrt(1.0 + 1.0 / largest) * metres:.1f} m, beside "
        "noise.",
    )
    return Section("Biases against latitude", text, (figure, table))


def _left(row: LightRow) -> str:
    if not row.left:
        return "all corrected"
    return "all" if len(row.left) > 2 else " and ".join(name.replace("_", " ") for name in row.left)


def _light(run: CalibrationRun) -> Section:
    if len(run.light) < 2:
        return Section("Effects on the light", ("All effects are switched off.",))
    lines, pitch = run.campaign.lines, run.campaign.passes[0].data.pitch
    rows: Rows = []
    for row in run.light:
        inner, turned = row.most(run.campaign.inner), row.most(tuple(n for n in row.shift if n.split()[-1] in BIAS))
        shifts = [f"{who} {by:+.1f} σ" if row.left else "" for who, by in (inner, turned)]
        name = f"{_left(row)} not corrected" if row.left else _left(row)
        rows.append((name, *astuple(row.before), *astuple(row.after), *shifts, row.p_value))
    pixels = Table(
        "light-pixels",
        "Displacement of image points",
        "RMS over the check points, pixels, x along the track and y along the line.",
        ("effect", *(f"{line} {axis}" for line in lines for axis in "xy")),
        [
            (_left(row), *(float(v / pitch[line]) for line in lines for v in row.moved[line]))
            for row in run.light
            if row.left
        ],
        (None, *(3,) * (2 * len(lines))),
    )
    effects = Table(
        "light",
        "Effects that are not corrected in the image points",
        "RMS at check points, mean of the fields, metres: with the laboratory's camera, and with each field's own "
        "parameters; the unknowns of the simultaneous adjustment that move by the most of their sigmas; p-value of the "
        "fit, with the noise of the readings treated as independent.",
        ("case", "plan before", "height before", "plan after", "height after", "interior", "bias", "p of the fit"),
        rows,
        (None, 2, 2, 2, 2, None, None, 3),
    )
    last_case = run.light[-1]
    parameter, ratio = last_case.most(run.campaign.inner)
    text = (
        "Left uncorrected, they hardly change the errors of a camera that is used as it was calibrated: biases and "
        f"principal points absorb them, and the mean error in plan changes from {run.light[0].after.plan_rms:.3f} m to "
        f"{last_case.after.plan_rms:.3f} m. But the parameters are then wrong ({parameter} by "
        f"{1e6 * last_case.shift[parameter]:+.1f} µm, {abs(ratio):.1f} sigmas), which the residuals need not show.",
    )
    return Section("Effects on the light", text, (pixels, effects))


def _datum(run: CalibrationRun) -> Section:
    rows: Rows = []
    for row in run.datum:
        (name, change), (sure, sigmas) = row.most, row.most_sigmas
        where = ", ".join(f"{v:g} m {axis}" for v, axis in zip(row.shift, ("east", "north", "up"), strict=True) if v)
        where = f"lines {1e3 * row.late:g} ms late" if row.late else where
        scale, unit = (1e3, "ms") if row.late else (1.0, "m")
        warned = "never" if row.warned is None else f"{scale * row.warned:.3g} {unit}"
        sizes = f"{sure} {sigmas:.1f} σ", f"{scale * row.size / max(sigmas, 1e-9):.3g} {unit}", warned
        moved = [DecimalNumber(v / ARCSEC, 2) for v in row.bias]
        others = (*map(float, row.offset), row.fit, row.p_value, *astuple(row.after))
        rows.append((where, *moved, f"{name} {1e6 * change:+.1f} µm", *sizes, *others))
    table = Table(
        "datum",
        "All control points in a wrong datum",
        "Mean changes of the fields' biases, arcseconds; the element of the interior orientation that changes most; "
        "the one that changes by the most of its sigmas, the error of the datum that changes it by one sigma, and the "
        "error that raises a warning of an unexpected change; mean changes of the orbit's offsets, metres; change of "
        "the chi-square and p-value of the fit; RMS at check points in the right datum, each field with its own "
        "parameters, metres.",
        (
            *("error", *BIAS, "interior", "in sigmas", "one sigma at", "warning from", *OFFSET),
            *("Δ chi-square", "p of the fit", "plan after [m]", "height after [m]"),
        ),
        rows,
        (*(None,) * 8, 3, 3, 3, 1, 3, 2, 2),
    )
    launch = run.campaign.spec.launch
    roll, inner = (format_quantity(v, k) for v, k in ((launch.bias[0], ANGLE), (launch.interior, LENGTH)))
    metres = UNEXPECTED_SIGMAS * launch.bias[0] * run.campaign.passes[0].altitude
    beyond = ", ".join(f"{s.name} ({s.ratio:.1f}σ)" for s in run.unexpected_changes[:6])
    text = (
        "Biases and interior orientation absorb a shift that all control points share; the residuals need not show "
        f"it. The file expects changes by a launch of {roll} (roll) and {inner} (interior), 1σ. There is a warning "
        f"above {UNEXPECTED_SIGMAS:g} times these, {metres:.0f} m of shift across the track.",
        f"Unexpected changes in this run: {beyond or 'none'}.",
    )
    return Section("Datum of the control points", text, (table,))


def prior_dominated(adjustment: Adjustment) -> dict[str, float]:
    """Return the unknowns that the prior determines more than the points, with the prior's share of their variance."""
    shares = zip(adjustment.names, adjustment.prior_share.tolist(), strict=True)
    return {name: share for name, share in shares if share > MOSTLY}


def _rank(run: CalibrationRun) -> Section:
    adjustment, stepwise = run.together, run.stepwise
    size = np.nan_to_num(np.abs(np.triu(adjustment.correlation, 1)), posinf=0.0)
    pairs = zip(*np.unravel_index(np.argsort(size, axis=None)[::-1][:10], size.shape), strict=True)
    text = [f"Gauge: {adjustment.gauge}."]
    text += [f"Not observable: {c}." for c in adjustment.open]
    text += [f"Weak, but solved for: {c}." for c in adjustment.weak]
    if resting := prior_dominated(adjustment):
        shares = ", ".join(f"{name} ({100.0 * share:.0f}% of its variance)" for name, share in resting.items())
        text.append(f"Determined mainly by the launch prior, not by the points: {shares}.")
    text.append(
        "The stepwise solution, bias and interior in turn, "
        f"{'converges' if stepwise.converged else 'does not converge'} for {run.campaign.spec.schemes[0][0]} in "
        f"{stepwise.rounds} rounds to steps of {STEPWISE_TOLERANCE:g} sigma; its convergence rate is "
        f"{stepwise.rate:.4f} per round. The simultaneous adjustment of all fields takes {adjustment.iterations} "
        "iterations."
    )
    table = Table(
        "correlations",
        "Largest correlations",
        "Largest correlations of the simultaneous adjustment; calibration.json has all of them.",
        ("unknown", "unknown", "correlation"),
        [(adjustment.names[int(i)], adjustment.names[int(j)], float(adjustment.correlation[i, j])) for i, j in pairs],
        (None, None, 4),
    )
    caption = "Correlations of the simultaneous adjustment, held unknowns excluded."
    return Section("Observability", tuple(text), (table, _figure(run, "correlation-matrix", "Correlations", caption)))


def _data(run: CalibrationRun) -> Section:
    rows: Rows = []
    for name, result in run.fields.items():
        sizes = ((result.orbit, 1.0), (result.attitude, ARCSEC))
        cells = [[None] * 3 if difference is None else (difference.rms / unit).tolist() for difference, unit in sizes]
        rows.append((name, *cells[0], *cells[1]))
    table = Table(
        "third-differences",
        "RMS of third differences",
        "Measured positions in the Earth-fixed frame, metres; measured attitude against the orbital frame, arcseconds. "
        "White noise of sigma 1 gives the square root of 20. Third differences do not contain biases and drifts.",
        ("field", "x", "y", "z", "roll", "pitch", "yaw"),
        rows,
        (None, 4, 4, 4, 4, 4, 4),
    )
    return Section("Orbit and attitude data", (), (table,))
