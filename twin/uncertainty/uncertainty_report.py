"""Report of what limits the accuracy of a monitor, with its figure, and the section on it in the main job's report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.limits import Split
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from twin.framework import svg
from twin.framework.artefact import Cell, SvgFigure, Table, significant, unit_for_reports
from twin.framework.provenance import checks_in
from twin.framework.report import Report, Section, answer, sentence
from twin.uncertainty.coverage import FALSE, HALF_WIDTHS, LEVELS, Coverage, UncertaintyRun
from twin.uncertainty.monitor_limits import (
    BEST,
    FIELD,
    LINES,
    MonitorLimits,
    body_text,
    combination_text,
    part_of,
    quantity_text,
    short_text,
    unit_text,
)
from twin.uncertainty.uncertainty_numbers import uncertainty_numbers

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FEW = 3
"""Number of motions of bodies listed for each quantity in the section of the main job's report."""
RARE = 1e-3
"""Probability that a spot leaves its CCD below which the report does not mention it."""


def limits_section(
    limits: MonitorLimits | None, lines: int = FEW, folded: int = 3, figure: str | None = None
) -> Section:
    """Return the section on what limits the accuracy of the estimated changes, with figure and tables.

    Parameters
    ----------
    limits : MonitorLimits or None
        Limits of the instrument, None without a prior.
    lines : int
        Number of motions listed for each quantity.
    folded : int
        Number of its tables that are folded.
    figure : str or None
        Result of ``limits_svg`` where it has been drawn already.
    """
    title = "What limits the readings"
    if limits is None:
        unknown = (
            "There is no prior on disturbances. All sigmas contain the noise of the images only, and other limits are "
            "unknown. Specify the expected motions and temperatures by `disturbances: orbit` in the job or in the "
            "instrument: a file of scenes/library/disturbances or another file."
        )
        return Section(title, (unknown,))
    shown = SvgFigure(
        "limits",
        "What the measurement removes, and what remains",
        f"Prior: {limits.disturbances.name}. Left: standard deviation of every quantity's error after the "
        "measurement over that before it. Right: variance that remains in the posterior, by bodies; those of both "
        "cameras together.",
        limits_svg(limits) if figure is None else figure,
    )
    text = [" ".join(map(sentence, _verdict(limits)))]
    if limits.outside > RARE:
        text.append(f"{_loss_text(limits)}.")
    return Section(
        title, tuple(text), (shown, _remedies(limits), _least_observable(limits), _ledger(limits, lines)), folded
    )


def uncertainty_report(run: UncertaintyRun) -> Report:
    """Return the report of ``python -m twin.uncertainty``."""
    limits, coverage = run.limits, run.coverage
    sections = [limits_section(limits, LINES, 0), _prior_section(limits)]
    if coverage is not None:
        sections.append(_states(coverage))
    warnings = [*run.warnings, *([_loss_text(limits)] if limits.outside > RARE else [])]
    if limits.without:
        warnings.append(f"the benefit of a second monitor is not known, since it cannot be built: {limits.without}")
    coverage_text = "" if coverage is None else _coverage_text(coverage)
    if coverage is not None and coverage.doubted:
        warnings.append(
            f"in {coverage.doubted} of {coverage.measured} random states spots differ from their calibration or "
            "motions are too large for a linear estimate, so that σ does not hold there"
        )
    if coverage is not None and coverage.alarms > coverage.alarm_limit:
        warnings.append(
            f"in {coverage.alarms} of {coverage.measured} random states the shifts contradict the prior, while "
            f"chance allows at most {coverage.alarm_limit}: chi-square is larger than sigmas and prior predict"
        )
    if coverage is not None and coverage.outliers:
        warnings.append(
            "sigmas do not hold in the random states: "
            + "; ".join(
                f"{name} of {group} {key}, {100 * level:g}%" for name, group, key, level, _ in coverage.outliers
            )
        )
    return Report(
        f"{limits.instrument}: what limits its monitor under {limits.disturbances.name}",
        *answer(*_verdict(limits)[:1], coverage_text, *_verdict(limits)[1:]),
        (
            (
                "Disturbances",
                f"{limits.disturbances.name}, {len(limits.disturbances.labels)} motions of "
                f"{len(set(limits.disturbances.bodies))} bodies",
            ),
            ("Frames", f"{limits.frames} before and {limits.frames} after"),
        ),
        _sigmas(limits),
        tuple(sections),
        warnings=tuple(warnings),
        checks=(*run.images.self_checks(), *checks_in(uncertainty_numbers(run))),
    )


