"""Report of an in-orbit calibration: verdict, lead, facts, warnings, and errors by scheme of averaged parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from scenes.specs.orbit.setup import MeasuredCalibrationSetup
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.framework import svg
from twin.framework.artefact import PngFigure, Table, decimals_for
from twin.framework.report import Report, Section, answer
from twin.orbit.calibration.calibration_numbers import (
    CALIBRATION,
    DATUM_SIGMA,
    ERRORS,
    MATCHING,
    MEASURED,
    SCREENED,
    TIES,
)
from twin.orbit.calibration.calibration_run import CalibrationRun, unit
from twin.orbit.calibration.calibration_sections import Rows, adjustment_sections, figure_of, prior_dominated
from twin.orbit.calibration.campaign_adjustment import intersection_fit
from twin.orbit.calibration.influences import UNEXPECTED_SIGMAS, drift_warnings, step_warnings
from twin.orbit.calibration.schemes import RMS, FieldErrors, SchemeMeans, meets, values_of
from twin.orbit.flight.sensor import LightEffects
from twin.orbit.images.image_points import UNMODELLED_SIGMA
from twin.orbit.images.patch import WRONG
from twin.orbit.images.simulate_report import SORTS, changes_text, points_png
from twin.orbit.measured.pass_measurements import duplicates, listed

if TYPE_CHECKING:
    from scenes.specs.orbit.calibration import CameraDriftSpec, MonitorReadingSpec
    from scenes.specs.orbit.setup import CalibrationSetup


_FEW = 30
"""Smallest number of degrees of freedom of the check points' intersections at which a small p-value raises a warning.
"""
_LEAST_P_VALUE = 1e-3
"""p-value of the chi-square of the check points' intersections below which there is a warning."""
_WIDE = 2.0
"""Ratio of the residuals of a line's image points to their sigmas above which there is a warning."""
_MANY = 0.1
"""Share of rejected image points above which there is a warning."""
COLOURS = (svg.BLUE, svg.ORANGE, svg.GREEN, svg.VERMILION, svg.PURPLE, svg.SKY, svg.GREY)
MARKERS = "osD^vP"


def calibration_report(run: CalibrationRun) -> Report:
    """Return the report of a calibration in orbit: errors by scheme, parameters, fields, biases and warnings."""
    setup = run.setup
    plan, height = (values_of(run.before, what).mean() for what in ("plan_rms", "height_rms"))
    limits = setup.test.limits
    good = run.within_limits
    # the scheme that averages most fields; in the last one each field uses its own parameters
    scheme = list(run.schemes)[-2:][0]
    after = [values_of(run.schemes[scheme], what).mean() for what in ("plan_rms", "height_rms")]
    worse = [what for what, was, now in zip(("plan", "height"), (plan, height), after, strict=True) if now > was]
    how = f"larger in {' and '.join(worse)}" if worse else "smaller"
    before = decimals_for(min(plan, height), 3)
    without = "" if not (worse and meets(run.before, limits)) else ", as the laboratory's parameters alone do"
    verdict, more = answer(
        f"Calibration makes the errors at check points {how}: from {plan:.{before}f} m in plan and {height:.{before}f} "
        f"m in height to {after[0]:.2f} m and {after[1]:.2f} m (scheme {scheme}, mean of the fields' RMS)",
        f"{('schemes ' if len(good) > 1 else 'scheme ') + ', '.join(good) if good else 'no scheme'} "
        f"{'meet' if len(good) > 1 else 'meets'} the limits of {limits.plan:g} m in plan and {limits.height:g} m in "
        f"height, assumed for 1:50 000, in every field{without}: see the table of schemes",
    )
    lead = (
        *more,
        scheme_summary(run.scheme_means),
        *(() if run.monitoring is None else (monitor_gain(run),)),
        *(() if run.strips is None else (strip_gain(run),)),
    )
    return Report(
        "Calibration in orbit over test fields",
        verdict,
        lead,
        _measured_facts(setup, run) if isinstance(setup, MeasuredCalibrationSetup) else _facts(setup),
        summary(run),
        _sections(run, CALIBRATION(run)),
        warnings=_warnings(run),
        unmet=not good,
    )


def _sections(run: CalibrationRun, data: Mapping[str, Any]) -> tuple[Section, ...]:
    candidates = (
        _schemes(run),
        _measured(run, data["measured"]) if run.truth is None else None,
        None if run.campaign.images is None else _images(run, data["images"]),
        None if run.monitoring is None else _monitoring(run, data["monitoring"]),
        None if run.strips is None else _strips(run, data["strips"]),
    )
    return *(section for section in candidates if section is not None), *adjustment_sections(run, data)


