"""What a report says of an in-orbit calibration: schemes, parameters, what cannot be told apart, data."""

from __future__ import annotations

import numpy as np

from analysis.orbit.calibration_parameters import RATE
from analysis.units import ARCSEC
from scenes.orbit_angle import LINES
from twin.artefact import Cell, SvgFigure, Table
from twin.orbit.calibration.field_sections import biases_section, fields_section
from twin.orbit.calibration.figure import drawn
from twin.orbit.calibration.image_sections import images_section
from twin.orbit.calibration.influence_sections import datum_section, light_section
from twin.orbit.calibration.influences import INNER, OFFSET
from twin.orbit.calibration.monitor_sections import monitoring_section
from twin.orbit.calibration.procedure import STEPWISE_TOLERANCE, CalibrationRun
from twin.orbit.calibration.schemes import RMS, STATEMENTS, Finding, Repeats, values_of
from twin.orbit.calibration.strip_sections import strips_section
from twin.orbit.calibration.to_json import meets, unit
from twin.trial.section import Section


def sections(run: CalibrationRun) -> tuple[Section, ...]:
    """All but the lead, the facts and the main table."""
    found = [_schemes(run)]
    if run.repeats is not None:
        found.append(_repeats(run, run.repeats))
    if run.campaign.images is not None:
        found.append(images_section(run.campaign))
    if run.monitoring is not None:
        found.append(monitoring_section(run, run.monitoring))
    if run.strips is not None:
        found.append(strips_section(run, run.strips))
    found += [_parameters(run), fields_section(run), biases_section(run), light_section(run), datum_section(run)]
    return (*found, _rank(run), _data(run))


def scheme_names(run: CalibrationRun) -> list[str]:
    """Schemes in words, with their numbers."""
    names = [f"{k + 1}: {', '.join(s)}" for k, s in enumerate(run.campaign.spec.schemes)]
    return [*names, f"{len(names) + 1}: each field its own"]


def _schemes(run: CalibrationRun) -> Section:
    spec = run.campaign.spec
    limits = spec.limits
    tables = []
    for name, number, what in zip(("plan", "height"), (6, 7), RMS, strict=True):
        columns = [values_of(run.before, what), *(values_of(e, what) for e in run.schemes.values())]
        rows: list[tuple[Cell, ...]] = [(field, *(float(c[k]) for c in columns)) for k, field in enumerate(run.before)]
        rows.append(("mean", *(float(c.mean()) for c in columns)))
        rows.append(("spread", *(float(c.std()) for c in columns)))
        tables.append(
            Table(
                name,
                f"RMS in {name} at check points without ground control, metres",
                f"Fields and schemes as in Table {number} of the paper, whose numbers are not in the text that is "
                "available.",
                ("field", "laboratory", *(f"scheme {k}" for k in run.schemes)),
                rows,
                (None, *(2,) * len(columns)),
            )
        )
    text = (
        "Every field is calibrated by itself (three attitude biases and nine elements of the interior orientation), "
        f"and each scheme uses the mean of the parameters of its fields: {'; '.join(scheme_names(run))}. Check points "
        "are intersected from all three lines with these parameters and the measured orbit and attitude, without "
        "ground control.",
        said(run.finding),
        "What averaging changes are the biases of attitude, which differ from field to field and move all three lines "
        "alike: they act in plan. Heights depend on the difference between the outer lines, which the interior "
        "orientation holds and which hardly differs between fields; noise of the image and of the attitude makes the "
        "rest.",
        f"Maps at 1:50 000: {limits.plan:g} m in plan and {limits.height:g} m in height, assumed in the file, for the "
        f"paper prints none. Every field meets them by {_good(run)}; the laboratory's camera "
        f"{'meets them, too' if meets(run.before, limits.plan, limits.height) else 'does not meet them'}.",
    )
    figures = (
        SvgFigure("schemes-of-fields", "Schemes", "Each line is a field.", drawn("schemes-of-fields", run)),
        SvgFigure(
            "check-points",
            f"Errors at check points of {run.campaign.passes[0].name}",
            "Arrows in plan, colour in height: before calibration and with the field's own parameters. The scales "
            "differ.",
            drawn("check-points", run),
        ),
    )
    return Section("Schemes of averaged parameters", text, (figures[0], *tables, figures[1]))


def _good(run: CalibrationRun) -> str:
    limits = run.campaign.spec.limits
    good = [k for k, errors in run.schemes.items() if meets(errors, limits.plan, limits.height)]
    return f"scheme{'s' * (len(good) > 1)} {', '.join(good)}" if good else "no scheme"