def _headline(limits: MonitorLimits) -> int:
    """Return the index of the main quantity: the height, else the angle, else the first parameter."""
    keys = [(q.group, q.key) for q in limits.quantities]
    for wanted in ((GROUND_GROUP, "height_m"), (ANGLE_GROUP, "change_arcsec")):
        if wanted in keys:
            return keys.index(wanted)
    return 0


def _verdict(limits: MonitorLimits) -> tuple[str, ...]:
    """Return sentences on the main quantity: remaining sigma, its causes, and what would reduce it most."""
    q = _headline(limits)
    quantity, split = limits.quantities[q], limits.splits[BEST]
    unit, name = unit_text(quantity), short_text(quantity)
    motion, share = limits.lines(BEST, q)[0]
    best = min(limits.remedies, key=lambda remedy: float(remedy.sigma[q]))
    advice = f"the most effective addition is {best.what}, which would leave {significant(best.sigma[q], 2)} {unit}"
    if best.sigma[q] > 0.95 * split.sigma[q]:
        advice = "neither more frames nor ground points nor further spots would reduce it by 5 %"
    return (
        f"Under {limits.disturbances.name} the posterior leaves a standard deviation of "
        f"{significant(split.sigma[q], 2)} {unit} of the {name}, {significant(split.sigma_before[q], 2)} {unit} before "
        "the measurement",
        f"{body_text(motion)} contributes {100 * share:.0f} % of the remaining variance, noise of the images "
        f"{_percent(float(split.noise[q]) / float(split.sigma[q]) ** 2)}",
        advice,
    )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share >= 5e-4 else "less than 0.1 %"


def _loss_text(limits: MonitorLimits) -> str:
    return (
        f"In {_percent(limits.outside)} of all states of the prior {limits.disturbances.name} a spot leaves its area "
        "CCD, and nothing is measured: a larger CCD or smaller motions of the cameras would help; sigmas ignore "
        "this loss"
    )


def _sigmas(limits: MonitorLimits) -> Table:
    """Return the table of every quantity's standard deviation before and after the measurement."""
    heads = ("quantity", "before", *limits.splits, "noise part")
    rows: list[Sequence[Cell]] = []
    for q, quantity in enumerate(limits.quantities):
        after = [float(split.sigma[q]) for split in limits.splits.values()]
        values = [float(limits.splits[BEST].sigma_before[q]), *after, float(np.sqrt(limits.splits[BEST].noise[q]))]
        rows.append((quantity_text(quantity), *values))
    caption = (
        "Standard deviation of the quantity before the measurement, and of each estimator's error after it, from noise "
        "and from misread motions of the prior. Last column: the part of the posterior's from image noise."
    )
    return Table("sigmas", "Standard deviations", caption, heads, rows, digits=3)


