"""Report of a tolerance budget: yield, contributions to variances, sensitivities, inverse limits and allocation.

The yield is the fraction of cameras that meet all requirements. The inverse limit of a tolerance is the size at which
it alone causes a merit's allowed loss.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from scenes.yaml.units import split_quantity
from twin.framework.artefact import (
    CameraFile,
    Cell,
    DecimalNumber,
    SvgFigure,
    Table,
    decimals_for,
    plain,
    unit_for_reports,
)
from twin.framework.report import Report, Section, answer
from twin.framework.svg import BLUE, GREY, INK, ORANGE, VERMILION, look, new_figure, plain_axes, shared_legend, to_svg
from twin.tolerance.merit_models import FARTHEST
from twin.tolerance.monitor_merit import merit_head, merit_unit
from twin.tolerance.tolerance_run import MeritResult, ToleranceRun, Yield

_FEW = 3
"""Number of tolerances that the verdict names."""
_MAIN = 0.05
"""Share of a merit's variance from which the report names a tolerance as a cause of its spread."""
_NOISE = 2.0
"""Number of standard errors within which two shares of variance are not distinguished."""
_LITTLE = 0.01
"""Fraction of the variance of every merit below which the report says that a tolerance may be loosened."""
_MOST_CURVES = 6
"""Largest number of merits that are plotted."""
_ROUNDING = 1e-7
"""Fraction of a compensator's range below which a move is reported as zero."""


def tolerance_report(run: ToleranceRun) -> Report:
    """Return the report of a budget: verdict, yield, sensitivities, inverse limits, variances and allocation."""
    test = run.setup.test
    with look("tolerance"):
        curves = to_svg(_yield_figure(run))
    verdict, more = answer(_designed(run), _verdict(run), *_causes(run), _loose(run), *_further(run))
    sections = (
        Section(
            "Yield",
            (
                "Cumulative share of the cameras over the value of each merit, by exact traces and by the models; the "
                "red line is the requirement.",
            ),
            (SvgFigure("yield", "Merits over all cameras", "", curves),),
            name="yield",
        ),
        Section(
            "Shares of variance",
            (
                "Share of the variance of each merit that vanishes without the tolerance. For merits that are the "
                "worst of several fields the shares need not add up to 100 %.",
            ),
            (_shares_table(run),),
            name="shares",
        ),
        Section(
            "Sensitivities",
            (
                "Merits with each tolerance alone at its lower and upper limit, after adjustment of all compensators, "
                "by exact traces.",
            ),
            (_sensitivity_table(run),),
            name="sensitivities",
        ),
        Section(
            "Limits for a loss",
            (
                "The limit at which a tolerance alone degrades a merit by the loss in the head of its column, by "
                f"exact traces of both signs. Empty where {FARTHEST:g} times the limit does not cause the loss, and "
                "where the design has no margin.",
            ),
            (_inverse_table(run),),
            name="inverse",
        ),
        *_allocation_sections(run),
        *_figure_sections(run),
        *_compensator_sections(run),
        Section("Limits", (), (_tol_table(run),), name="tol"),
        Section(
            "Worst cameras",
            ("The worst cameras as jobs, with their adjustments: `python -m twin.camera FILE` shows each.",),
            tuple(CameraFile(name, f"Camera {name[-2:]}", "", text) for name, text in run.jobs.items()),
            closed=True,
            name="worst",
        ),
    )
    facts = (
        ("camera", run.bench.camera),
        ("tolerances", str(len(test.tolerances))),
        ("compensators", str(len(test.compensators)) or "none"),
        ("cameras drawn", str(len(run.samples.problems))),
        ("seed", str(test.seed)),
    )
    title = f"Tolerances of {run.bench.camera}"
    unmet = any(result.passing.judged(result.merit.spec.probability) == "missed" for result in run.merits)
    return Report(title, verdict, more, facts, _summary(run), sections, warnings=run.warnings, unmet=unmet)


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"


def _interval(passing: Yield) -> str:
    return f"{_percent(passing.share)} ({100.0 * passing.low:.1f} to {100.0 * passing.high:.1f} %)"