def _facts(setup: CalibrationSetup) -> tuple[tuple[str, str], ...]:
    test, camera, errors = setup.test, setup.camera, setup.test.errors
    bias = ", ".join(format_quantity(v, ANGLE) for v in errors.star_tracker.bias)
    noise = f"image {errors.image:g} px, control {format_quantity(errors.control, LENGTH)}"
    return (
        ("Camera", f"{camera.name}, {camera.description}"),
        ("Changed since the laboratory", changes_text(test.perturb)),
        ("Bias of the star trackers", f"[{bias}]"),
        ("Passes", f"descending, {test.altitude / 1e3:g} km, one over each of {len(test.fields)} fields"),
        ("Points", _points(setup)),
        ("Errors, σ of a coordinate", noise if errors.switched_on else "none except biases"),
        ("Image points", "simulated, not matched in images" if test.images is None else "matched in rendered images"),
        ("Effects on the light", _light(setup)),
        ("Description", test.description),
    )


def _points(setup: CalibrationSetup) -> str:
    points, images = setup.test.points, setup.test.images
    if images is None:
        assert points is not None
        return f"{points.control} control and {points.check} check points in each field"
    wanted = images.points
    return (
        f"{wanted.control} control, {wanted.check} check and {wanted.tie} tie points sought in each of "
        f"{len(images.patches)} patches of {images.lines} x {images.pixels} pixels in each field"
    )


def _light(setup: CalibrationSetup) -> str:
    effects = setup.test.effects
    on = LightEffects.of(effects).names
    return (
        f"{', '.join(on)}; {'corrected' if effects.corrected else 'not corrected'} in the image points"
        if on
        else "none"
    )


def _warnings(run: CalibrationRun) -> tuple[str, ...]:
    adjustment, spec, assumptions = run.together, run.campaign.spec, list(CALIBRATION.warnings(run))
    if run.unexpected_changes:
        first = run.unexpected_changes[0]
        scale, shown = (ARCSEC, "arcsec") if unit(first.name) == "rad" else (1e-6, "µm")
        if "offset" in first.name:
            scale, shown = 1.0, "m"
        others = len(run.unexpected_changes) - 1
        more = f", and {others} more by over {UNEXPECTED_SIGMAS:g} times" if others else ""
        assumptions.append(
            f"{first.name} has changed by {first.change / scale:.3g} {shown}, {first.ratio:.1f} times its expected "
            f"sigma (launch, errors.gps.drift){more}: check the datum of the control points, the camera file and "
            "the times; the residuals need not show such an error"
        )
    assumptions += drift_warnings(run.campaign, run.drift)
    assumptions += step_warnings(run.chip_steps)
    if resting := prior_dominated(adjustment):
        assumptions.append(
            f"{', '.join(resting)}: determined by the priors launch.bias and launch.interior, not by the points; the "
            "sigmas are only as good as these priors. More points, or a longer and wider field, would determine them"
        )
    if run.campaign.effects.names and not spec.effects.corrected:
        assumptions.append(
            "light time, aberration and refraction are left in the image points; the parameters absorb them"
        )
    if run.truth is None:
        assumptions += _measured_warnings(run)
    return tuple(assumptions)


