"""Report of an in-orbit calibration: lead, the main table, facts."""

from __future__ import annotations

from typing import TYPE_CHECKING

from analysis.units import ARCSEC
from scenes.specs.measured.orbit_data_setup import MeasuredCalibrationSetup
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.orbit.calibration.calibration_run import CalibrationRun, unit
from twin.orbit.calibration.calibration_sections import (
    monitor_gain,
    rests_on_launch,
    scheme_names,
    scheme_summary,
    sections,
    strip_gain,
)
from twin.orbit.calibration.influences import SURPRISE, drift_warnings, step_warnings
from twin.orbit.calibration.measured_sections import measured_facts, measured_warnings
from twin.orbit.calibration.observations import any_effect, light_effects
from twin.orbit.calibration.schemes import meets, values_of
from twin.run.artefact import Cell, Table
from twin.run.report import Report, one_sentence

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import CalibrationSetup


def calibration_report(run: CalibrationRun) -> Report:
    """Report of a calibration."""
    setup = run.setup
    plan, height = (values_of(run.before, what).mean() for what in ("plan_rms", "height_rms"))
    limits = setup.test.limits
    good = run.within_limits
    # of averaged parameters the scheme with most fields; the last one lets each field use its own
    scheme = list(run.schemes)[-2:][0]
    after = [values_of(run.schemes[scheme], what).mean() for what in ("plan_rms", "height_rms")]
    verdict = one_sentence(
        f"Calibration takes the errors from {plan:.0f} m in plan and {height:.0f} m in height to {after[0]:.2f} m and "
        f"{after[1]:.2f} m (scheme {scheme}, mean of the fields' RMS)",
        f"{limits.plan:g} m in plan and {limits.height:g} m in height, assumed for 1:50 000, are met in every field by "
        f"{'schemes ' + ', '.join(good) if good else 'no scheme'}: see the schemes",
    )
    lead = (
        scheme_summary(run.scheme_means),
        *(() if run.monitoring is None else (monitor_gain(run.monitoring),)),
        *(() if run.strips is None else (strip_gain(run.schemes, run.strips),)),
    )
    return Report(
        "Calibration in orbit over test fields",
        verdict,
        lead,
        measured_facts(setup, run) if isinstance(setup, MeasuredCalibrationSetup) else _facts(setup),
        _summary(run),
        sections(run),
        warnings=_warnings(run),
    )


def _summary(run: CalibrationRun) -> Table:
    limits = run.campaign.spec.limits
    rows: list[tuple[Cell, ...]] = []
    for name, errors in zip(["laboratory", *scheme_names(run)], (run.before, *run.schemes.values()), strict=True):
        plan, height = (values_of(errors, what) for what in ("plan_rms", "height_rms"))
        numbers = (plan.mean(), plan.std(), plan.max(), height.mean(), height.std(), height.max())
        meets_limits = "yes" if meets(errors, limits) else "no"
        rows.append((name, *(float(v) for v in numbers), meets_limits))
    return Table(
        "schemes",
        "Schemes of parameters, tested on all fields without ground control",
        "RMS at check points, metres: mean, standard deviation and largest of the fields.",
        ("parameters", "plan [m]", "spread", "largest", "height [m]", "spread", "largest", "1:50 000"),
        rows,
        (None, 2, 2, 2, 2, 2, 2, None),
    )


def _facts(setup: CalibrationSetup) -> tuple[tuple[str, str], ...]:
    test, camera, errors = setup.test, setup.camera, setup.test.errors
    changes = "; ".join(
        f"{name} f {format_quantity(c.focal_length, LENGTH)}, "
        f"x {format_quantity(c.principal_point[0], LENGTH)}, y {format_quantity(c.principal_point[1], LENGTH)}"
        for name, c in test.changes.items()
    )
    bias = ", ".join(format_quantity(v, ANGLE) for v in errors.star_tracker.bias)
    noise = f"image {errors.image:g} px, control {format_quantity(errors.control, LENGTH)}"
    return (
        ("Camera", f"{camera.name}, {camera.description}"),
        ("Changed since the laboratory", changes or "nothing"),
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
    found, spec, assumptions = run.together, run.campaign.spec, []
    drifts = run.truth is not None and bool(run.campaign.simulated.drift)
    if spec.errors.switched_on and found.p_value < 1e-3:
        assumptions.append(
            f"the adjustment does not fit: a chi-square as large has a chance of {found.p_value:.1g}; biases may "
            f"drift during a pass{', and the cameras drift from field to field' * drifts}"
        )
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
    if resting := rests_on_launch(found):
        assumptions.append(
            f"{', '.join(resting)}: known from launch.bias and launch.interior, not from the points; these sigmas are "
            "as good as that statement. More points, or a longer and wider field, would tell them"
        )
    if any_effect(run.campaign.effects) and not spec.effects.corrected:
        assumptions.append(
            "light time, aberration and refraction are left in the image points and go into the parameters"
        )
    if run.truth is None:
        assumptions += measured_warnings(run)
    return tuple(assumptions)