def _designed(run: ToleranceRun) -> str:
    """Return a sentence on the requirements that the designed camera itself misses; empty if it meets all."""
    missed = []
    for result in run.merits:
        spec = result.merit.spec
        margin = result.nominal - spec.requirement if spec.more_is_better else spec.requirement - result.nominal
        if margin < 0.0:
            unit, size = merit_unit(result.merit)
            limit = f"{'at least' if spec.more_is_better else 'at most'} {plain(spec.requirement / size)}"
            value = f"{plain(result.nominal / size, 3)} {unit_for_reports(unit)}".rstrip()
            missed.append(f"{result.merit.name} ({value}, {limit} is required)")
    if not missed:
        return ""
    return (
        f"The designed camera itself, without errors, misses the requirement on {' and '.join(missed)}: tighter "
        "tolerances do not help, change the design or the requirement"
    )


def _verdict(run: ToleranceRun) -> str:
    judged = [(result.merit.name, result.passing.judged(result.merit.spec.probability)) for result in run.merits]
    missed, undecided = ([name for name, how in judged if how == status] for status in ("missed", "open"))
    text = f"Yield: {_interval(run.passing)} of the cameras meet all requirements"
    if missed:
        text += f"; too few meet the requirement on {', '.join(missed)}"
    if undecided:
        text += f"; more cameras are needed to decide on {', '.join(undecided)}"
    return text if missed or undecided else f"{text}, and enough meet each single requirement"


def _causes(run: ToleranceRun) -> tuple[str, ...]:
    """Return a sentence for each merit that not every camera meets: the tolerances that cause its spread."""
    out = []
    for result in _tight(run):
        order = sorted(result.shares, key=lambda name: -result.shares[name])
        dear = [name for name in order[: _few(order, result)] if result.shares[name] >= _MAIN]
        named = [f"{100.0 * result.shares[name]:.0f} %" for name in dear]
        spread = f"of the spread (variance) of {result.merit.name}"
        if len(dear) == 1:
            out.append(f"{dear[0]} causes {named[0]} {spread}")
        elif dear:
            parts = [f"{name} {share}" for name, share in zip(dear, named, strict=True)]
            out.append(f"{', '.join(parts[:-1])} and {parts[-1]} are the largest causes {spread}")
    return tuple(out)


def _few(order: list[str], result: MeritResult) -> int:
    """Return how many tolerances to name: ``_FEW``, and those whose shares are the last one's within their errors."""
    least = min((result.shares[name] - _NOISE * result.share_errors[name] for name in order[:_FEW]), default=0.0)
    return sum(result.shares[name] + _NOISE * result.share_errors[name] >= least for name in order)


def _loose(run: ToleranceRun) -> str:
    """Return a sentence on the tolerances that could be loosened; empty without any."""
    worst = _importance(run)
    loose = sorted((name for name in worst if worst[name] < _LITTLE), key=lambda name: worst[name])
    if not loose:
        return ""
    named = ", ".join(loose[:_FEW]) + (f" and {len(loose) - _FEW} more" if len(loose) > _FEW else "")
    return f"{named} {'contributes' if len(loose) == 1 else 'contribute'} little and could be loosened"


def _tight(run: ToleranceRun) -> list[MeritResult]:
    """Return the merits that not every camera meets; all merits if every camera meets them."""
    return [result for result in run.merits if result.passing.share < 1.0] or list(run.merits)


def _importance(run: ToleranceRun) -> dict[str, float]:
    """Return each tolerance's largest share of the variance of a merit, over the merits that not every camera meets."""
    return {name: max(result.shares[name] for result in _tight(run)) for name in run.bench.entries}


def _further(run: ToleranceRun) -> list[str]:
    allocation, judged, asked = run.allocation, run.judged, run.setup.test.allocation
    if allocation is None or judged is None or asked is None:
        return []
    if allocation.reached:
        cost = f"{allocation.cost[1]:.3g} ({allocation.cost[0]:.3g} before)"
        return [
            f"Limits allocated for a yield of {_percent(asked.target)} give {_interval(judged)}, at a cost of {cost}"
        ]
    subject = "None of the graded limits" if allocation.unrounded else "No allocation within the bounds"
    return [f"{subject} reaches a yield of {_percent(asked.target)}: those of the table give {_interval(judged)}"]


