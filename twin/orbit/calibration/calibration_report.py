"""Report of an in-orbit calibration: lead, the main table, facts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.arrays import ARCSEC
from scenes.specs.orbit.setup import MeasuredCalibrationSetup
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.framework.report import Report, answer
from twin.orbit.calibration import calibration_sections
from twin.orbit.calibration.calibration_numbers import CALIBRATION
from twin.orbit.calibration.calibration_run import CalibrationRun, unit
from twin.orbit.calibration.campaign import any_effect, light_effects
from twin.orbit.calibration.influences import SURPRISE, drift_warnings, step_warnings
from twin.orbit.calibration.schemes import values_of
from twin.orbit.calibration.screening import meeting_of
from twin.orbit.images.simulate_report import changes_text
from twin.orbit.measured.pass_measurements import duplicates, listed

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import CalibrationSetup

_FEW = 30
"""Image points of which a chance is hardly worth a warning."""
_LEAST_CHANCE = 1e-3
_WIDE = 2.0
"""Factor on the sigmas of a line beyond which there is a warning."""
_MANY = 0.1
"""Share of image points that may be left out without a warning."""


def calibration_report(run: CalibrationRun) -> Report:
    """Report of a calibration."""
    setup = run.setup
    plan, height = (values_of(run.before, what).mean() for what in ("plan_rms", "height_rms"))
    limits = setup.test.limits
    good = run.within_limits
    # of averaged parameters the scheme with most fields; the last one lets each field use its own
    scheme = list(run.schemes)[-2:][0]
    after = [values_of(run.schemes[scheme], what).mean() for what in ("plan_rms", "height_rms")]
    verdict, more = answer(
        f"Calibration changes the errors from {plan:.0f} m in plan and {height:.0f} m in height to {after[0]:.2f} m "
        f"and {after[1]:.2f} m (scheme {scheme}, mean of the fields' RMS)",
        f"{('schemes ' if len(good) > 1 else 'scheme ') + ', '.join(good) if good else 'no scheme'} "
        f"{'meet' if len(good) > 1 else 'meets'} the limits of {limits.plan:g} m in plan and {limits.height:g} m in "
        "height, assumed for 1:50 000, in every field: see the schemes",
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
        ("Errors, σ of a coordinate", noise if errors.switched_on else "none but biases"),
        ("Image points", "drawn, not matched in images" if test.images is None else "matched in rendered images"),
        ("Effects on the light", _light(setup)),
        ("Description", test.description),
    )


def _points(setup: CalibrationSetup) -> str:
    points, images = setup.test.points, setup.test.images
    if images is None:
        assert points is not None
        return f"{points.control} control and {points.check} check points in each field"
    some = images.points
    return (
        f"{some.control} control, {some.check} check and {some.tie} tie points sought in each of "
        f"{len(images.patches)} patches of {images.lines} x {images.pixels} pixels in each field"
    )


def _light(setup: CalibrationSetup) -> str:
    effects = setup.test.effects
    if not any_effect(light_effects(effects)):
        return "none"
    on = [name.replace("_", " ") for name in ("light_time", "aberration", "refraction") if getattr(effects, name)]
    return f"{', '.join(on)}; {'taken out of' if effects.corrected else 'left in'} the image points"


def _warnings(run: CalibrationRun) -> tuple[str, ...]:
    found, spec, assumptions = run.together, run.campaign.spec, list(CALIBRATION.warnings(run))
    if run.surprises:
        first = run.surprises[0]
        scale, shown = (ARCSEC, "arcsec") if unit(first.name) == "rad" else (1e-6, "µm")
        if "offset" in first.name:
            scale, shown = 1.0, "m"
        others = len(run.surprises) - 1
        more = f", and {others} other{'s' * (others > 1)} beyond {SURPRISE:g}" if others else ""
        assumptions.append(
            f"{first.name} has changed by {first.change / scale:.3g} {shown}, {first.ratio:.1f} times what is "
            f"expected (launch, errors.gps.drift){more}: check the datum of the control points, the camera file and "
            "the times, for the fit need not show such an error"
        )
    assumptions += drift_warnings(run.campaign, run.drift)
    assumptions += step_warnings(run.chip_steps)
    if resting := calibration_sections.rests_on_launch(found):
        assumptions.append(
            f"{', '.join(resting)}: known from launch.bias and launch.interior, not from the points; these sigmas are "
            "as good as that statement. More points, or a longer and wider field, would tell them"
        )
    if any_effect(run.campaign.effects) and not spec.effects.corrected:
        assumptions.append(
            "light time, aberration and refraction are left in the image points and go into the parameters"
        )
    if run.truth is None:
        assumptions += _measured_warnings(run)
    return tuple(assumptions)


def _measured_facts(setup: MeasuredCalibrationSetup, run: CalibrationRun) -> tuple[tuple[str, str], ...]:
    """What was given."""
    test, said = setup.test, setup.data.conventions
    errors, gps = test.errors.star_tracker, test.errors.gps
    angles = ", ".join(format_quantity(v, ANGLE) for v in errors.noise)
    lengths = ", ".join(format_quantity(v, LENGTH) for v in gps.noise)
    quaternion = "as the files of the platform say"
    if said.quaternion is not None and said.body_axes is not None:
        turns = said.quaternion.turns.replace("_", " ")
        quaternion = f"scalar {said.quaternion.scalar}, {turns}, body {', '.join(said.body_axes)}"
    paths = {one.measured.interpolation for one in run.campaign.passes}
    joined = {"spline": "cubic spline", "lagrange": "Lagrange's polynomial of ten readings"}
    light = "none" if not any_effect(run.campaign.effects) else "taken out" if test.effects.corrected else "left in"
    held = " and ".join(run.together.gauge.held)
    return (
        ("Camera", f"{setup.camera.name}, {setup.camera.description}"),
        ("Passes", f"{len(run.campaign.passes)}, measured, over {', '.join(p.name for p in run.campaign.passes)}"),
        ("Line cameras", ", ".join(run.campaign.lines)),
        (
            "Frame and time",
            f"{said.frame}; epochs in {said.time_scale.upper()}; a line's time is the {said.line_moment}",
        ),
        ("Quaternions", quaternion),
        (
            "Pixels",
            f"middle of pixel n at {'n' if said.centre == 'integer' else 'n + 0.5'}, the first is {said.first_pixel}",
        ),
        ("First pixel sees", f"the {said.first_pixel_sees} side of the track"),
        ("Noise of the attitude, 1σ", f"[{angles}], slow {max(errors.slow.noise) / ARCSEC:.3g} arcsec"),
        ("Noise of the orbit, 1σ", f"[{lengths}], joined by {' and '.join(joined[p] for p in sorted(paths))}"),
        ("Effects on the light", light),
        ("Held", held),
        ("Not estimated", "distortion, mounting, what the camera's file says of single CCDs"),
        ("Description", test.description),
    )


def _measured_warnings(run: CalibrationRun) -> list[str]:
    """What speaks against the result."""
    found = []
    for name, gone in run.campaign.rejected.items():
        lost = gone.entered - gone.left
        if gone.points or gone.check_points:
            names = [*(f"{point} in {line}" for point, line in gone.points), *gone.check_points]
            found.append(f"{name}: left out as gross errors: {listed(names)}")
        if lost > _MANY * gone.entered:
            found.append(
                f"{name}: {lost} of {gone.entered} image points were left out, more than {100.0 * _MANY:.0f}%: are the "
                "conventions right, and the points matched well?"
            )
        wide = {line: factor for line, factor in gone.factors.items() if factor > _WIDE}
        if wide:
            factors = ", ".join(f"{line} {factor:.1f}" for line, factor in wide.items())
            found.append(
                f"{name}: image points scatter more than their sigmas predict, by factors of {factors}; their sigmas "
                "were multiplied by these factors"
            )
    for one in run.campaign.passes:
        places = np.concatenate([one.control_ground, one.check_ground])
        if twice := duplicates(np.concatenate([one.control_ids, one.check_ids]), places):
            found.append(f"{one.name}: {twice}")
        meeting = meeting_of(run.campaign, one, run.fields[one.name].adjustment)
        if meeting.degrees_of_freedom >= _FEW and meeting.p_value < _LEAST_CHANCE:
            found.append(
                f"{one.name}: rays of the check points do not meet within their sigmas (chance {meeting.p_value:.1g}): "
                "sigmas of image points or of the attitude are too small, or it has slow errors"
            )
    return found
