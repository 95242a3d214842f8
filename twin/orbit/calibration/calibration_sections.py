"""Sections of the report of an in-orbit calibration: schemes, parameters, fields, biases, influences, observability.

docs/orbit.md explains what averaging, drifting cameras, tie points and effects on the light do to the result.
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
from twin.framework.artefact import Cell, OwnDecimals, PngFigure, SvgFigure, Table
from twin.framework.report import Section
from twin.orbit.calibration.calibration_numbers import CHIP_STEP, LATITUDE, MATCHING, SCREENED
from twin.orbit.calibration.calibration_plots import figure_svg
from twin.orbit.calibration.calibration_run import STEPWISE_TOLERANCE, CalibrationRun
from twin.orbit.calibration.influences import SURPRISE, LightRow
from twin.orbit.calibration.schemes import RMS, FieldErrors, SchemeMeans, meets, values_of
from twin.orbit.calibration.screening import ground_sample, meeting_of
from twin.orbit.images.image_points import BEYOND
from twin.orbit.images.patch import WRONG
from twin.orbit.images.point_report import SORTS, points_png

_SCALES = {"rad": (ARCSEC, "arcsec"), "rad/s": (1e-3 * ARCSEC, "mas/s"), "m": (1.0, "m")}
"""Unit of an unknown in files -> its size in the unit of tables, and that unit."""
MOSTLY = 0.5
"""Share of an unknown's variance beyond which it rests on the launch's prior and not on the points."""
Rows = list[tuple[Cell, ...]]


def sections(run: CalibrationRun, data: Mapping[str, Any]) -> tuple[Section, ...]:
    """Return the sections that a calibration has.

    Parameters
    ----------
    run : CalibrationRun
        The calibration.
    data : Mapping[str, Any]
        Of calibration.json.
    """
    found = (
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
    return tuple(section for section in found if section is not None)


def _figure(run: CalibrationRun, name: str, title: str, caption: str) -> SvgFigure:
    return SvgFigure(name, title, caption, figure_svg(name, run))


def scheme_names(run: CalibrationRun) -> list[str]:
    """Schemes with the fields that they average; the last one averages nothing."""
    names = [f"{k + 1}: {', '.join(s)}" for k, s in enumerate(run.campaign.spec.schemes)]
    return [*names, f"{len(names) + 1}: each field its own"]


def summary(run: CalibrationRun) -> Table:
    """Return the table of the schemes, tested on all fields."""
    rows: Rows = []
    for name, errors in zip(["laboratory", *scheme_names(run)], (run.before, *run.schemes.values()), strict=True):
        values = [values_of(errors, what) for what in RMS]
        numbers = [float(v) for rms in values for v in (rms.mean(), rms.std(), rms.max())]
        rows.append((name, *numbers, "yes" if meets(errors, run.campaign.spec.limits) else "no"))
    return Table(
        "schemes",
        "Schemes of parameters, tested on all fields without ground control",
        "RMS at check points, metres: mean, standard deviation and largest of the fields.",
        ("parameters", "plan [m]", "spread", "largest", "height [m]", "spread", "largest", "1:50 000"),
        rows,
        (None, 2, 2, 2, 2, 2, 2, None),
    )


def scheme_summary(means: SchemeMeans | None) -> str:
    """What averaging does to plan and height, in a sentence."""
    if means is None:
        return "With one scheme of averaged parameters there is nothing to compare."
    plan, spread, height = means.plan, means.plan_spread, means.height
    return (
        f"The mean RMS in plan goes from {plan[0]:.2f} m with the first scheme to {plan[-1]:.2f} m with the last of "
        f"averaged parameters, its spread over the fields from {spread[0]:.2f} m to {spread[-1]:.2f} m; in height it "
        f"goes from {height[0]:.2f} m to {height[-1]:.2f} m and changes by "
        f"{100.0 * means.height_change:.1f}% at most."
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
        f"interior orientation, of which two are held), and each scheme uses the mean of the parameters of its "
        f"fields: {'; '.join(scheme_names(run))}.",
        scheme_summary(run.scheme_means),
    )
    check = "Arrows in plan, colour in height: before calibration and with the field's own parameters."
    title = f"Errors at check points of {run.campaign.passes[0].name}"
    figures = (
        _figure(run, "schemes-of-fields", "Schemes", "Each line is a field."),
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
        "from campaign to campaign; spread over the fields; in how many campaigns every field meets 1:50 000. Biases, "
        "orbits, points and noise are drawn anew; the camera, the fields and the drift with latitude stay.",
        ("parameters", *heads, "1:50 000"),
        rows,
        (None, 2, 2, 2, 2, 2, 2, None),
    )
    return Section("Other campaigns", (), (table,))


def _measured(run: CalibrationRun) -> Section:
    campaign = run.campaign
    rows: Rows = []
    sizes: Rows = []
    for one in campaign.passes:
        gone, alone = campaign.rejected.get(one.name), run.fields[one.name].adjustment
        meeting, errors = meeting_of(campaign, one, alone), list(run.schemes.values())[-1][one.name]
        factors = {} if gone is None else {line: f"{factor:.2f}" for line, factor in gone.factors.items()}
        alike = len(set(factors.values())) == 1
        factor = factors.popitem()[1] if alike else ", ".join(f"{line} {v}" for line, v in factors.items())
        lost = (None, None, None) if gone is None else (len(gone.points), len(gone.check_points), factor)
        points = (int(one.is_control.sum()), one.tie_count, len(one.check_ground))
        ratio, check = (v.chi_square / max(v.degrees_of_freedom, 1) for v in (alone, meeting))
        rows.append((one.name, *points, *lost, ratio, alone.p_value, check))
        for line in one.data.sensors:
            along, across = ground_sample(one, line)
            pixel = float(np.sqrt(along * across))
            both = errors.plan_rms / pixel, errors.height_rms / pixel
            sizes.append((one.name, line, along, across, *both, errors.count))
    heads = ("image points left out", "check left out", "factor", "χ²/dof", "chance", "check χ²/dof")
    tables = (
        Table(
            "measured-points",
            "Points of every pass",
            "Left out: image points that robust weights gave up, check points whose rays do not meet. Factor: on the "
            "given sigmas of image points of the lines, by the residuals of those that remain. Chi-square over its "
            "degrees of freedom, of the pass by itself and of the rays of its check points with these parameters.",
            ("pass", "control", "ties", "check", *heads),
            rows,
            (None, None, None, None, None, None, None, 2, 3, 2),
        ),
        Table(
            "measured-pixels",
            "Pixels on the ground, and errors of check points in them",
            "Ground sample distance of the middle of each line, metres; RMS errors of the check points by the pass's "
            "own parameters, in ground pixels (root of along times across).",
            ("pass", "line", "along the track [m]", "across [m]", "plan [px]", "height [px]", "check points"),
            sizes,
            (None, None, 3, 3, 2, 2, None),
        ),
    )
    none = () if campaign.rejected else ("No image point was left out: the file says `screening: none`.",)
    return Section("Measurements", (*none, _limits(run)), tables)


def _limits(run: CalibrationRun) -> str:
    noise, one = run.campaign.noise, run.campaign.passes[0]
    ground = one.altitude / float(np.mean([m.interior[0] for m in run.campaign.laboratory.values()]))
    control = np.trace(one.control_covariance[one.is_control], axis1=1, axis2=2)
    # white noise of the readings by their spline, in metres on the ground, beside that of the image
    parts = {
        "image points": noise.image * ground,
        "readings of the attitude": noise.attitude * one.altitude,
        "slow errors of the attitude": noise.slow_attitude * one.altitude,
        "readings of the orbit": noise.station,
        "control points": float(np.sqrt(np.mean(control / 3.0))),
    }
    texts = ", ".join(f"{name} {value:.2g} m" for name, value in sorted(parts.items(), key=lambda v: -v[1]) if value)
    return (
        f"One standard deviation on the ground at nadir, of a single ray to a single point of {one.name}: {texts}. "
        "The first of these limits the result; more points make it smaller but for slow errors of the attitude."
    )


def _images(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    campaign, total, spec = run.campaign, data["total"], run.campaign.simulated.images
    assert campaign.images is not None
    assert spec is not None
    screened = SCREENED.table(
        "image-points",
        "Image points in the adjustment",
        "Of points that every line has; left: by robust weights (IGG), and check points whose rays meet.",
        {one.name: SCREENED(one.screening) for one in campaign.images if one.screening is not None},
        label="field",
    )
    found = {
        f"{field}, {SORTS[sort]}, {line}": numbers
        for field, sorts in data["fields"].items()
        for sort, lines in sorts.items()
        for line, numbers in lines.items()
    }
    caption = (
        f"Wrong: {WRONG}; before any test, after the thresholds of matching, after consensus. RMS and chi-square of "
        "right places."
    )
    counts = ("wrong_found", "found", "wrong_matched", "matched", "wrong_accepted", "accepted")
    keys = (*counts, "right_rejected_by_consensus", "rms_lines_px", "rms_pixels_px", "chi_square_ratio")
    matching = MATCHING.table("image-matching", "Matching", caption, found, keys, "field, points, line", digits=4)
    left = " and ".join(str(int(p.control.control.sum())) for p in campaign.passes)
    text = (
        f"In each field {len(spec.patches)} patches of {spec.lines} x {spec.pixels} pixels are rendered by every line. "
        f"Of {total['found']} places that matching found, {total['wrong_found']} are wrong "
        f"({100.0 * total['wrong_found'] / total['found']:.1f}%), mostly on fields that look different in the "
        f"orthophoto; thresholds of the matching leave {total['wrong_matched']} of {total['matched']}, the "
        f"neighbours' agreement {total['wrong_accepted']} of {total['accepted']}, the adjustment "
        f"{total['wrong_left']} of {total['left']} image points ({total['check_left']} check points: "
        f"{total['wrong_check_left']}). The neighbours' test costs {total['right_rejected_by_consensus']} right ones, "
        f"the adjustment {total['right_rejected_by_adjustment']}. {left} control points are left. Their image "
        f"points weigh by the covariances of the matching and {BEYOND:g} px beyond them, for what no fit shows.",
    )
    first = campaign.images[0]
    figures = [
        PngFigure(
            f"points-{sort}",
            f"From predicted to found, {SORTS[sort]} points, first patch of {first.name}",
            "Arrows: what is left after the median displacement, enlarged as the title says; crosses: rejected by the "
            "neighbours; points: not matched.",
            points_png(first.shown, points),
        )
        for sort, points in first.patches[0].points.sorts.items()
    ]
    return Section("Points in images", text, (matching, screened, *figures))


def monitor_gain(run: CalibrationRun) -> str:
    """What the monitor is worth, in a sentence."""
    assert run.monitoring is not None
    none, here = run.monitoring.at(0.0), run.monitoring.at(1.0)
    scheme = list(none.without.schemes)[-2]
    still, blind = none.without.schemes[scheme].height_rms, here.without.schemes[scheme].height_rms
    text = (
        f"With cameras that drift by {run.monitoring.angle / ARCSEC:.2g} arcsec (Δα, 1σ) from field to field, heights "
        f"without ground control (scheme {scheme}) are wrong by {blind:.2f} m RMS, {still:.2f} m without drift"
    )
    if here.monitored is None:
        return f"{text}."
    return f"{text}; with the on-board monitor's readings, {here.monitored.schemes[scheme].height_rms:.2f} m."


def _monitoring(run: CalibrationRun) -> Section:
    found, spec = run.monitoring, run.campaign.simulated
    assert found is not None
    drifts = "; ".join(
        f"{name} {', '.join(format_quantity(v, ANGLE) for v in one.angles)}, "
        f"Δf {format_quantity(one.principal_distance, LENGTH)}"
        for name, one in spec.drift.items()
    )
    text = [
        f"Each line camera differs in every field from its reference state, 1σ of Δα, Δβ, Δγ: {drifts}. "
        f"1 arcsec of Δα of the forward line is {abs(found.metres):.2f} m of height."
    ]
    if spec.monitor is not None:
        angles = ", ".join(format_quantity(v, ANGLE) for v in spec.monitor.angles)
        length = format_quantity(spec.monitor.principal_distance, LENGTH)
        text.append(f"The monitor reads each camera in each pass with {angles} and Δf {length}, 1σ.")
    rows: Rows = []
    for size in found.sizes:
        cells: list[Cell] = [size.factor, size.factor * found.angle / ARCSEC]
        for one in (size.without, size.monitored):
            cells += (None,) * 3 if one is None else (*astuple(one.together), one.p_value)
        rows.append(tuple(cells))
    none, here = found.at(0.0).without, found.at(1.0)
    cases = {"no drift": none.schemes, "no monitor": here.without.schemes}
    cases["monitor"] = {} if here.monitored is None else here.monitored.schemes
    figure = _figure(
        run,
        "monitor-heights",
        "Height errors and the drift of the cameras",
        "Left: one campaign, its drift drawn once and scaled; the dashed line is what many campaigns would have "
        "on average. Right: RMS over all fields.",
    )
    by_size = Table(
        "monitor-sizes",
        "All fields adjusted at once",
        "RMS at check points of all fields, metres, each field with its own bias; chance of the fit, with the noise of "
        "the readings of attitude and orbit counted as independent (which makes it too near to 1).",
        ("drift × file's", "σ Δα [arcsec]", "plan", "height", "chance", "plan, told", "height, told", "chance"),
        rows,
        (1, 2, 2, 2, 3, 2, 2, 3),
    )
    by_scheme = Table(
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
    return Section("Cameras that drift, and the on-board monitor", tuple(text), (figure, by_size, by_scheme))


def strip_gain(run: CalibrationRun) -> str:
    """What tie points are worth, in a sentence."""
    assert run.strips is not None
    scheme = list(run.schemes)[-2]
    old, new = (FieldErrors.pooled(e[scheme].values()) for e in (run.schemes, run.strips.schemes))
    return (
        f"Calibrating with {min(run.strips.ties.values())} tie points of each pass or more, and adjusting each pass on "
        f"them, takes the height RMS of scheme {scheme} from {old.height_rms:.2f} m to {new.height_rms:.2f} m and the "
        f"plan RMS from {old.plan_rms:.2f} m to {new.plan_rms:.2f} m."
    )


def _strips(run: CalibrationRun) -> Section:
    found = run.strips
    assert found is not None
    rows: Rows = []
    for scheme, fields in found.schemes.items():
        old, new = (FieldErrors.pooled(e.values()) for e in (run.schemes[scheme], fields))
        rows.append((scheme, old.plan_rms, new.plan_rms, old.height_rms, new.height_rms))
    table = Table(
        "strips",
        "Check points with and without tie points",
        "RMS at check points of all fields without ground control, metres: calibrated on control points and "
        "intersected as measured; calibrated on control and tie points and intersected with the adjusted attitude and "
        "orbit. The last scheme lets each field use its own parameters.",
        ("scheme", "plan", "plan, with ties", "height", "height, with ties"),
        rows,
        (None, 2, 2, 2, 2),
    )
    common = Table(
        "strip-datum",
        f"What the tie points tell of turns of a whole pass, {run.campaign.passes[0].name}",
        "Sigma from the readings' noise alone and with the ties, arcseconds, of rates arcseconds per second. A ratio "
        "near 1 means that ties say nothing of it.",
        ("turn", "before", "after", "ratio"),
        [(d.name, d.before / ARCSEC, d.after / ARCSEC, d.after / d.before) for d in found.datum],
        (None, 4, 4, 3),
    )
    tracker = run.campaign.spec.errors.star_tracker
    slow = max(tracker.slow.noise) / ARCSEC
    noise = f"{max(tracker.noise) / ARCSEC:g} arcsec from reading to reading"
    if slow:
        noise += f" and {slow:g} arcsec that change within {tracker.slow.interval:g} s"
    counts = ", ".join(f"{k} {n}" for k, n in found.ties.items())
    text = (
        f"Every pass is adjusted on points that three lines see ({counts}) without coordinates on the ground; check "
        f"points, which are no ties, are then intersected with the adjusted attitude and orbit. The attitude's noise "
        f"here is {noise}.",
    )
    return Section("Adjustment of the strips", text, (table, common))


def _parameters(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    campaign, names = run.campaign, run.together.names
    interior = np.ravel([campaign.laboratory[line].interior for line in campaign.lines]).tolist()
    start = dict(zip(campaign.inner, interior, strict=True))
    drift = run.drift.sigmas_per_arcsec or {}
    rows: Rows = []
    for name, one in data["parameters"].items():
        scale, shown = (1e-6, "µm") if name in start else _SCALES[one["unit"]]
        first, held = start.get(name, 0.0), one["sigma"] == 0.0
        cells: list[Cell] = [(one["value"] - first) / scale, None if held else one["sigma"] / scale, drift.get(name)]
        if run.truth is not None:
            z = None if held else (one["value"] - one["truth"]) / one["sigma"]
            cells += [(one["truth"] - first) / scale, z]
        rows.append((name, shown, *cells))
    apart = f"The lines see a field up to {campaign.passes[0].seconds_apart:.0f} s apart, and"
    if any(name in RATE for name in names):
        text = f"{apart} the fit of the biases against latitude tells their drift in this time, with its sigma."
    elif any(name.endswith(RATE) for name in names):
        text = f"{apart} a rate of the attitude in each pass is solved for, with the stated or found sigma as prior."
    else:
        text = f"{apart} nothing tells a drift of the biases: it goes into the outer lines' principal points."
    table = Table(
        "parameters",
        "Unknowns of all fields at once",
        "Elements of the interior orientation: changes from the laboratory; biases and offsets: from measured to true. "
        "Without sigma: held (gauge). Drift: by how many of its sigmas an unknown moves where the attitude drifts by "
        f"1 arcsec in {run.drift.seconds:.0f} s and the adjustment does not know of it; empty where rates are "
        "unknowns. z: the error in sigmas.",
        ("unknown", "unit", "value", "σ", "σ per arcsec of drift", *(("truth", "z") if run.truth is not None else ())),
        rows,
        (None, None, 3, 3, 2, *((3, 2) if run.truth is not None else ())),
    )
    steps = CHIP_STEP.table(
        "chip-steps",
        "Steps between chips that these points would show",
        "Steps are no unknowns: what the residuals say of one at each joint of the camera's file, at the middle of a "
        "line of one chip. Seen from: told in half of all cases, one false alarm in 10 000 runs.",
        data["chip_steps"],
        ("line", "axis", "place_m", "step_m", "sigma_m", "seen_from_m"),
        digits=4,
    )
    title = f"Residuals of the control points in the images, {campaign.passes[0].name}"
    caption = "RMS of x and y in each line's title. What is left is noise of the image and of the attitude."
    return Section("Parameters", (text,), (table, steps, _figure(run, "residuals", title, caption)))


def _fields(run: CalibrationRun) -> Section:
    rows: Rows = []
    for one in run.campaign.passes:
        alone = run.fields[one.name].adjustment
        bias = alone.bias(one.name) / ARCSEC
        errors = [] if one.known_truth is None else (bias - one.bias / ARCSEC).tolist()
        rows.append((one.name, float(np.degrees(one.latitude)), *map(float, bias), *errors, alone.p_value))
    truth = ("Δ roll", "Δ pitch", "Δ yaw") if run.truth is not None else ()
    table = Table(
        "fields",
        "Each field by itself",
        f"Roll, pitch and yaw of the bias, arcseconds{', and minus the truth at the middle' * bool(truth)}. "
        "An offset of the orbit, which these unknowns do not have, goes into roll and pitch: 0.3 m are 0.1 arcsec.",
        ("field", "latitude [deg]", *BIAS, *truth, "chance of the fit"),
        rows,
        (None, 1, *(3,) * (len(BIAS) + len(truth) + 1)),
    )
    if not run.repeatability:
        return Section("Fields", ("One field alone does not repeat.",), (table,))
    scatter: Rows = []
    for r in run.repeatability:
        scale, shown = (ARCSEC, "arcsec") if r.name in BIAS else (1e-3, "mm")
        held = r.sigma == 0.0
        scatter.append((r.name, shown, *(None if held else v / scale for v in (r.scatter, r.sigma)), r.p_value))
    inner = [r for r in run.repeatability if r.name not in BIAS and r.sigma > 0.0]
    worst, largest = (
        max(some, key=lambda r: r.scatter) for some in (inner, [r for r in run.repeatability if r.name in BIAS])
    )
    text = (
        f"From field to field the interior orientation repeats to {1e3 * worst.scatter:.4f} mm or better (standard "
        f"deviation, {worst.name}). The biases scatter by up to {largest.scatter / ARCSEC:.2f} arcsec "
        f"({largest.name}).",
    )
    repeats = Table(
        "repeatability",
        "Repeatability over the fields",
        "Standard deviation over the fields, sigma that a field's adjustment claims, chance of such a scatter by this "
        "sigma alone. Small for a bias means that it really differs from field to field. Without numbers: held "
        "(gauge).",
        ("parameter", "unit", "scatter", "claimed σ", "chance"),
        scatter,
        (None, None, 4, 4, 3),
    )
    return Section("Fields", text, (repeats, table))


def _biases(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    figure = _figure(
        run,
        "bias-latitude",
        "Bias of the attitude against latitude",
        "From the adjustment of all fields, which knows of the orbit's offsets. The error bars of yaw are common to "
        "all fields (y of the outer lines); its differences are known far better.",
    )
    if not run.latitude:
        few = "There are too few fields, or all at one latitude, to tell a drift with latitude from the season."
        return Section("Biases against latitude", (few,), (figure,))
    keys = ("amplitude_rad", "amplitude_rad_sigma", "constant_rad", "constant_rad_sigma", "chi_square")
    table = LATITUDE.table(
        "bias-fits",
        "Amplitude × sin(latitude − reference) + constant",
        f"The reference is the middle of the fields, {np.degrees(run.latitude[0].reference):.1f}°. Chi-square with "
        "the biases' own covariance; what remains beside it is the season, and the sigmas contain it.",
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
        drawn = (", ".join(f"{v / ARCSEC:.3g}" for v in some) for some in (drift, errors.season))
        truth = " In truth they are {} arcsec, and the season's standard deviations {} arcsec.".format(*drawn)
    values = np.array([[run.together.value(f"{p.name} {axis}") for p in run.campaign.passes] for axis in BIAS[:2]])
    spread = float(np.hypot(*values.std(axis=1, ddof=1)))
    metres, most = spread * run.campaign.passes[0].altitude, max(len(s) for s in run.campaign.spec.schemes)
    weak = [f.axis for f in run.latitude if abs(f.amplitude) < 2.0 * f.amplitude_sigma]
    seen = f"in this campaign the drift does not show in {', '.join(weak)}" if weak else "the drift shows in all axes"
    reach = np.ptp(np.sin(run.latitude[0].latitude - run.latitude[0].reference))
    rest = ", ".join(f"{f.remainder / ARCSEC:.2f} arcsec in {f.axis}" for f in run.latitude)
    text = (
        f"The fields lie within {np.degrees(np.ptp(run.latitude[0].latitude)):.0f}° of latitude, where the sine "
        f"changes by {reach:.2f}. Beside the drift there remain {rest}, the season of each field: {seen} at two "
        f"sigmas.{truth}",
        f"Roll and pitch of the fields scatter by {spread / ARCSEC:.2f} arcsec together, {metres:.1f} m on the "
        f"ground. By the rules of a mean, one field's bias leaves another field {np.sqrt(2.0) * metres:.1f} m RMS in "
        f"plan, and the mean of {most} fields {np.sqrt(1.0 + 1.0 / most) * metres:.1f} m, beside the noise of its own.",
    )
    return Section("Biases against latitude", text, (figure, table))


def _left(row: LightRow) -> str:
    if not row.left:
        return "nothing left in"
    return "all" if len(row.left) > 2 else " and ".join(name.replace("_", " ") for name in row.left)


def _light(run: CalibrationRun) -> Section:
    if len(run.light) < 2:
        return Section("Effects on the light", ("None is on.",))
    lines, pitch = run.campaign.lines, run.campaign.passes[0].data.pitch
    rows: Rows = []
    for row in run.light:
        inner, turned = row.most(run.campaign.inner), row.most(tuple(n for n in row.shift if n.split()[-1] in BIAS))
        shifts = [f"{who} {by:+.1f} σ" if row.left else "" for who, by in (inner, turned)]
        name = f"{_left(row)} left in" if row.left else _left(row)
        rows.append((name, *astuple(row.before), *astuple(row.after), *shifts, row.p_value))
    pixels = Table(
        "light-pixels",
        "How far image points move",
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
        "What is not taken out of the image points",
        "RMS at check points, mean of the fields, metres: by the laboratory's camera, and by each field's own "
        "parameters; the unknowns of the simultaneous adjustment that move by the most of their sigmas; chance of the "
        "fit, with the noise of the readings counted as independent.",
        ("case", "plan before", "height before", "plan after", "height after", "interior", "bias", "chance of the fit"),
        rows,
        (None, 2, 2, 2, 2, None, None, 3),
    )
    left = run.light[-1]
    most, ratio = left.most(run.campaign.inner)
    text = (
        "Left in, they do hardly any harm where a camera is used as it was calibrated: biases and principal points "
        f"take them up, the mean error in plan goes from {run.light[0].after.plan_rms:.3f} m to "
        f"{left.after.plan_rms:.3f} m. But parameters are then "
        f"wrong ({most} by {1e6 * left.shift[most]:+.1f} µm, {abs(ratio):.1f} sigmas), which the fit need not show.",
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
        moved = [OwnDecimals(v / ARCSEC, 2) for v in row.bias]
        rest = (*map(float, row.offset), row.fit, row.p_value, *astuple(row.after))
        rows.append((where, *moved, f"{name} {1e6 * change:+.1f} µm", *sizes, *rest))
    table = Table(
        "datum",
        "All control points in a wrong datum",
        "Mean changes of the fields' biases, arcseconds; the element of the interior that changes most; the one that "
        "changes by the most of its sigmas, what makes one sigma of it, and from what on an unknown is beyond what "
        "launch leaves to expect, which gives a warning; mean changes of the orbit's offsets, metres; change of the "
        "chi-square and chance of the fit; RMS at check points in the right datum, each field with its own parameters, "
        "metres.",
        (
            *("wrong by", *BIAS, "interior", "in sigmas", "one sigma at", "warned from", *OFFSET),
            *("Δ chi-square", "chance of the fit", "plan after [m]", "height after [m]"),
        ),
        rows,
        (*(None,) * 8, 3, 3, 3, 1, 3, 2, 2),
    )
    launch = run.campaign.spec.launch
    roll, inner = (format_quantity(v, k) for v, k in ((launch.bias[0], ANGLE), (launch.interior, LENGTH)))
    metres = SURPRISE * launch.bias[0] * run.campaign.passes[0].altitude
    beyond = ", ".join(f"{s.name} ({s.ratio:.1f}σ)" for s in run.surprises[:6])
    text = (
        "A shift that all control points share goes into biases and interior orientation, and the fit need not show "
        f"it. The file expects {roll} (roll) and {inner} (interior) of a launch; beyond {SURPRISE:g} times this there "
        f"is a warning, which is {metres:.0f} m of shift across the track.",
        f"Beyond what is expected here: {beyond or 'nothing'}.",
    )
    return Section("Datum of the control points", text, (table,))


def rests_on_launch(found: Adjustment) -> dict[str, float]:
    """Unknowns whose prior is worth more than the points, with its share of their variance."""
    shares = zip(found.names, found.from_start.tolist(), strict=True)
    return {name: share for name, share in shares if share > MOSTLY}


def _rank(run: CalibrationRun) -> Section:
    found, way = run.together, run.stepwise
    size = np.nan_to_num(np.abs(np.triu(found.correlation, 1)), posinf=0.0)
    pairs = zip(*np.unravel_index(np.argsort(size, axis=None)[::-1][:10], size.shape), strict=True)
    text = [f"Gauge: {found.gauge}."]
    text += [f"Not observable: {c}." for c in found.open]
    text += [f"Weak, but solved for: {c}." for c in found.weak]
    if resting := rests_on_launch(found):
        shares = ", ".join(f"{name} ({100.0 * share:.0f}% of its variance)" for name, share in resting.items())
        text.append(f"Determined by the prior on the launch, not by the points: {shares}.")
    text.append(
        f"The stepwise solution, bias and interior in turn, {'converges' if way.converged else 'does not converge'} "
        f"for {run.campaign.spec.schemes[0][0]} in {way.rounds} rounds to steps of {STEPWISE_TOLERANCE:g} sigma; a "
        f"round leaves {way.rate:.4f} of the slowest error. The simultaneous adjustment of all fields takes "
        f"{found.iterations} steps."
    )
    table = Table(
        "correlations",
        "Largest correlations",
        "Of the simultaneous adjustment; all of them are in calibration.json.",
        ("unknown", "unknown", "correlation"),
        [(found.names[int(i)], found.names[int(j)], float(found.correlation[i, j])) for i, j in pairs],
        (None, None, 4),
    )
    caption = "Of the simultaneous adjustment, held unknowns left out."
    return Section("Observability", tuple(text), (table, _figure(run, "correlation-matrix", "Correlations", caption)))


def _data(run: CalibrationRun) -> Section:
    rows: Rows = []
    for name, result in run.fields.items():
        sizes = ((result.orbit, 1.0), (result.attitude, ARCSEC))
        cells = [[None] * 3 if one is None else (one.rms / unit).tolist() for one, unit in sizes]
        rows.append((name, *cells[0], *cells[1]))
    table = Table(
        "third-differences",
        "RMS of third differences",
        "Measured positions in the Earth-fixed frame, metres; measured attitude against the orbital frame, arcseconds. "
        "White noise of one sigma gives the square root of 20. Biases and drifts do not show.",
        ("field", "x", "y", "z", "roll", "pitch", "yaw"),
        rows,
        (None, 4, 4, 4, 4, 4, 4),
    )
    return Section("Orbit and attitude data", (), (table,))