def _scaled(value: float, result: MeritResult) -> Cell:
    """Return a merit's value in its reporting unit, with decimals according to its standard deviation."""
    size = merit_unit(result.merit)[1]
    if not np.isfinite(value):
        return None
    digits = decimals_for(result.deviation / size, 2, most=5)
    return DecimalNumber(value / size, max(digits, 1) if merit_unit(result.merit)[0] else max(digits, 3))


def _summary(run: ToleranceRun) -> Table:
    rows: list[list[Cell]] = []
    for result in run.merits:
        spec = result.merit.spec
        sign = "at least" if spec.more_is_better else "at most"
        limit = f"{plain(spec.requirement / merit_unit(result.merit)[1])} in {100 * spec.probability:.0f} %"
        values = (result.nominal, result.mean, result.levels[1], result.quadratic[1])
        judged = _interval(result.passing), result.passing.judged(spec.probability)
        rows.append(
            [merit_head(result.merit), f"{sign} {limit}", *(_scaled(value, result) for value in values), *judged]
        )
    caption = (
        "Designed: nominal camera after adjustment. 90 %: the value that 90 % of the cameras meet, by exact traces and "
        "by the second-order model. Yield: share of the cameras that meet the requirement, with its 95 % interval."
    )
    heads = ("merit", "requirement", "designed", "mean", "90 %", "90 % quadratic", "yield", "result")
    return Table("merits", "Merits", caption, heads, rows)


def _shares_table(run: ToleranceRun) -> Table:
    worst = _importance(run)
    order = sorted(worst, key=lambda name: -worst[name])
    rows: list[list[Cell]] = [[name, *(100.0 * result.shares[name] for result in run.merits)] for name in order]
    heads = ("tolerance", *(f"{result.merit.name} [percent]" for result in run.merits))
    error = 100.0 * max((e for result in run.merits for e in result.share_errors.values()), default=0.0)
    caption = f"In percent, by many draws of the second-order model; the standard error is at most {error:.2g} %."
    return Table("variance", "Shares of variance", caption, heads, rows, (None, *[1] * len(run.merits)))


def _sensitivity_table(run: ToleranceRun) -> Table:
    adjusted = run.setup.test.compensators
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []
    for e, (name, item) in enumerate(run.setup.test.tolerances.items()):
        cells: list[Cell] = [name, item.words, str(item.limit)]
        for m, result in enumerate(run.merits):
            cells += [_scaled(float(run.sensitivity.values[e, end, m]), result) for end in (0, 1)]
        shares = [
            float(run.sensitivity.moves[e, end, c]) / (compensator.range_si or 1.0)
            for c, compensator in enumerate(adjusted.values())
            for end in (0, 1)
        ]
        shares = [0.0 if abs(share) < _ROUNDING else share for share in shares]
        ranges = [compensator.range for compensator in adjusted.values() for _ in (0, 1)]
        limits_and_shares = list(zip(ranges, shares, strict=True))
        rows.append([*cells, *(_scaled_limit(limit, x) if np.isfinite(x) else "" for limit, x in limits_and_shares)])
        full.append([*cells, *(_number(limit)[0] * x if np.isfinite(x) else None for limit, x in limits_and_shares)])
    signs = ("\N{MINUS SIGN}", "+")
    moved = [f"move of {name} [{_number(c.range)[1]}]".replace(" []", "") for name, c in adjusted.items()]
    groups = [*(merit_head(item.merit) for item in run.merits), *moved]
    heads = ("tolerance", "motion", "limit", *(sign for _ in groups for sign in signs))
    over = (
        ("", 3),
        *((group, 2) for group in groups[: len(run.merits)]),
        *((f"move of {name}", 2) for name in adjusted),
    )
    caption = "Merits with one tolerance at its limit, for a figure error the average over its random terms."
    if adjusted:
        caption += " Then the move of each compensator; it is not defined for a figure error."
    full_table = Table(
        "sensitivities", "", "", (*heads[:3], *(f"{group} {sign}" for group in groups for sign in signs)), full
    )
    return Table("sensitivities", "Each tolerance at its limits", caption, heads, rows, over=over, full=full_table)