def _ledger(limits: MonitorLimits, lines: int) -> Table:
    """Return the table of each motion's contribution to the posterior's variances."""
    split = limits.splits[BEST]
    rows: list[Sequence[Cell]] = []
    for q, quantity in enumerate(limits.quantities):
        name, contributions = quantity_text(quantity), limits.lines(BEST, q)
        prior = dict(limits.lines("", q))
        for motion, share in contributions[:lines]:
            sigma_if_known = float(limits.sigma_if_known[motion][q])
            rows.append((name, body_text(motion), 100.0 * prior[motion], 100.0 * share, sigma_if_known))
        rest = [motion for motion, _ in contributions[lines:]]
        before = 100.0 * sum(prior[motion] for motion in rest)
        after = 100.0 * sum(share for _, share in contributions[lines:])
        rows.append((name, f"the other {len(rest)} motions", before, after, None))
        noise = 100.0 * float(split.noise[q] / split.sigma[q] ** 2)
        rows.append((name, "noise of the images", None, noise, float(split.sigma[q])))
    caption = (
        "Shares of the variance before the measurement and of the remaining variance in the posterior, per cent. Last "
        "column: remaining standard deviation if that motion were known, in the quantity's unit; in the row of the "
        "noise, the present one. Shares of correlated motions can be negative."
    )
    heads = ("quantity", "motion", "before [%]", "after [%]", "σ if known")
    title = f"The {lines} largest contributions to each quantity"
    return Table("limits-motions", title, caption, heads, rows, (None, None, 2, 2), 3)


def _prior_section(limits: MonitorLimits) -> Section:
    """Return the section on the sigmas' dependence on the prior: elasticities."""
    rows: list[Sequence[Cell]] = []
    for q, quantity in enumerate(limits.quantities):
        largest = sorted(limits.elasticities, key=lambda elasticity: -float(elasticity.elasticity[q]))[:FEW]
        for elasticity in largest:
            size = f"{significant(elasticity.size, 3)} {unit_for_reports(elasticity.unit)}"
            values = (elasticity.elasticity, elasticity.doubled, elasticity.doubled_in_prior)
            numbers_of_row = [float(value[q]) for value in values]
            rows.append((quantity_text(quantity), elasticity.number.replace("_", " "), size, *numbers_of_row))
    numbers = Table(
        "limits-elasticities",
        "Sensitivity of the sigmas to the prior",
        "Elasticity: relative change of the posterior's standard deviation per relative change of the number. Then "
        "the standard deviation if the true number is twice as large: with the prior unchanged, and with it doubled.",
        ("quantity", "number of the prior", "value", "elasticity", "σ if twice as large", "σ if doubled in the prior"),
        rows,
        (None, None, None, 3, None, None),
        3,
    )
    split = limits.splits[BEST]
    most = max(limits.elasticities, key=lambda elasticity: float(elasticity.elasticity[_headline(limits)]))
    q = _headline(limits)
    unit = unit_text(limits.quantities[q])
    text = (
        f"The sigmas are only as good as the prior. σ of the {short_text(limits.quantities[q])} is most sensitive to "
        f"{most.number.replace('_', ' ')}, {significant(most.size, 3)} {unit_for_reports(most.unit)}, with an "
        f"elasticity of {float(most.elasticity[q]):.2f}: if it is twice as large, σ is "
        f"{significant(float(most.doubled[q]), 2)} {unit} instead of {significant(float(split.sigma[q]), 2)} {unit}."
    )
    return Section("Sensitivity to the prior", (text,), (numbers,))


def _remedies(limits: MonitorLimits) -> Table:
    """Return the table of the standard deviations that would remain after further measurements."""
    heads = ["quantity", "before", "now", *(remedy.what for remedy in limits.remedies)]
    rows: list[Sequence[Cell]] = []
    for q, quantity in enumerate(limits.quantities):
        split = limits.splits[BEST]
        values = [split.sigma_before[q], split.sigma[q], *(remedy.sigma[q] for remedy in limits.remedies)]
        rows.append((quantity_text(quantity), *map(float, values)))
    second = (
        ""
        if any(r.name == "second_monitor" for r in limits.remedies)
        else " The benefit of a second monitor is computed by python -m twin.uncertainty config.yaml."
    )
    caption = (
        "Standard deviations of the posterior with further measurements. A test field on the ground fixes the "
        f"direction of the line's middle, and of its ends relative to it, to {FIELD / ARCSEC:.2g} arcsec; the monitor "
        "measures at that time too, so that disturbances without change since then are known: fully for a constant "
        "cause, not at all for one that has lost its correlation. A second monitor has its own prisms, which move as "
        f"much, and shares cameras and central prism.{second}"
    )
    return Table("limits-remedies", "What would help", caption, tuple(heads), rows, digits=3)


