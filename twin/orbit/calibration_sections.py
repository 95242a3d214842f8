"""What a report says of an in-orbit calibration."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from analysis.orbit.forward_intersection import CheckErrors
from analysis.orbit.three_line_model import BIAS
from scenes.orbit_angle import LINES
from twin.artefact import Cell, Table
from twin.orbit.calibration_analysis import INNER, OFFSET, STEPWISE_TOLERANCE, CalibrationRun, Finding
from twin.orbit.calibration_json import unit
from twin.trial.section import Section

_ARCSEC = np.pi / 648000.0


def sections(run: CalibrationRun) -> tuple[Section, ...]:
    """Schemes, parameters, fields, what cannot be told apart, data."""
    return _schemes(run), _parameters(run), _fields(run), _rank(run), _data(run)


def _schemes(run: CalibrationRun) -> Section:
    names = list(run.before)
    tables = [
        Table(
            name,
            f"RMS in {name} at check points without ground control, metres",
            f"As Table {number} of the paper; its numbers are not in the text that is available.",
            ("parameters", *names, "mean", "spread"),
            [_row("laboratory", values_of(run.before, what)), *scheme_rows(run, what)],
            (None, *(2,) * (len(names) + 2)),
        )
        for name, number, what in (("plan", 6, "plan_rms"), ("height", 7, "height_rms"))
    ]
    spec = run.campaign.spec
    named = "; ".join(f"{k + 1}: {', '.join(scheme)}" for k, scheme in enumerate(spec.schemes))
    text = (
        "Every field is calibrated by itself (three attitude biases and nine elements of the interior orientation), "
        f"and each scheme uses the mean of the parameters of its fields: {named}; {len(spec.schemes) + 1}: each field "
        "its own. Check points are intersected from all three lines with these parameters and the measured orbit and "
        "attitude, without ground control.",
        said(run.finding),
        "What averaging changes are the biases of attitude, which differ from field to field and move all three lines "
        "alike: they act in plan. Heights depend on the difference between the outer lines, which the interior "
        "orientation holds and which hardly differs between fields; noise of the image and of the attitude makes the "
        "rest.",
        f"The limits for 1:50 000 are those of the file, {spec.limits.plan:g} m in plan and {spec.limits.height:g} m "
        "in height; they are assumed, the paper prints none.",
    )
    return Section("Schemes of averaged parameters", text, tuple(tables))


def said(finding: Finding) -> str:
    """Whether the paper's finding holds, with the numbers."""
    plan, spread, height = finding.plan, finding.plan_spread, finding.height
    first = (
        f"The mean RMS in plan goes from {plan[0]:.2f} m with the first scheme to {plan[-1]:.2f} m with the last of "
        f"averaged parameters, its spread over the fields from {spread[0]:.2f} m to {spread[-1]:.2f} m; in height it "
        f"goes from {height[0]:.2f} m to {height[-1]:.2f} m and changes by "
        f"{100.0 * finding.height_change:.1f}% at most."
    )
    if finding.holds:
        return (
            f"{first} The paper's finding holds: plan improves and evens out with more fields, height hardly changes."
        )
    parts = (
        ("plan does not improve", finding.plan_improves),
        ("plan does not even out", finding.plan_evens_out),
        ("height changes by a fifth or more", finding.height_stays),
    )
    failed = ", ".join(text for text, good in parts if not good)
    return f"{first} The paper's finding does not hold with these errors: {failed}."


def scheme_rows(run: CalibrationRun, what: str) -> list[tuple[Cell, ...]]:
    """Rows of the table of schemes; what: plan_rms or height_rms."""
    return [_row(f"scheme {k}", values_of(errors, what)) for k, errors in run.schemes.items()]


def values_of(errors: Mapping[str, CheckErrors], what: str) -> np.ndarray:
    """(fields,) RMS of one sort, metres."""
    return np.array([getattr(e, what) for e in errors.values()])


def _row(name: str, values: np.ndarray) -> tuple[Cell, ...]:
    return name, *(float(v) for v in values), float(values.mean()), float(values.std())


