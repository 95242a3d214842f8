"""What an in-orbit calibration gives: calibration.json, the main table, the report."""

from __future__ import annotations

from typing import TYPE_CHECKING

from optics.backend import Backend
from scenes.units import ANGLE, LENGTH, format_quantity
from twin.artefact import Cell, Table
from twin.orbit.calibration_analysis import CalibrationRun, run_calibration_passes
from twin.orbit.calibration_json import meets, to_dict
from twin.orbit.calibration_sections import said, sections, values_of
from twin.trial.result import Advance, LabResult

if TYPE_CHECKING:
    from scenes.orbit_setup import CalibrationSetup


def run_calibration(setup: CalibrationSetup, backend: Backend, seed: int, advance: Advance) -> LabResult:
    """Simulate the passes and put the result together; nothing is traced, so that the backend is not used."""
    return calibration_result(run_calibration_passes(setup, seed, advance), setup, seed)


def calibration_result(run: CalibrationRun, setup: CalibrationSetup, seed: int) -> LabResult:
    """Numbers, table and report of a calibration."""
    plan, height = (values_of(run.before, what).mean() for what in ("plan_rms", "height_rms"))
    limits = setup.test.limits
    good = [k for k, errors in run.schemes.items() if meets(errors, limits.plan, limits.height)]
    verdict = f"schemes {', '.join(good)}" if good else "no scheme"
    lead = (
        f"Before calibration {plan:.0f} m in plan and {height:.0f} m in height, mean of the fields' RMS. "
        + said(run.finding),
        f"{limits.plan:g} m in plan and {limits.height:g} m in height, assumed for 1:50 000, are met in every field by "
        f"{verdict}.",
    )
    return LabResult(
        "calibration",
        "Calibration in orbit over test fields",
        lead,
        _facts(setup),
        to_dict(run, seed),
        _summary(run),
        sections(run),
        warnings=_warnings(run),
    )


def _summary(run: CalibrationRun) -> Table:
    limits = run.campaign.spec.limits
    rows: list[tuple[Cell, ...]] = []
    names = [f"{k + 1}: {', '.join(s)}" for k, s in enumerate(run.campaign.spec.schemes)]
    names = ["laboratory", *names, f"{len(names) + 1}: each field its own"]
    for name, errors in zip(names, (run.before, *run.schemes.values()), strict=True):
        plan, height = (values_of(errors, what) for what in ("plan_rms", "height_rms"))
        numbers = (plan.mean(), plan.std(), plan.max(), height.mean(), height.std(), height.max())
        said_so = "yes" if meets(errors, limits.plan, limits.height) else "no"
        rows.append((name, *(float(v) for v in numbers), said_so))
    return Table(
        "schemes",
        "Schemes of parameters, tested on all fields without ground control",
        "RMS at check points, metres: mean, standard deviation and largest of the fields.",
        ("parameters", "plan, m", "spread", "largest", "height, m", "spread", "largest", "1:50 000"),
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
        ("Points", f"{test.points.control} control and {test.points.check} check points in each field"),
        ("Errors, σ of a coordinate", noise if errors.switched_on else "none but biases"),
        ("Image points", "drawn, not matched in images; without effects on the light, taken as corrected before"),
        ("Description", test.description),
    )


def _warnings(run: CalibrationRun) -> tuple[str, ...]:
    found = run.together
    if run.campaign.spec.errors.switched_on and found.p_value < 1e-3:
        return (
            f"the adjustment does not fit: a chi-square as large has a chance of {found.p_value:.1g}; biases may "
            "drift during a pass",
        )
    return ()
