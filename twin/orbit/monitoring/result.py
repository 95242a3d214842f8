"""What monitoring along an orbit gives: monitor.json, the main table, the report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.units import ARCSEC
from optics.backend import Backend
from scenes.course import moment
from twin.artefact import Cell, Table
from twin.orbit.monitoring.procedure import MonitorRun, rms, run_monitored
from twin.orbit.monitoring.sections import sections
from twin.orbit.monitoring.to_json import to_dict
from twin.trial.result import Advance, LabResult

if TYPE_CHECKING:
    from scenes.orbit_setup import MonitorSetup


def run_monitor(setup: MonitorSetup, backend: Backend, seed: int, advance: Advance) -> LabResult:
    """Fly, monitor, intersect, and put the result together."""
    return monitor_result(run_monitored(setup, backend, seed, advance), setup, seed)


def monitor_result(run: MonitorRun, setup: MonitorSetup, seed: int) -> LabResult:
    """Numbers, table and report."""
    cases, spec = run.cases, setup.test
    none, chosen, floor = cases["none"], cases["interval"], cases["true"]
    lead = (
        f"The intersection angle changes by {np.ptp(run.angle_change) / ARCSEC:.2g}″ over the course. Without "
        f"monitoring heights are wrong by {none.height_rms:.2f} m RMS, monitored every {moment(spec.interval)} by "
        f"{chosen.height_rms:.2f} m, of which {floor.height_rms:.2f} m are left with the true cameras.",
        f"The cameras alone: {none.camera_height_rms:.2f} m without, {chosen.camera_height_rms:.2f} m with this "
        f"interval, {cases['monitored'].camera_height_rms:.2f} m monitored at every time. "
        f"One arcsecond of the angle is {abs(run.conversion.of_angle):.1f} m of height.",
    )
    return LabResult(
        "monitor",
        "What on-board monitoring buys on the ground",
        lead,
        _facts(setup),
        to_dict(run, seed),
        _table(run),
        sections(run),
        warnings=_warnings(run),
    )


def _table(run: MonitorRun) -> Table:
    spec = run.flight.spec
    names = {
        "none": "as calibrated, no monitoring",
        "interval": f"monitored every {moment(spec.interval)}",
        "monitored": "monitored at every time",
        "parameters": "true four parameters (bound)",
        "true": "true cameras (bound)",
    }
    rows: list[tuple[Cell, ...]] = []
    for key, name in names.items():
        case = run.cases[key]
        numbers = (case.height_rms, case.worst, case.camera_height_rms, case.plan_rms, rms(case.camera_plan))
        rows.append((name, *numbers))
    return Table(
        "cases",
        "Errors at check points over the course",
        "RMS of all points and times; worst: RMS of the worst time; by the cameras: without image, orbit and attitude.",
        ("cameras", "height, m", "worst, m", "height by the cameras, m", "plan, m", "plan by the cameras, m"),
        rows,
        (None, 3, 3, 4, 3, 4),
    )


def _facts(setup: MonitorSetup) -> tuple[tuple[str, str], ...]:
    test, errors = setup.test, setup.test.errors
    times = test.course.times
    span = f"{moment(times[0])} to {moment(times[-1])} in steps of {moment(test.step)}"
    on = errors.switched_on
    return (
        ("Instrument", f"{setup.instrument.name}, {setup.instrument.description}"),
        ("Pair", f"{setup.pair[0]} against {setup.pair[1]}"),
        ("Course", f"{span}, from {test.orbit.epoch}"),
        ("Reference", moment(test.reference)),
        ("Applied", ", ".join(test.apply)),
        ("Check points", f"{test.ground.points} at each time, both views from the state at that time"),
        ("Image points", f"σ {errors.image:g} px, drawn, not matched in images" if on else "exact"),
        ("Monitor's frames", "with noise" if on and errors.monitor else "without noise"),
        ("Calibration at the reference", "taken as exact"),
        ("Effects on the light", "taken as corrected"),
        ("Description", test.description),
    )


def _warnings(run: MonitorRun) -> tuple[str, ...]:
    out = []
    if not run.scatter.agrees:
        low, high = run.scatter.limits
        ratio = run.scatter.spread / run.scatter.sigma
        out.append(
            f"scatter and propagated sigma of the heights differ: ratio {ratio:.3g}, limits {low:.2f} to {high:.2f}"
        )
    if run.cases["monitored"].camera_height_rms > run.cases["none"].camera_height_rms:
        out.append("monitoring makes heights worse: the monitor's own errors are larger than the cameras' changes")
    return tuple(out)
