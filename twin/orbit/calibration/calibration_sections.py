"""What a report says of an in-orbit calibration, of strips, and of a camera that drifts under a monitor."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from analysis.arrays import ARCSEC
from analysis.calibration.adjustment import Adjustment
from analysis.orbit.calibration_parameters import OFFSET, RATE
from analysis.orbit.forward_intersection import CheckErrors
from scenes.yaml.units import ANGLE, LENGTH, format_quantity
from twin.framework.artefact import Artefact, Cell, SvgFigure, Table
from twin.framework.report import Section
from twin.orbit.calibration import field_sections
from twin.orbit.calibration.calibration_plots import drift_svg, figure_svg
from twin.orbit.calibration.calibration_run import STEPWISE_TOLERANCE, CalibrationRun, unit
from twin.orbit.calibration.camera_drift import Monitoring, Treatment
from twin.orbit.calibration.influences import steps_table
from twin.orbit.calibration.schemes import RMS, FieldErrors, Repeats, SchemeMeans, meets, values_of
from twin.orbit.calibration.strip import Strips


def monitor_gain(found: Monitoring) -> str:
    """What the monitor buys, in one sentence, from the scheme with most averaged parameters."""
    none, here = found.at(0.0), found.at(1.0)
    scheme = list(none.without.schemes)[-2]
    still, blind = none.without.schemes[scheme].height_rms, here.without.schemes[scheme].height_rms
    text = (
        f"With cameras that drift by {found.angle / ARCSEC:.2g} arcsec (Δα, 1σ) from field to field, heights "
        f"without ground control (scheme {scheme}) are wrong by {blind:.2f} m RMS, {still:.2f} m without drift"
    )
    if here.monitored is None:
        return f"{text}."
    return f"{text}; with the on-board monitor's readings, {here.monitored.schemes[scheme].height_rms:.2f} m."


def _monitoring_section(run: CalibrationRun, found: Monitoring) -> Section:
    """Errors by size of the drift and by scheme."""
    spec = run.campaign.simulated
    drifts = "; ".join(
        f"{name} {_angles(one.angles)}, Δf {format_quantity(one.principal_distance, LENGTH)}"
        for name, one in spec.drift.items()
    )
    text = [
        f"Each line camera differs in every field from its reference state, 1σ of Δα, Δβ, Δγ: {drifts}. "
        f"1 arcsec of Δα of the forward line is {abs(found.metres):.2f} m of height; Δβ moves points across "
        "the track, and Δγ and Δf act at the ends of the lines.",
        "Each row has the same points and the same noise. Adjusted as if nothing drifted, one interior orientation has "
        "to do for all fields: heights get worse with the drift. The fit sees it only when it is larger than the "
        "noise. Schemes without ground control use the mean of the parameters of their fields. Only a field that is "
        "calibrated in the same pass (the last scheme) does not feel the drift, for its own points tell it.",
    ]
    if spec.monitor is not None:
        text.append(
            f"The monitor reads each camera in each pass with {_angles(spec.monitor.angles)} and Δf "
            f"{format_quantity(spec.monitor.principal_distance, LENGTH)}, 1σ. Where a field is calibrated, its "
            "readings are observations of the drift, so that the interior orientation is that of the reference state; "
            "where a field is tested, the reference cameras are drifted by its own readings. What a reading has in "
            "common in all passes, the interior orientation takes up. Biases of the attitude, which act in plan, a "
            "monitor of the cameras does not read."
        )
    artefacts: list[Artefact] = [
        SvgFigure(
            "monitor-heights",
            "Height errors and the drift of the cameras",
            "Left: one campaign, its drift drawn once and scaled; the dashed line is what many campaigns would have "
            "on average. Right: RMS over all fields.",
            drift_svg(run, found),
        ),
        _by_size(found),
        _by_scheme(found),
    ]
    return Section("Cameras that drift, and the on-board monitor", tuple(text), tuple(artefacts))


def _by_size(found: Monitoring) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for size in found.sizes:
        rows.append((size.factor, size.factor * found.angle / ARCSEC, *_cells(size.without), *_cells(size.monitored)))
    return Table(
        "monitor-sizes",
        "All fields adjusted at once",
        "RMS at check points of all fields, metres, each field with its own bias; chance of the fit, with the noise of "
        "the readings of attitude and orbit counted as independent (which makes it too near to 1).",
        ("drift × file's", "σ Δα [arcsec]", "plan", "height", "chance", "plan, told", "height, told", "chance"),
        rows,
        (1, 2, 2, 2, 3, 2, 2, 3),
    )


def _by_scheme(found: Monitoring) -> Table:
    none, here = found.at(0.0).without, found.at(1.0)
    cases = {"no drift": none.schemes, "no monitor": here.without.schemes}
    cases["monitor"] = {} if here.monitored is None else here.monitored.schemes
    rows: list[tuple[Cell, ...]] = [
        (scheme, *(getattr(case.get(scheme), what, None) for what in RMS for case in cases.values()))
        for scheme in none.schemes
    ]
    return Table(
        "monitor-schemes",
        "Schemes without ground control, with the file's drift",
        "RMS at check points of all fields, metres; the last scheme lets each field use its own parameters.",
        ("scheme", *(f"{what}, {case}" for what in ("plan", "height") for case in cases)),
        rows,
        (None, 2, 2, 2, 2, 2, 2),
    )


def _cells(one: Treatment | None) -> tuple[Cell, ...]:
    return (None, None, None) if one is None else (one.together.plan_rms, one.together.height_rms, one.p_value)


def _angles(values: tuple[float, float, float]) -> str:
    return ", ".join(format_quantity(v, ANGLE) for v in values)


def strip_gain(before: Mapping[str, Mapping[str, CheckErrors]], found: Strips) -> str:
    """What the adjustment gains, in one sentence, from the scheme with most averaged parameters."""
    scheme = list(found.schemes)[-2]
    old, new = (FieldErrors.pooled(e[scheme].values()) for e in (before, found.schemes))
    return (
        f"Calibrating with {min(found.ties.values())} tie points of each pass or more, and adjusting each pass on "
        f"them, takes the height RMS of scheme {scheme} from {old.height_rms:.2f} m to {new.height_rms:.2f} m and the "
        f"plan RMS from {old.plan_rms:.2f} m to {new.plan_rms:.2f} m."
    )


def _strips_section(run: CalibrationRun, found: Strips) -> Section:
    """Errors before and after, and what tie points cannot tell."""
    rows: list[tuple[Cell, ...]] = []
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
    turns: list[tuple[Cell, ...]] = [
        (d.name, d.before / ARCSEC, d.after / ARCSEC, d.after / d.before) for d in found.datum
    ]
    common = Table(
        "strip-datum",
        f"What the tie points tell of turns of a whole pass, {run.campaign.passes[0].name}",
        "Sigma from the readings' noise alone and with the ties, arcseconds, of rates arcseconds per second. A ratio "
        "near 1 means that ties say nothing of it.",
        ("turn", "before", "after", "ratio"),
        turns,
        (None, 4, 4, 3),
    )
    tracker = run.campaign.spec.errors.star_tracker
    slow = max(tracker.slow.noise) / ARCSEC
    noise = f"{max(tracker.noise) / ARCSEC:g} arcsec from reading to reading"
    if slow:
        noise += f" and {slow:g} arcsec that change within {tracker.slow.interval:g} s"
    counts = ", ".join(f"{k} {n}" for k, n in found.ties.items())
    text = (
        f"Every pass is adjusted on points that three lines see ({counts}) without coordinates on the ground; the "
        "errors of its attitude and orbit are unknowns with their own sigmas as priors. Check points, which are no "
        "ties, are then intersected with the adjusted attitude and orbit. "
        f"The attitude's noise here is {noise}.",
        "Rays of one place that do not meet show errors of the attitude. What lasts for many readings and changes "
        "within the pass appears in many ties and is removed; noise that is independent from one reading to the next "
        "lies mostly in the mean of the three exposures, which no tie observes. A turn that the whole pass has in "
        "common "
        "stays, and so does the bias of the scheme: plan hardly gains where biases make it. In pitch even more stays: "
        "whatever repeats itself from one line's view of a place to the next, for as long as two such views last. It "
        "shifts heights, and only a strip that is long against this, with errors slower than it is long, gains much.",
        "Slow errors during the seconds in which a line sees the control points look like a change of its interior "
        "orientation or of the bias, and a calibration on control points alone takes part of them for one. Adjusting "
        "the attitude afterwards would count this part twice, and errors would grow. With the tie points of the whole "
        "strip in the calibration, interior and attitude are separable, and the adjusted attitude belongs to them. A "
        "single campaign of few fields scatters: each slow error that a pass keeps is shared by all of its points, so "
        "that one scheme may lose by chance where it gains on average.",
    )
    return Section("Adjustment of the strips", text, (table, common))


def sections(run: CalibrationRun) -> tuple[Section, ...]:
    """All but the lead, the facts and the main table."""
    found = [_schemes(run)]
    if run.repeats is not None:
        found.append(_repeats(run, run.repeats))
    if run.truth is None:
        found.append(field_sections.measured_section(run))
    if run.campaign.images is not None:
        found.append(field_sections.images_section(run.campaign))
    if run.monitoring is not None:
        found.append(_monitoring_section(run, run.monitoring))
    if run.strips is not None:
        found.append(_strips_section(run, run.strips))
    found += [
        _parameters(run),
        field_sections.fields_section(run),
        field_sections.biases_section(run),
        field_sections.light_section(run),
        field_sections.datum_section(run),
    ]
    return (*found, _rank(run), _data(run))


def scheme_names(run: CalibrationRun) -> list[str]:
    """Schemes in words, with their numbers."""
    names = [f"{k + 1}: {', '.join(s)}" for k, s in enumerate(run.campaign.spec.schemes)]
    return [*names, f"{len(names) + 1}: each field its own"]


def _schemes(run: CalibrationRun) -> Section:
    spec = run.campaign.spec
    limits = spec.limits
    tables = []
    for name, what in zip(("plan", "height"), RMS, strict=True):
        columns = [values_of(run.before, what), *(values_of(e, what) for e in run.schemes.values())]
        rows: list[tuple[Cell, ...]] = [(field, *(float(c[k]) for c in columns)) for k, field in enumerate(run.before)]
        rows.append(("mean", *(float(c.mean()) for c in columns)))
        rows.append(("spread", *(float(c.std()) for c in columns)))
        tables.append(
            Table(
                name,
                f"RMS in {name} at check points without ground control, metres",
                "Mean and standard deviation of the fields below.",
                ("field", "laboratory", *(f"scheme {k}" for k in run.schemes)),
                rows,
                (None, *(2,) * len(columns)),
            )
        )
    text = (
        f"Every field is calibrated by itself (three attitude biases and {len(run.campaign.inner)} elements of the "
        f"interior orientation, of which two are held), and each scheme uses the mean of the parameters of its "
        f"fields: {'; '.join(scheme_names(run))}. Check points "
        "are intersected from all lines that see them with these parameters and the measured orbit and attitude, "
        "without ground control.",
        scheme_summary(run.scheme_means),
        "What averaging changes are the biases of attitude, which differ from field to field and move all three lines "
        "alike: they act in plan. Heights depend on the difference between the outer lines, which the interior "
        "orientation holds and which hardly differs between fields; noise of the image and of the attitude makes the "
        "rest.",
        f"Maps at 1:50 000: {limits.plan:g} m in plan and {limits.height:g} m in height, assumed in the file. Every "
        f"field meets them by {_good(run)}; the laboratory's camera "
        f"{'meets them, too' if meets(run.before, limits) else 'does not meet them'}.",
    )
    figures = (
        SvgFigure("schemes-of-fields", "Schemes", "Each line is a field.", figure_svg("schemes-of-fields", run)),
        SvgFigure(
            "check-points",
            f"Errors at check points of {run.campaign.passes[0].name}",
            "Arrows in plan, colour in height: before calibration and with the field's own parameters. The scales "
            "differ.",
            figure_svg("check-points", run),
        ),
    )
    return Section("Schemes of averaged parameters", text, (figures[0], *tables, figures[1]))


def _good(run: CalibrationRun) -> str:
    good = run.within_limits
    return f"scheme{'s' * (len(good) > 1)} {', '.join(good)}" if good else "no scheme"


def scheme_summary(means: SchemeMeans | None) -> str:
    """What averaging over more fields changes."""
    if means is None:
        return "With one scheme of averaged parameters there is nothing to compare."
    plan, spread, height = means.plan, means.plan_spread, means.height
    return (
        f"The mean RMS in plan goes from {plan[0]:.2f} m with the first scheme to {plan[-1]:.2f} m with the last of "
        f"averaged parameters, its spread over the fields from {spread[0]:.2f} m to {spread[-1]:.2f} m; in height it "
        f"goes from {height[0]:.2f} m to {height[-1]:.2f} m and changes by "
        f"{100.0 * means.height_change:.1f}% at most."
    )


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
            *(h for w in ("plan", "height") for h in (f"{w} [m]", "± campaign", "spread of fields")),
            "1:50 000",
        ),
        rows,
        (None, 2, 2, 2, 2, 2, 2, None),
    )
    text = (
        "Biases, orbits, points and noise are drawn anew; the camera, the fields and the drift with latitude stay. One "
        "campaign of seven fields may come out otherwise by the chance of its biases alone: when the one field of the "
        "first scheme happens to lie near the mean of all, averaging cannot improve on it.",
    )
    return Section("Other campaigns", text, (table,))


def _parameters(run: CalibrationRun) -> Section:
    found, laboratory = run.together, run.campaign.laboratory
    sigma = found.sigma
    inner = run.campaign.inner
    start = dict(zip(inner, np.ravel([laboratory[line].interior for line in run.campaign.lines]), strict=True))
    truth = None if run.truth is None else dict(zip(found.names, run.truth.tolist(), strict=True))
    drift = run.drift.sigmas_per_arcsec or {}
    rows: list[tuple[Cell, ...]] = []
    for name in inner:
        held = sigma[name] == 0.0
        cells: tuple[Cell, ...] = ()
        if truth is not None:
            z = None if held else float((found.value(name) - truth[name]) / sigma[name])
            cells = (1e6 * (truth[name] - start[name]), z)
        change = 1e6 * (found.value(name) - start[name])
        rows.append((name, change, None if held else 1e6 * sigma[name], drift.get(name), *cells))
    others: list[tuple[Cell, ...]] = []
    for name in (n for n in found.names if n not in inner):
        scale, shown = {"rad": (ARCSEC, "arcsec"), "rad/s": (1e-3 * ARCSEC, "mas/s"), "m": (1.0, "m")}[unit(name)]
        value, s = found.value(name) / scale, sigma[name] / scale
        cells = () if truth is None else (truth[name] / scale, (value - truth[name] / scale) / s)
        others.append((name, shown, float(value), float(s), *cells))
    text = [
        "All fields at once, one interior orientation for all: changes from the laboratory's values."
        + " z is the error in sigmas of this adjustment." * (truth is not None)
    ]
    known = 0 if truth is None else 2
    apart = f"up to {run.campaign.passes[0].seconds_apart:.0f} s apart"
    if any(name.endswith(RATE) for name in found.names) and not any(name in RATE for name in found.names):
        text.append(
            f"The lines see a field {apart}, and a rate of the attitude in each pass is solved for, with the sigma "
            "that is stated or was found as its prior."
        )
    elif any(name in RATE for name in found.names):
        text.append(
            f"A bias that varies with latitude also varies during a pass, while the lines see the field {apart}. "
            "The fit of the biases against latitude tells the drift, with its sigma, and the outer lines' principal "
            "points share that sigma."
        )
    else:
        text.append(
            f"A bias that varies with latitude also varies during a pass, while the lines see the field {apart}. "
            "With so few fields nothing tells the drift: the outer lines' principal points take it up, and no sigma "
            "contains it."
        )
    tables = (
        Table(
            "interior",
            "Interior orientation",
            "Micrometres, changes from the laboratory. Without sigma: held (gauge). Drift: by how many of its sigmas "
            f"an element moves where the attitude drifts by 1 arcsec in {run.drift.seconds:.0f} s and the adjustment "
            "does not know of it; empty where rates are unknowns.",
            ("element", "change", "σ", "σ per arcsec of drift", *("true change", "z")[:known]),
            rows,
            (None, *(2,) * (3 + known)),
        ),
        Table(
            "biases",
            "Biases of the attitude and offsets of the orbit",
            f"From measured to true; offsets {', '.join(OFFSET)} in metres with the orbit's sigma as prior.",
            ("unknown", "unit", "value", "σ", *("truth", "z")[:known]),
            others,
            (None, None, 3, 3, *(3, 2)[:known]),
        ),
    )
    one = run.campaign.passes[0].name
    figure = SvgFigure(
        "residuals",
        f"Residuals of the control points in the images, {one}",
        "RMS of x and y in each line's title. What is left is noise of the image and of the attitude.",
        figure_svg("residuals", run),
    )
    steps = steps_table(run.chip_steps)
    return Section("Parameters", tuple(text), (*tables, steps, figure))


MOSTLY = 0.5
"""Share of a variance from which on an unknown is said to rest on the launch's sigmas."""