def _measured_facts(setup: MeasuredCalibrationSetup, run: CalibrationRun) -> tuple[tuple[str, str], ...]:
    """Return names and values of the table of input quantities of a calibration on measurements."""
    test, conventions = setup.test, setup.data.conventions
    errors, gps = test.errors.star_tracker, test.errors.gps
    angles = ", ".join(format_quantity(v, ANGLE) for v in errors.noise)
    lengths = ", ".join(format_quantity(v, LENGTH) for v in gps.noise)
    quaternion = "as declared in the platform's files"
    if conventions.quaternion is not None and conventions.body_axes is not None:
        direction = conventions.quaternion.direction.replace("_", " ")
        quaternion = f"scalar {conventions.quaternion.scalar}, {direction}, body {', '.join(conventions.body_axes)}"
    paths = {flight.measured.interpolation for flight in run.campaign.passes}
    joined = {"spline": "cubic splines", "lagrange": "Lagrange polynomials of ten readings"}
    light = "none" if not run.campaign.effects.names else f"{'' if test.effects.corrected else 'not '}corrected"
    held = " and ".join(run.together.gauge.held)
    return (
        ("Camera", f"{setup.camera.name}, {setup.camera.description}"),
        ("Passes", f"{len(run.campaign.passes)}, measured, over {', '.join(p.name for p in run.campaign.passes)}"),
        ("Line cameras", ", ".join(run.campaign.lines)),
        (
            "Frame and time",
            f"{conventions.frame}; epochs in {conventions.time_scale.upper()}; a line's time is the "
            f"{conventions.line_moment}",
        ),
        ("Quaternions", quaternion),
        (
            "Pixels",
            f"middle of pixel n at {'n' if conventions.centre == 'integer' else 'n + 0.5'}, the first is "
            f"{conventions.first_pixel}",
        ),
        ("First pixel sees", f"the {conventions.first_pixel_sees} side of the track"),
        ("Noise of the attitude, 1σ", f"[{angles}], slow {max(errors.slow.noise) / ARCSEC:.3g} arcsec"),
        ("Noise of the orbit, 1σ", f"[{lengths}], interpolated by {' and '.join(joined[p] for p in sorted(paths))}"),
        ("Effects on the light", light),
        ("Held (gauge)", held),
        ("Not estimated", "distortion, mounting, positions of single CCDs in the camera's file"),
        ("Description", test.description),
    )


def _measured_warnings(run: CalibrationRun) -> list[str]:
    """Return the warnings of a calibration on measurements: rejections, residuals, duplicates, poor intersections."""
    warnings = []
    for name, rejected in run.campaign.rejected.items():
        lost = rejected.entered - rejected.left
        if rejected.points or rejected.check_points:
            names = [*(f"{point} in {line}" for point, line in rejected.points), *rejected.check_points]
            warnings.append(f"{name}: rejected as gross errors: {listed(names)}")
        if lost > _MANY * rejected.entered:
            warnings.append(
                f"{name}: {lost} of {rejected.entered} image points were rejected, more than {100.0 * _MANY:.0f}%: "
                "check the conventions and the matching of the points"
            )
        wide = {line: factor for line, factor in rejected.factors.items() if factor > _WIDE}
        if wide:
            factors = ", ".join(f"{line} {factor:.1f}" for line, factor in wide.items())
            warnings.append(
                f"{name}: image points scatter more than their sigmas predict, by factors of {factors}; their sigmas "
                "were multiplied by these factors"
            )
    for flight in run.campaign.passes:
        positions = np.concatenate([flight.control_ground, flight.check_ground])
        if twice := duplicates(np.concatenate([flight.control_ids, flight.check_ids]), positions):
            warnings.append(f"{flight.name}: {twice}")
        fit = intersection_fit(run.campaign, flight, run.fields[flight.name].adjustment)
        if fit.degrees_of_freedom >= _FEW and fit.p_value < _LEAST_P_VALUE:
            warnings.append(
                f"{flight.name}: rays of the check points do not intersect within their sigmas (p = "
                f"{fit.p_value:.1g}): the sigmas of image points or attitude are too small, or the attitude has slow "
                "errors"
            )
    return warnings


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
        figure_of(
            run, _schemes_figure, "schemes-of-fields", "Schemes", "RMS errors at check points; each line is a field."
        ),
        figure_of(run, _check_figure, "check-points", title, check),
    )
    return Section("Schemes of averaged parameters", text, (figures[0], *tables, figures[1]))