def _parameters(run: CalibrationRun) -> Section:
    found, laboratory = run.together, run.campaign.laboratory
    sigma = found.sigma
    start = dict(zip(INNER, np.ravel([laboratory[line].interior for line in LINES]), strict=True))
    truth = dict(zip(found.names, run.truth, strict=True))
    rows: list[tuple[Cell, ...]] = []
    for name in INNER:
        change, true = (1e6 * (v - start[name]) for v in (found.value(name), truth[name]))
        held = sigma[name] == 0.0
        z = None if held else float((found.value(name) - truth[name]) / sigma[name])
        rows.append((name, float(change), None if held else 1e6 * sigma[name], float(true), z))
    others: list[tuple[Cell, ...]] = []
    for name in (n for n in found.names if n not in INNER):
        scale, shown = (_ARCSEC, "arcsec") if unit(name) == "rad" else (1.0, "m")
        value, true, s = found.value(name) / scale, truth[name] / scale, sigma[name] / scale
        others.append((name, shown, float(value), float(s), float(true), float((value - true) / s)))
    drift = np.abs(run.campaign.spec.errors.star_tracker.thermal.amplitude).max()
    text = [
        "All fields at once, one interior orientation for all: changes from the laboratory's values. z is the error in "
        "sigmas of this adjustment.",
    ]
    if drift > 0.0 and run.campaign.spec.errors.switched_on:
        text.append(
            "The bias that varies with latitude also varies during a pass, while the outer lines see the field 33 s "
            "before and after the nadir line. The outer lines' principal points take this up, and no sigma contains it."
        )
    tables = (
        Table(
            "interior",
            "Interior orientation",
            "Micrometres, changes from the laboratory. Without sigma: held (gauge).",
            ("element", "change", "σ", "true change", "z"),
            rows,
            (None, 2, 2, 2, 2),
        ),
        Table(
            "biases",
            "Biases of the attitude and offsets of the orbit",
            f"From measured to true; offsets {', '.join(OFFSET)} in metres with the orbit's sigma as prior.",
            ("unknown", "unit", "value", "σ", "truth", "z"),
            others,
            (None, None, 3, 3, 3, 2),
        ),
    )
    return Section("Parameters", tuple(text), tables)


def _fields(run: CalibrationRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for one in run.campaign.passes:
        alone = run.fields[one.name].adjustment
        bias = alone.bias(one.name) / _ARCSEC
        errors = bias - one.bias / _ARCSEC
        rows.append((one.name, float(np.degrees(one.latitude)), *map(float, bias), *map(float, errors), alone.p_value))
    inner = np.array([[r.adjustment.value(n) for n in INNER] for r in run.fields.values()])
    spread = inner.std(axis=0, ddof=1) if len(inner) > 1 else np.zeros(len(INNER))
    worst = int(np.argmax(spread))
    text = (
        f"From field to field the interior orientation repeats to {1e3 * spread[worst]:.4f} mm or better (standard "
        f"deviation, {INNER[worst]}); the paper says the 0.01 mm class, and 1″ for the biases.",
    )
    table = Table(
        "fields",
        "Each field by itself",
        "Roll, pitch and yaw of the bias, arcseconds, and minus the truth at the field's middle. An offset of the "
        "orbit, which the twelve unknowns do not have, goes into roll and pitch: 0.3 m are 0.1 arcsec.",
        ("field", "latitude, deg", *BIAS, "Δ roll", "Δ pitch", "Δ yaw", "chance of the fit"),
        rows,
        (None, 1, 3, 3, 3, 3, 3, 3, 3),
    )
    return Section("Fields", text, (table,))


def _rank(run: CalibrationRun) -> Section:
    found, way = run.together, run.paper_way
    size = np.abs(np.triu(found.correlation, 1))
    size[~np.isfinite(size)] = 0.0
    order = np.argsort(size, axis=None)[::-1][:10]
    rows: list[tuple[Cell, ...]] = []
    for i, j in zip(*np.unravel_index(order, size.shape), strict=True):
        rows.append((found.names[int(i)], found.names[int(j)], float(found.correlation[i, j])))
    text = [f"Gauge: {found.gauge}."]
    text += [f"The points cannot tell: {c}." for c in found.open]
    text += [f"Weak, but solved for: {c}." for c in found.weak]
    state = "converges" if way.converged else "does not converge"
    text.append(
        f"The paper's stepwise solution, bias and interior in turn, {state} for {run.campaign.spec.schemes[0][0]} in "
        f"{way.rounds} rounds to steps of {STEPWISE_TOLERANCE:g} sigma; a round leaves {way.rate:.4f} of the slowest "
        "error. The simultaneous adjustment of all "
        f"fields takes {found.iterations} steps."
    )
    table = Table(
        "correlations",
        "Largest correlations",
        "Of the simultaneous adjustment; all of them are in calibration.json.",
        ("unknown", "unknown", "correlation"),
        rows,
        (None, None, 4),
    )
    return Section("What cannot be told apart", tuple(text), (table,))


def _data(run: CalibrationRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for name, result in run.fields.items():
        orbit, attitude = result.orbit.rms, result.attitude.rms / _ARCSEC
        rows.append((name, *map(float, orbit), *map(float, attitude)))
    table = Table(
        "third-differences",
        "RMS of third differences, as Table 2 of the paper",
        "Measured positions in the Earth-fixed frame, metres; measured attitude against the orbital frame, arcseconds. "
        "White noise of one sigma gives the square root of 20. Biases and drifts do not show.",
        ("field", "x", "y", "z", "roll", "pitch", "yaw"),
        rows,
        (None, 4, 4, 4, 4, 4, 4),
    )
    return Section("Orbit and attitude data", (), (table,))