def _least_observable(limits: MonitorLimits) -> Table:
    """Return the table of the combinations of motions that the spots observe least, for each quantity."""
    rows = [(quantity_text(q), combination_text(limits, k)) for k, q in enumerate(limits.quantities)]
    caption = (
        "The most probable motions that change a quantity by the standard deviation of the posterior. The largest, in "
        "units of their standard deviations, are listed; uncertainty.json has more."
    )
    return Table("limits-hidden", "Least observable combinations", caption, ("quantity", "motions"), rows)


def _coverage_text(coverage: Coverage) -> str:
    """Return a sentence on the coverage of the sigmas."""
    n, counts = coverage.measured, coverage.counts
    if coverage.outliers:
        return f"in {n} random states {len(coverage.outliers)} of {counts} coverages are outside their limits"
    return f"in {n} random states all {counts} coverages of 68 and 95 % intervals are within their limits"


def _states(coverage: Coverage) -> Section:
    """Return the section on errors and coverage in the random states."""
    n, unmeasured = coverage.measured, coverage.drawn - coverage.measured
    rows: list[Sequence[Cell]] = []
    for k, quantity in enumerate(coverage.quantities):
        for name in coverage.errors:
            rms, ratio = float(coverage.rms(name)[k]), float(coverage.ratio(name)[k])
            cells: list[Cell] = []
            for level in range(len(LEVELS)):
                low, high = (100.0 * float(end[k]) / n for end in coverage.limits(name, level))
                cells += [100.0 * float(coverage.covered(name, level)[k]) / n, f"{low:.1f} to {high:.1f}"]
            rows.append((quantity_text(quantity), name, rms, ratio, *cells))
    drawn_text = f"{coverage.drawn} states were drawn from the prior, rendered, exposed and recovered"
    widths = " and ".join(f"{width:.3f}" for width in HALF_WIDTHS)
    text = [
        f"{drawn_text}. Intervals of {widths} total sigma should contain the truth in 68 and 95% of them. The range "
        f"beside each share agrees with this; if every sigma is right, the chance that any share lies outside its "
        f"range is {100 * FALSE:g}%."
    ]
    if unmeasured:
        text.append(
            f"In {unmeasured} of them a spot left its CCD. The motions of the remaining states are smaller than the "
            "prior: their chi-square is smaller, and so are errors that are correlated with the motions of the spots. "
            "The limits take this into account; the errors of the posterior do not change."
        )
    mean = float(np.mean(coverage.chi_square))
    text.append(
        f"The chi-square of the shifts was {mean:.2f} on average and exceeded its limit in {coverage.alarms} states; "
        f"at a false-alarm rate of {FALSE_ALARM:g}, chance allows up to {coverage.alarm_limit}."
    )
    heads = ("quantity", "estimator", "rms error", "rms of error / sigma")
    intervals = ("in 68 % interval [%]", "limits", "in 95 % interval [%]", "limits of these")
    caption = "Readings minus truth in the quantity's unit, and the share of intervals that contain the truth."
    decimals = (None, None, None, 3, 1, None, 1, None)
    table = Table("coverage", "Random states", caption, (*heads, *intervals), rows, decimals, 3)
    return Section("Do the sigmas hold?", tuple(text), (table,))


PALETTE = (svg.BLUE, svg.VERMILION, svg.GREEN, svg.ORANGE, svg.PURPLE, svg.SKY, svg.YELLOW)
"""Colours of the bodies that cause the largest shares of the variance; the others are grey."""
MARKS = "os^vDP*X"