def _number(limit: str | float) -> tuple[float, str]:
    """Return number and unit of a limit in the notation of the files; a pure number has an empty unit."""
    parts = split_quantity(limit)
    return (float(limit), "") if parts is None else (float(parts[0]), parts[1])


def _inverse_table(run: ToleranceRun) -> Table:
    rows: list[list[Cell]] = []
    for e, (name, tolerance) in enumerate(run.setup.test.tolerances.items()):
        cells: list[Cell] = [name, str(tolerance.limit)]
        for m in range(len(run.merits)):
            share = float(run.inverse.shares[e, m])
            cells.append(_scaled_limit(tolerance.limit, share) if np.isfinite(share) else "")
        rows.append(cells)
    heads = ["tolerance", "limit"]
    for m, result in enumerate(run.merits):
        unit, size = merit_unit(result.merit)
        loss, name = float(run.inverse.losses[m]) / size, result.merit.name
        heads.append(f"{name}: loss {loss:.3g} {unit_for_reports(unit)}".rstrip() if np.isfinite(loss) else name)
    return Table("inverse", "Limits for a loss", "In the unit of the limit.", heads, rows)


def _scaled_limit(limit: str | float, share: float) -> str:
    """Return ``share`` times a tolerance limit as text, in the limit's unit."""
    if isinstance(limit, str):
        number, _, unit = limit.strip().partition(" ")
        return f"{float(number) * share:.3g} {unit}"
    return f"{limit * share:.3g}"


def _allocation_sections(run: ToleranceRun) -> tuple[Section, ...]:
    allocation, judged = run.allocation, run.judged
    if allocation is None or judged is None:
        return ()
    rows: list[list[Cell]] = []
    for e, (name, tolerance) in enumerate(run.setup.test.tolerances.items()):
        chosen, rounded = _scaled_limit(tolerance.limit, float(allocation.scales[e])), str(allocation.limits[name])
        numbers = (float(allocation.rounded[e]), *allocation.costs[:, e].tolist())
        rows.append([name, tolerance.words, str(tolerance.limit), chosen, rounded, *numbers])
    heads = ("tolerance", "motion", "limit", "chosen", "rounded", "ratio", "cost", "new cost")
    caption = "Limits as specified, at the least cost, and rounded to the grades, with their costs."
    table = Table(
        "allocation", "Limits before and after", caption, heads, rows, (None, None, None, None, None, 3, 2, 2)
    )
    text = (
        f"Cost {allocation.cost[0]:.3g} before and {allocation.cost[1]:.3g} after. By the model the yield changes from "
        f"{_percent(allocation.predicted[0])} to {_percent(allocation.predicted[1])}; independent cameras, traced "
        f"exactly, give {_interval(judged)}.",
    )
    return (Section("Allocation", text, (table,), name="allocation"),)


def _tol_table(run: ToleranceRun) -> Table:
    """Return the table of the limits for the workshop, one row per tolerance."""
    limits = run.allocation.limits if run.allocation is not None else {}
    rows: list[list[Cell]] = []
    for name, tolerance in run.setup.test.tolerances.items():
        law = "measured" if tolerance.measured is not None else "figure" if tolerance.spectrum else tolerance.law
        rows.append([name, tolerance.words, str(limits.get(name, tolerance.limit)), law, " ".join(tolerance.carrying)])
    heads = ("tolerance", "motion", "limit (plus, minus)", "law", "carrying")
    return Table("tol", "Limits for the workshop", "As CSV in artefacts/tol.csv.", heads, rows)