def rests_on_launch(found: Adjustment) -> dict[str, float]:
    """Unknowns whose sigma is more that of launch than that of the points, with the share of the variance."""
    shares = zip(found.names, found.from_start.tolist(), strict=True)
    return {name: share for name, share in shares if share > MOSTLY}


def _rank(run: CalibrationRun) -> Section:
    found, way = run.together, run.stepwise
    size = np.abs(np.triu(found.correlation, 1))
    size[~np.isfinite(size)] = 0.0
    order = np.argsort(size, axis=None)[::-1][:10]
    rows: list[tuple[Cell, ...]] = []
    for i, j in zip(*np.unravel_index(order, size.shape), strict=True):
        rows.append((found.names[int(i)], found.names[int(j)], float(found.correlation[i, j])))
    text = [f"Gauge: {found.gauge}."]
    text += [f"Not observable: {c}." for c in found.open]
    text += [f"Weak, but solved for: {c}." for c in found.weak]
    if resting := rests_on_launch(found):
        listed = ", ".join(f"{name} ({100.0 * share:.0f}% of its variance)" for name, share in resting.items())
        text.append(f"Determined by the prior on the launch, not by the points: {listed}.")
    state = "converges" if way.converged else "does not converge"
    text.append(
        f"The stepwise solution, bias and interior in turn, {state} for {run.campaign.spec.schemes[0][0]} in "
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
        figure_svg("correlation-matrix", run),
    )
    return Section("Observability", tuple(text), (table, figure))


def _data(run: CalibrationRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for name, result in run.fields.items():
        orbit, attitude = (None if one is None else one.rms for one in (result.orbit, result.attitude))
        cells = (orbit, None if attitude is None else attitude / ARCSEC)
        rows.append((name, *(v for one in cells for v in ((None,) * 3 if one is None else map(float, one)))))
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