def said(finding: Finding | None) -> str:
    """Whether the paper's finding holds, with the numbers."""
    if finding is None:
        return "With one scheme of averaged parameters there is nothing to compare."
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


def _repeats(run: CalibrationRun, repeats: Repeats) -> Section:
    count, limits = len(repeats.plan), run.campaign.spec.limits
    met = repeats.met(limits.plan, limits.height)
    rows: list[tuple[Cell, ...]] = []
    for k, name in enumerate(scheme_names(run)):
        cells: list[Cell] = [name]
        for values in (repeats.plan[:, k], repeats.height[:, k]):
            mean = values.mean(axis=1)
            cells += [float(mean.mean()), float(mean.std(ddof=1)) if count > 1 else None]
            cells += [float(values.std(axis=1).mean())]
        rows.append((*cells, f"{100.0 * met[k]:.0f}%"))
    table = Table(
        "campaigns",
        f"{count} campaigns over the same fields",
        "RMS at check points, metres: mean of the fields, averaged over the campaigns, with its standard deviation "
        "from campaign to campaign; spread over the fields; in how many campaigns every field meets 1:50 000.",
        (
            "parameters",
            "plan, m",
            "± campaign",
            "spread of fields",
            "height, m",
            "± campaign",
            "spread of fields",
            "1:50 000",
        ),
        rows,
        (None, 2, 2, 2, 2, 2, 2, None),
    )
    judged: list[tuple[Cell, ...]] = []
    for key, sentence in (*STATEMENTS.items(), ("holds", "all three")) if repeats.findings else ():
        share = repeats.share(key)
        # Wilson's interval of one sigma, which is not empty at 0 and 1
        middle = (share + 0.5 / count) / (1.0 + 1.0 / count)
        half = np.sqrt(share * (1.0 - share) / count + 0.25 / count**2) / (1.0 + 1.0 / count)
        here = "yes" if getattr(run.finding, key) else "no"
        judged.append((sentence, here, share, float(middle - half), float(middle + half)))
    sentences = Table(
        "sentences",
        "The paper's sentences",
        "First averaged scheme against the last. Share of the campaigns in which a sentence holds, with the interval "
        "of one sigma that so many campaigns leave.",
        ("sentence", "this campaign", "share", "from", "to"),
        judged,
        (None, None, 2, 2, 2),
    )
    text = (
        "Biases, orbits, points and noise are drawn anew; the camera, the fields and the drift with latitude stay. One "
        "campaign of seven fields may come out otherwise by the chance of its biases alone: when the one field of the "
        "first scheme happens to lie near the mean of all, averaging cannot improve on it.",
    )
    return Section("Other campaigns", text, (sentences, table) if judged else (table,))


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
        scale, shown = {"rad": (ARCSEC, "arcsec"), "rad/s": (1e-3 * ARCSEC, "mas/s"), "m": (1.0, "m")}[unit(name)]
        value, true, s = found.value(name) / scale, truth[name] / scale, sigma[name] / scale
        others.append((name, shown, float(value), float(s), float(true), float((value - true) / s)))
    text = [
        "All fields at once, one interior orientation for all: changes from the laboratory's values. z is the error in "
        "sigmas of this adjustment.",
    ]
    if any(name in RATE for name in found.names):
        text.append(
            "A bias that varies with latitude also varies during a pass, while the outer lines see the field 33 s "
            "before and after the nadir line. The fit of the biases against latitude tells the drift, with its sigma, "
            "and the outer lines' principal points share that sigma."
        )
    else:
        text.append(
            "A bias that varies with latitude also varies during a pass, while the outer lines see the field 33 s "
            "before and after the nadir line. With so few fields nothing tells the drift: the outer lines' principal "
            "points take it up, and no sigma contains it."
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
    one = run.campaign.passes[0].name
    figure = SvgFigure(
        "residuals",
        f"Residuals of the control points in the images, {one}",
        "RMS of x and y in each line's title. What is left is noise of the image and of the attitude.",
        drawn("residuals", run),
    )
    return Section("Parameters", tuple(text), (*tables, figure))


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
    figure = SvgFigure(
        "correlation-matrix",
        "Correlations",
        "Of the simultaneous adjustment, held unknowns left out. Yaw of all fields goes with y of the outer lines; "
        "roll and pitch of a field go with the offset of its orbit.",
        drawn("correlation-matrix", run),
    )
    return Section("What cannot be told apart", tuple(text), (table, figure))


def _data(run: CalibrationRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for name, result in run.fields.items():
        orbit, attitude = result.orbit.rms, result.attitude.rms / ARCSEC
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