def _figure_sections(run: ToleranceRun) -> tuple[Section, ...]:
    """Return the section with the circles and clear apertures over which figure errors are defined."""
    if not run.bench.figure_faces:
        return ()
    rows: list[list[Cell]] = []
    for name, element in run.bench.figure_faces.items():
        disk, outer = element.figure_disk, element.outer_edge
        assert outer is not None
        x0, x1, y0, y1 = outer.bounds
        shape = type(outer).__name__.lower() + ", partly blocked" * any(edge.blocks for edge in element.edges)
        lengths = [1e3 * v for v in (disk.radius, *disk.centre, x1 - x0, y1 - y0)]
        rows.append([name, run.setup.test.tolerances[name].words, *lengths[:3], shape, *lengths[3:]])
    sizes = ("circle radius [mm]", "circle x [mm]", "circle y [mm]", "clear aperture", "width [mm]", "height [mm]")
    table = Table(
        "figures", "Circles and clear apertures", "In the surface's own x and y.", ("tolerance", "motion", *sizes), rows
    )
    text = (
        "The rms of a Zernike term is over the smallest circle round the clear aperture, that of a whole figure error "
        "over the clear aperture about its mean. The clear aperture is a specified edge, the stop, or the beams of the "
        "field with edge_margin."
    )
    return (Section("Figure errors", (text,), (table,), name="figures"),)


def _compensator_sections(run: ToleranceRun) -> tuple[Section, ...]:
    if not run.bench.compensators:
        return ()
    moves = run.samples.moves
    rows: list[list[Cell]] = []
    for c, (name, spec) in enumerate(run.setup.test.compensators.items()):
        values = moves[np.isfinite(moves[:, c]), c]
        unit = spec.range_si or 1.0
        size = [
            _scaled_limit(spec.range, float(part) / unit)
            for part in (np.std(values), np.max(np.abs(values), initial=0.0))
        ]
        rows.append([name, spec.motion, str(spec.range), str(spec.step or ""), str(spec.accuracy or ""), *size])
    heads = ("compensator", "motion", "range", "step", "accuracy", "std of moves", "largest move")
    table = Table("compensators", "Adjustments", "Over all cameras.", heads, rows)
    return (Section("Compensators", (), (table,), name="compensators"),)


def _yield_figure(run: ToleranceRun) -> Figure:
    """Plot the cumulative fraction of cameras against the value of each merit."""
    shown = run.merits[:_MOST_CURVES]
    columns = min(3, len(shown))
    lines = -(-len(shown) // columns)
    figure = new_figure(2.6 * lines)
    axes = np.atleast_1d(figure.subplots(lines, columns, squeeze=False)).ravel()
    for result, ax in zip(shown, axes, strict=False):
        _curve(ax, run, result)
    for ax in axes[len(shown) :]:
        ax.set_axis_off()
    shared_legend(figure, axes[0])
    return figure


def _curve(ax: Axes, run: ToleranceRun, result: MeritResult) -> None:
    size, m = merit_unit(result.merit)[1], run.bench.merits.index(result.merit)
    models = (run.sensitivity.model.quadratic, run.sensitivity.model.linear)
    curves = [run.samples.values[:, m], *(result.merit.values(part(run.samples.x)) for part in models)]
    looks = ((BLUE, "-", 1.8, "exact"), (ORANGE, "--", 1.4, "quadratic"), (GREY, ":", 1.2, "linear"))
    for values, (colour, style, width, label) in zip(curves, looks, strict=True):
        known = np.sort(values[np.isfinite(values)]) / size
        share = np.arange(1, len(known) + 1) / len(values)
        if result.merit.spec.more_is_better:
            share = 1.0 - share + 1.0 / len(values)
        ax.plot(known, 100.0 * share, style, color=colour, lw=width, label=label)
    ax.axvline(result.merit.spec.requirement / size, color=VERMILION, lw=1.0)
    ax.axhline(100.0 * result.merit.spec.probability, color=INK, lw=0.5, alpha=0.5)
    ax.set_xlabel(merit_head(result.merit))
    ax.set_ylabel("cameras [%]")
    ax.set_ylim(0.0, 102.0)
    plain_axes(ax)
