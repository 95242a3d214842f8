"""Report of an in-orbit calibration: verdict, lead, facts and warnings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.arrays import ARCSEC
from scenes.specs.orbit.setup import MeasuredCalibrationSetup
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.framework.artefact import decimals_for
from twin.framework.report import Report, answer
from twin.orbit.calibration import calibration_sections
from twin.orbit.calibration.calibration_numbers import CALIBRATION
from twin.orbit.calibration.calibration_run import CalibrationRun, unit
from twin.orbit.calibration.campaign import any_effect, light_effects
from twin.orbit.calibration.campaign_adjustment import intersection_fit
from twin.orbit.calibration.influences import UNEXPECTED_SIGMAS, drift_warnings, step_warnings
from twin.orbit.calibration.schemes import meets, values_of
from twin.orbit.images.simulate_report import changes_text
from twin.orbit.measured.pass_measurements import duplicates, listed

if TYPE_CHECKING:
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
        f"Calibration makes the errors at check points {how}: from {plan:.{before}f} m in plan and "
        f"{height:.{before}f} m in height to {after[0]:.2f} m and {after[1]:.2f} m "
        f"(scheme {scheme}, mean of the fields' RMS)",
        f"{('schemes ' if len(good) > 1 else 'scheme ') + ', '.join(good) if good else 'no scheme'} "
        f"{'meet' if len(good) > 1 else 'meets'} the limits of {limits.plan:g} m in plan and {limits.height:g} m in "
        f"height, assumed for 1:50 000, in every field{without}: see the table of schemes",
    )
    lead = (
        *more,
        calibration_sections.scheme_summary(run.scheme_means),
        *(() if run.monitoring is None else (calibration_sections.monitor_gain(run),)),
        *(() if run.strips is None else (calibration_sections.strip_gain(run),)),
    )
    return Report(
        "Calibration in orbit over test fields",
        verdict,
        lead,
        _measured_facts(setup, run) if isinstance(setup, MeasuredCalibrationSetup) else _facts(setup),
        calibration_sections.summary(run),
        calibration_sections.sections(run, CALIBRATION(run)),
        warnings=_warnings(run),
        unmet=not good,
    )


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
    if not any_effect(light_effects(effects)):
        return "none"
    on = [name.replace("_", " ") for name in ("light_time", "aberration", "refraction") if getattr(effects, name)]
    return f"{', '.join(on)}; {'corrected' if effects.corrected else 'not corrected'} in the image points"


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
    if resting := calibration_sections.prior_dominated(adjustment):
        assumptions.append(
            f"{', '.join(resting)}: determined by the priors launch.bias and launch.interior, not by the points; the "
            "sigmas are only as good as these priors. More points, or a longer and wider field, would determine them"
        )
    if any_effect(run.campaign.effects) and not spec.effects.corrected:
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
        direction = conventions.quaternion.turns.replace("_", " ")
        quaternion = f"scalar {conventions.quaternion.scalar}, {direction}, body {', '.join(conventions.body_axes)}"
    paths = {flight.measured.interpolation for flight in run.campaign.passes}
    joined = {"spline": "cubic splines", "lagrange": "Lagrange polynomials of ten readings"}
    light = "none" if not any_effect(run.campaign.effects) else f"{'' if test.effects.corrected else 'not '}corrected"
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