def _measured(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    campaign = run.campaign
    points = {
        name: row | {key: len(row[key]) for key in ("rejected", "rejected_check_points")} for name, row in data.items()
    }
    points_of = ("control_points", "tie_points", "check_points", "rejected", "rejected_check_points")
    sizes: Rows = []
    for flight in campaign.passes:
        errors, factors = list(run.schemes.values())[-1][flight.name], data[flight.name]["sigma_factor"] or {}
        for line, (along, across) in data[flight.name]["gsd_m"].items():
            both = (v / float(np.sqrt(along * across)) for v in (errors.plan_rms, errors.height_rms))
            sizes.append((flight.name, line, along, across, *both, factors.get(line)))
    tables = (
        MEASURED.table(
            "measured-points",
            "Points of every pass",
            "Rejected: image points by robust weights, and check points whose rays do not intersect. Chi-square and "
            "its degrees of freedom: of these rays with the parameters of the pass adjusted by itself.",
            points,
            (*points_of, "check_chi_square", "check_degrees_of_freedom"),
            "pass",
        ),
        Table(
            "measured-pixels",
            "Ground sample distance, and errors of check points in ground pixels",
            "Ground sample distance of the middle of each line, metres; RMS errors of the check points with the pass's "
            "own parameters, in ground pixels (geometric mean of along and across). Factor: applied to the given "
            "sigmas of image points, from the remaining residuals.",
            ("pass", "line", "along the track [m]", "across [m]", "plan [px]", "height [px]", "factor"),
            sizes,
            (None, None, 3, 3, 2, 2, 2),
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
        f"Error budget on the ground at nadir (1σ) of a single ray to a single point of {flight.name}: {texts}. The "
        "largest of these errors limits the accuracy. More points reduce all of them but slow errors of the attitude."
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
    counts = ("wrong_measured", "measured", "wrong_matched", "matched", "wrong_accepted", "accepted")
    keys = (*counts, "right_rejected_by_consensus", "rms_lines_px", "rms_pixels_px", "chi_square_ratio")
    matching = MATCHING.table("image-matching", "Matching", caption, judgements, keys, "field, points, line", digits=4)
    remaining = " and ".join(str(int(p.control.control.sum())) for p in campaign.passes)
    text = (
        f"In each field {len(spec.patches)} patches of {spec.lines} x {spec.pixels} pixels are rendered by every line. "
        f"Of {total['measured']} measured positions, {total['wrong_measured']} are wrong, mostly on parcels that look "
        f"different in the orthophoto; {total['wrong_accepted']} of {total['accepted']} pass the thresholds of "
        f"matching and the test of the neighbours, {total['wrong_left']} of {total['left']} image points and "
        f"{total['wrong_check_left']} of {total['check_left']} check points the adjustment, which rejects "
        f"{total['right_rejected_by_adjustment']} correct positions. {remaining} control points remain. Their image "
        f"points are weighted by the covariances of the matching, with {UNMODELLED_SIGMA:g} px added for errors that "
        "the fit does not show.",
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
    scheme = list(run.schemes)[-2]
    without, monitored = (t.schemes[scheme].height_rms for t in (run.monitoring.without, run.monitoring.monitored))
    return (
        f"With cameras that drift from field to field, the height error without ground control (scheme {scheme}) is "
        f"{without:.2f} m RMS; with the on-board monitor's readings, {monitored:.2f} m."
    )


def _monitoring(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    monitoring, spec = run.monitoring, run.campaign.simulated
    assert monitoring is not None
    assert spec.monitor is not None

    def sizes(of: CameraDriftSpec | MonitorReadingSpec) -> str:
        angles = ", ".join(format_quantity(v, ANGLE) for v in of.angles)
        return f"{angles}, Δf {format_quantity(of.principal_distance, LENGTH)}"

    drifts = "; ".join(f"{name} {sizes(drift)}" for name, drift in spec.drift.items())
    text = (
        f"Each line camera differs in every field from its reference state, 1σ of Δα, Δβ, Δγ: {drifts}. The monitor "
        f"reads each camera in each pass with {sizes(spec.monitor)}, 1σ. All fields at once fit with "
        f"p = {monitoring.without.p_value:.3f}, with the readings {monitoring.monitored.p_value:.3f}; the noise of "
        "attitude and orbit is treated as independent, which brings both too near to 1.",
    )
    cases = {"without": data["without_monitor"], "with": data["with_monitor"]}
    rows = {f"all at once, {case}": errors["all_fields"] for case, errors in cases.items()}
    for scheme in monitoring.without.schemes:
        rows |= {f"scheme {scheme}, {case}": errors["schemes"][scheme] for case, errors in cases.items()}
    table = ERRORS.table(
        "monitor-schemes",
        "Errors without and with the monitor's readings",
        "RMS at check points of all fields: all fields adjusted at once, each with its own bias, and schemes without "
        "ground control, the last of which lets each field use its own parameters.",
        rows,
        label="adjustment",
    )
    return Section("Cameras that drift, and the on-board monitor", text, (table,))


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


def _strips(run: CalibrationRun, data: Mapping[str, Any]) -> Section:
    table = TIES.flat().table(
        "strips",
        "Check points with and without tie points",
        "RMS at check points of all fields without ground control. Without ties: calibrated on control points, "
        "intersected with the measured attitude and orbit. With ties: calibrated on control and tie points, "
        "intersected with the adjusted attitude and orbit. In the last scheme each field uses its own parameters.",
        data["schemes"],
        label="scheme",
    )
    common = DATUM_SIGMA.table(
        "strip-datum",
        f"Rotations of a whole pass, {run.campaign.passes[0].name}",
        "Sigma from the readings' noise alone and with tie points; of rates, in a second. Equal sigmas mean that tie "
        "points do not determine the rotation.",
        data["datum"],
        ("sigma_before", "sigma_after"),
        "rotation",
        digits=4,
    )
    counts = ", ".join(f"{k} {n}" for k, n in data["ties"].items())
    text = (
        f"Every pass is adjusted on points that the lines see in common ({counts}), without ground coordinates. Check "
        "points, which are not among them, are then intersected with the adjusted attitude and orbit.",
    )
    return Section("Adjustment of the strips", text, (table, common))


def _schemes_figure(run: CalibrationRun) -> Figure:
    """Draw the RMS errors in plan and in height at every field's check points, by scheme."""
    figure = svg.new_figure(4.3)
    panels = figure.subplots(1, 2)
    names, spec = list(run.schemes), run.campaign.spec
    position = np.arange(len(names))
    labels = [
        f"{k}\n{len(s)} field{'s' * (len(s) > 1)}" for k, s in zip(names, run.campaign.spec.schemes, strict=False)
    ]
    labels.append(f"{names[-1]}\neach its own")
    for axes, what, title, limit in zip(
        panels, RMS, ("plan", "height"), (spec.limits.plan, spec.limits.height), strict=True
    ):
        table = np.array([values_of(errors, what) for errors in run.schemes.values()])
        for k, field in enumerate(run.before):
            style = MARKERS[k // len(COLOURS) % len(MARKERS)]
            colour = COLOURS[k % len(COLOURS)]
            axes.plot(position, table[:, k], f"{style}-", color=colour, lw=0.9, ms=4, label=field)
        axes.plot(position, table.mean(axis=1), "-", color=svg.INK, lw=2.2, label="mean of the fields")
        before = values_of(run.before, what)
        low, high = before.min(), before.max()
        axes.set_ylim(0.0, 1.35 * table.max())
        label = f"before calibration {low:.0f} to {high:.0f} m; limit for 1:50 000 {limit:g} m"
        axes.set(title=f"RMS in {title} [m]", xticks=position, xlabel="scheme")
        axes.text(0.5, 0.97, label, transform=axes.transAxes, ha="center", va="top", color=svg.GREY, fontsize=8.5)
        if limit < 1.35 * table.max():
            axes.axhline(limit, color=svg.GREY, lw=0.9, ls="--")
        axes.set_xticklabels(labels)
        svg.gridded(axes)
    svg.shared_legend(figure, panels[0], "lower center", 4)
    return figure


def _check_figure(run: CalibrationRun) -> Figure:
    """Draw the errors at the first field's check points before calibration and with the field's own parameters.

    Arrows show the error in plan, colours the error in height.
    """
    flight = run.campaign.passes[0]
    _, lat, _ = (float(v) for v in flight.data.earth.geodetic(flight.check_ground.mean(axis=0)))
    lon, latitude, _ = flight.data.earth.geodetic(flight.check_ground)
    east = (lon - lon.mean()) * 6.378e3 * np.cos(lat)
    north = (latitude - latitude.mean()) * 6.357e3
    figure = svg.new_figure(5.2)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    cases = (
        ("laboratory's camera", run.before[flight.name]),
        ("its own parameters", list(run.schemes.values())[-1][flight.name]),
    )
    for axes, (title, errors) in zip(panels, cases, strict=True):
        size = float(f"{np.sqrt(np.nanmean(np.sum(errors.error[:, :2] ** 2, axis=1))):.1g}")
        tall = errors.error[:, 2]
        middle = float(np.median(tall))
        extent = float(np.abs(tall - middle).max())
        arrows = axes.quiver(
            east,
            north,
            errors.error[:, 0],
            errors.error[:, 1],
            tall,
            cmap="viridis",
            clim=(middle - extent, middle + extent),
            width=0.004,
            scale=16.0 * size,
        )
        axes.quiverkey(arrows, 0.8, 0.04, size, f"{size:g} m in plan", labelpos="E", coordinates="axes", color=svg.INK)
        axes.set_title(f"{title}: plan {errors.plan_rms:.2f} m, height {errors.height_rms:.2f} m")
        axes.set(xlabel="east [km]")
        axes.set_aspect("equal")
        axes.margins(0.14)
        figure.colorbar(arrows, ax=axes, shrink=0.75, label="height error [m]", location="bottom")
        svg.gridded(axes)
    panels[0].set_ylabel("north [km]")
    return figure