def limits_svg(limits: MonitorLimits) -> str:
    """Draw how much the measurement reduces the standard deviations, and which bodies cause the remaining variance.

    Left: standard deviation of every quantity by each estimator, over that before the measurement. Right: the variance
    that the posterior leaves, by bodies.
    """
    with svg.look("limits"):
        return svg.to_svg(_figure(limits))


def _figure(limits: MonitorLimits) -> Figure:
    count = len(limits.quantities)
    figure = svg.new_figure(1.7 + 0.3 * count)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.0, 1.15))
    _reduced(left, limits)
    _by_body(right, limits)
    for axes in (left, right):
        svg.plain_axes(axes)
        groups = [quantity.group for quantity in limits.quantities]
        for q in range(1, count):
            if groups[q] != groups[q - 1]:
                axes.axhline(q - 0.5, color=svg.LIGHT, lw=0.8, zorder=0)
    left.set_yticks(range(count), [quantity_text(quantity) for quantity in limits.quantities])
    left.set_ylim(count - 0.5, -0.5)
    right.tick_params(left=False)
    left.set_title("Reduction by the measurement")
    right.set_title("Contributions to the rest")
    svg.shared_legend(figure, left, "lower left", 3, columnspacing=1.2)
    svg.shared_legend(figure, right, "lower right", 4, columnspacing=1.2)
    return figure


def _reduced(axes: Axes, limits: MonitorLimits) -> None:
    """Draw the ratios of standard deviations after and before, with both values in their units for the posterior."""
    y = np.arange(len(limits.quantities))
    before = limits.splits[BEST].sigma_before
    for k, (name, split) in enumerate(limits.splits.items()):
        best = name == BEST
        colour, fill = (svg.VERMILION, svg.VERMILION) if best else (svg.GREY, "none")
        look: dict[str, Any] = {"ms": 6.5, "zorder": 3} if best else {"ms": 4.5, "zorder": 2}
        axes.plot(split.sigma / before, y, MARKS[k % len(MARKS)], color=colour, mfc=fill, label=name, **look)
    axes.axvline(1.0, color=svg.INK, lw=0.8, ls=":")
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(low, max(high, 1.2) * (max(high, 1.2) / low) ** 0.62)
    for q, quantity in enumerate(limits.quantities):
        ends = [significant(value, 2) for value in (before[q], limits.splits[BEST].sigma[q])]
        text = f"{ends[0]} → {ends[1]} {unit_text(quantity)}"
        axes.annotate(
            text, (1.0, q), xycoords=("axes fraction", "data"), ha="right", va="center", fontsize=8, color=svg.INK
        )
    axes.set_xlabel("standard deviation after over before; numbers: before → after, posterior")


def _by_body(axes: Axes, limits: MonitorLimits) -> None:
    """Draw stacked shares of the posterior's variance by kind of body; negative shares go to the left."""
    split = limits.splits[BEST]
    total = split.sigma**2
    parts = {
        name: value / total
        for name, value in Split.by(split.after, [part_of(body) for body in limits.disturbances.bodies]).items()
    }
    order = sorted(parts, key=lambda name: -float(np.sum(np.abs(parts[name]))))
    named, others = order[: len(PALETTE)], order[len(PALETTE) :]
    bars = [(name, parts[name], colour) for name, colour in zip(named, PALETTE, strict=False)]
    if others:
        bars.append(("other bodies", np.asarray(sum(parts[name] for name in others)), svg.GREY))
    bars.append(("noise of the images", split.noise / total, svg.INK))
    y = np.arange(len(total))
    up, down = np.zeros(len(total)), np.zeros(len(total))
    for name, share, colour in bars:
        left, label = 100.0 * np.where(share >= 0.0, up, down), name.replace("_", " ")
        axes.barh(y, 100.0 * share, left=left, height=0.68, color=colour, label=label)
        up, down = up + np.maximum(share, 0.0), down + np.minimum(share, 0.0)
    axes.set_xlabel("share of the posterior variance, %")
    if np.any(down < -1e-3):
        axes.axvline(0.0, color=svg.INK, lw=0.8)
