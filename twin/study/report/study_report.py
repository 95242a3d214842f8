"""Report of a study: ``report.html``, the figures and tables in ``artefacts``, and ``statistics.json``."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.text import Text

from scenes.specs.study import GRID, SAMPLERS, StudySpec
from scenes.yaml.errors import key_text
from twin.framework import page, run_folder, svg
from twin.framework.artefact import Cell, SvgFigure, Table, Undrawn, decimals_for, fixed, plain, significant
from twin.framework.report import Report, Section, answer
from twin.framework.run_folder import RunFolder
from twin.study.report import study_analysis
from twin.study.report import study_plots as plots
from twin.study.report import study_statistics as statistics
from twin.study.report.sensitivity_indices import MANY_FAILED, RESAMPLES, Indices, NoIndices
from twin.study.report.study_analysis import GOALS, Requirement, StudyAnalysis
from twin.study.report.study_statistics import Estimate, Factor, StudyRuns, typeset
from twin.study.runs.base_job import one_line
from twin.study.runs.plan import Plan
from twin.study.runs.setup import PROGRAM


@dataclass(frozen=True, eq=False)
class StudyReport:
    """Report of a study with its files.

    Attributes
    ----------
    verdict : str
        Verdict at the top of the report.
    contents : dict
        Path of each file in the study's folder -> its contents.
    undrawn : tuple of str
        One sentence for each figure that could not be drawn.
    warnings : tuple of str
        Warnings for the user.
    """

    verdict: str
    contents: dict[str, bytes]
    undrawn: tuple[str, ...]
    warnings: tuple[str, ...]


def write_report(
    data: xr.Dataset, plan: Plan, folder: RunFolder, files: Sequence[str], input_warnings: Sequence[str] = ()
) -> StudyReport:
    """Write ``report.html``, ``statistics.json`` and the folder ``artefacts`` into the study's folder.

    Parameters
    ----------
    data : Dataset
        Data set of ``twin.study.study_files.make_dataset``.
    plan : Plan
        Plan of the study; ``plan.setup.study.report`` specifies the contents of the report.
    folder : RunFolder
        Folder of the study, complete but for the manifest, which is written afterwards.
    files : sequence of str
        Names of the data files in that folder.
    input_warnings : sequence of str
        Warnings about the inputs, which precede all others.

    Returns
    -------
    StudyReport
        The report that was written.
    """
    report = report_files(data, plan.setup.study, files, input_warnings)
    for name, content in report.contents.items():
        folder.write_bytes(name, content)
    return report


def report_files(
    data: xr.Dataset,
    study: StudySpec,
    files: Sequence[str] = ("study.nc", "study.csv"),
    input_warnings: Sequence[str] = (),
) -> StudyReport:
    """Return the report of a study's data set with the contents of all its files, without writing them."""
    analysis = StudyAnalysis.of(StudyRuns.of(data, study))
    (head, more), runs = verdict(analysis), analysis.runs
    about = (
        f"{plural(runs.count, 'run')} of {study.base.command}, {int(runs.failed.sum())} of them failed; "
        f"{design_title(runs.kind)}, seed {study.design.seed}."
    )
    report = Report(
        study.name,
        head,
        (*more, *([study.description] if study.description else ()), about),
        (),
        _response_table(analysis),
        (Section("Factors", (), (_factor_table(runs),)), *sections(analysis)),
    )
    undrawn = tuple(artefact.note for artefact in report.artefacts if isinstance(artefact, Undrawn))
    report = replace(report, warnings=(*input_warnings, *undrawn, *warnings(analysis)))
    contents = {artefact.file: artefact.content() for artefact in report.artefacts if artefact.within is None}
    contents[STATISTICS] = run_folder.json_text(report.with_verdict(study_analysis.STATISTICS(analysis))).encode()
    numbers = page.links((*files, "study.json", STATISTICS, "config.yaml"))
    contents["report.html"] = page.report_page(report, (PROGRAM, "config.yaml"), [("Numbers", numbers)]).encode()
    return StudyReport(head, contents, undrawn, report.warnings)


STATISTICS = "statistics.json"
"""Name of the file with all digits of those tables that show rounded numbers and have no file of their own."""


def _factor_table(runs: StudyRuns) -> Table:
    """Return the table of factors: name, key in the base job, distribution, and the values of the runs."""
    rows: list[list[Cell]] = []
    for factor in runs.factors:
        positions = [key_text(key) for key in factor.spec.key_paths]
        positions += [f"{key_text(scale.key)} (power {scale.power:g})" for scale in factor.spec.scales]
        levels = factor.levels.tolist()
        ends = (min(levels), max(levels)) if factor.numeric else (levels[0], levels[-1])
        values = " … ".join(plain(end, 5) if factor.numeric else str(end) for end in ends[: len(levels)])
        kind = str(factor.spec.kind)
        rows.append([factor.name, typeset(factor.unit), "; ".join(positions), kind, len(levels), values])
    heads = ("factor", "unit", "in the base", "distribution", "values", "from … to")
    return Table(
        "factors", "", "Varied factors; config.yaml has their distributions.", heads, rows, within="config.yaml"
    )


MOST_FIGURES = 12
"""Largest number of responses that get figures of their own in the report."""
MOST_FRONT = 50
"""Largest number of rows of a Pareto front in the report; its CSV file has all."""


def sections(analysis: StudyAnalysis) -> list[Section]:
    """Return all sections of the report that have contents, in the order of the page."""
    several = sum(len(factor.levels) > 1 for factor in analysis.runs.factors) > 1
    makers = [_requirements, _distributions, _influences, _indices, _curves, _pairs, _fronts, _convergence]
    if not several:  # a study of one factor begins with the response to it
        makers.insert(1, makers.pop(makers.index(_curves)))
    return [section for make in makers if (section := make(analysis)) is not None]


def _response_table(analysis: StudyAnalysis) -> Table:
    """Return the table of mean, standard deviation, quantiles and range of each response and of its reported sigma."""
    sampled = analysis.runs.sampled
    heads = ["response", "unit", "runs", "mean", "std", "median", "95%", "99.7%", "min", "max"]
    heads += ["p, normal"] * sampled + ["main factors"]
    rows: list[list[Cell]] = []
    for r in analysis.runs.everything:
        d = analysis.descriptions[r.name]
        estimates = [with_limits(e) for e in (d.mean, d.std, d.median, d.p95, d.p997)]
        normal = [DASH if d.normality is None else f"{d.normality.p:.2g}"] * sampled
        ends = number(d.low), number(d.high)
        rows.append([r.name, typeset(r.unit), d.count, *estimates, *ends, *normal, main_factors(analysis, r)])
    if sampled:
        how = (
            "In brackets 95% confidence intervals: Student's for the mean, from the kurtosis for the standard "
            "deviation, order statistics for the quantiles; a question mark is an end that needs more runs, > a "
            "quantile with a lower limit alone. p: test of D'Agostino and Pearson for a normal distribution."
        )
    else:
        how = "Over all combinations of the grid with equal weights; a grid is not a sample, so there are no intervals."
    caption = (
        f"Over the runs with a finite value; the columns 95% and 99.7% are quantiles. {how} Main factors: shares of "
        "the variance by total Sobol indices, otherwise by main effects of the grid or the linear model."
    )
    return Table("responses", "Responses", caption, heads, rows, within=STATISTICS)


def _figure(name: str, title: str, caption: str, draw: Callable[[], Figure]) -> SvgFigure | Undrawn:
    """Return a figure, or a note instead of it if it cannot be drawn, so that the rest of the report is kept."""
    try:
        with svg.look(f"study-{name}"):
            figure = draw()
            for text in figure.findobj(Text):
                if "$" in text.get_text():  # somebody's unit or name, and no formula
                    text.set_parse_math(False)
            return SvgFigure(name, title, caption, svg.to_svg(figure))
    except Exception as error:
        return Undrawn(name, title, caption, one_line(error))


def _requirements(analysis: StudyAnalysis) -> Section | None:
    if not analysis.requirements:
        return None
    rows: list[list[Cell]] = [
        [
            r.name or "all",
            r.text,
            typeset(r.unit),
            r.met,
            r.count,
            percent(r.share),
            span(r.interval),
            DASH if r.bounds is None else f"{r.met} … {r.most} of {r.runs}",
            span(r.bounds_interval),
            *(number(e.value if e else None) for e in (r.judged and r.judged.p95, r.judged and r.judged.p997)),
        ]
        for r in analysis.requirements
    ]
    caption = (
        "Over the runs with a finite value; intervals are Clopper and Pearson's, 95%, of a drawn design. Of all runs: "
        "if none and if all without a value meet it. The last columns are quantiles of the response or its magnitude."
    )
    heads = ("requirement", "", "unit", "met", "of", "share", "interval", "of all runs", "interval of all runs")
    table = Table("requirements", "Share of the runs that meet them", caption, (*heads, "95%", "99.7%"), rows,
                  within=STATISTICS)  # fmt: skip
    return Section("Requirements", (), (table,))


def _distributions(analysis: StudyAnalysis) -> Section | None:
    asked = analysis.runs.study.report.histograms
    names = [r.name for r in analysis.runs.responses if asked is None or r.name in asked][:MOST_FIGURES]
    names = [name for name in names if analysis.descriptions[name].count > 0]
    if not names:
        return None
    caption = "Number of runs by value."
    if analysis.runs.sampled:
        caption += " Dashed: three standard deviations from the mean. Dotted, if the distribution is not normal: the "
        caption += "0.135% and 99.865% quantiles, from 741 runs on."
    figure = _figure("histograms", "Histograms", caption, lambda: plots.histogram_figure(analysis, names))
    return Section("Distributions", (), (figure,))


def _influences(analysis: StudyAnalysis) -> Section | None:
    responses = plots.with_tornado(analysis)
    if not responses:
        return None
    sampled = analysis.runs.sampled
    if sampled:
        caption = (
            "Change of the response from a factor's 5% to its 95% quantile by the linear model, the others unchanged, "
            "with 95% intervals (HC3). Blue: rises with the factor; red: falls; grey: a text, between the values "
            "with the smallest and the largest mean."
        )
    else:
        caption = (
            "From the smallest to the largest mean over a factor's values. Blue: the last value has the larger mean; "
            "red: the first; grey: texts."
        )
    figure = _figure(
        "tornado", "Swings" if sampled else "Main effects", caption, lambda: plots.tornado_figure(analysis)
    )
    rows: list[list[Cell]] = []
    texts = []
    for r in responses:
        model = analysis.linear[r.name]
        if model is None:
            continue
        texts.append(f"{r.name} {percent(max(model.adjusted, 0.0))}")
        for e in model.effects:
            ends = " … ".join(end if isinstance(end, str) else number(end, 3) for end in e.span)
            swing = with_limits(e.swing) if sampled else number(e.swing.value)
            ranks = _maybe(e.coefficient, sampled), _maybe(e.rank, sampled)
            rows.append([r.name, e.factor, ends, swing, typeset(r.unit), *ranks])
    table = Table(
        "linear-model",
        "Linear model and rank correlations",
        "Swing between the factor's 5% and 95% quantiles (second column), standardised regression coefficient (sigmas "
        "of the response per sigma of the factor) and Spearman's rank correlation"
        + (", with 95% intervals. Where the last two differ much, the response is nonlinear." if sampled else "."),
        ("response", "factor", "from … to", "swing", "unit", "standardised", "rank correlation"),
        rows,
        within=STATISTICS,
    )
    models = [model for r in responses if (model := analysis.linear[r.name]) is not None]
    not_separable = sorted({name for model in models for name in model.not_separable})
    remarks = [f"Adjusted R² of the linear model (for its number of terms): {', '.join(texts)}."] if texts else []
    if not_separable:
        remarks.append(f"Not separable from the other factors and excluded from the model: {', '.join(not_separable)}.")
    return Section("Effects of the factors", tuple(remarks), (figure, table) if rows else (figure,))


def _maybe(estimate: Estimate | None, sampled: bool) -> str:
    if estimate is None:
        return DASH
    return with_limits(estimate) if sampled else number(estimate.value, 3)


def _indices(analysis: StudyAnalysis) -> Section | None:
    if not analysis.runs.study.report.sobol:
        return None
    remarks = index_remarks(analysis)
    chaos = analysis.runs.sampled
    rows: list[list[Cell]] = []
    for r in analysis.runs.everything:
        part = analysis.indices[r.name]
        if not isinstance(part, Indices):
            continue
        for index in part.axes:
            check = DASH if index.check is None else fixed(index.check, 2)
            rows.append([r.name, index.name, share(index.first), share(index.total), *([check] if chaos else [])])
    heads = ("response", "factor", "first order", "total", *(("first order, RBD-FAST",) if chaos else ()))
    caption = "First order: share of the variance that the factor explains alone; total: with all its interactions."
    if chaos:
        caption += " RBD-FAST (SALib) needs no model and checks the first order; its own error is some 0.03 to 0.1."
    table = Table("sobol", "Indices", caption, heads, rows, within=STATISTICS)
    return Section("Sobol indices", tuple(remarks), (table,) if rows else ())


def _curves(analysis: StudyAnalysis) -> Section | None:
    figures = []
    if analysis.runs.sampled:
        caption = (
            "Points: runs. Line: mean, by local parabolas; for few values, by value with 95% intervals. "
            "Band: one standard deviation of the runs about it."
        )
    else:
        caption = "Means over all other factors; for a text with one standard deviation of the runs as whisker."
        if len([f for f in analysis.runs.factors if len(f.levels) > 1]) > 1:
            caption += " A line or group for each value of the most important other factor."
    for k, response in enumerate(analysis.runs.everything[:MOST_FIGURES]):
        if analysis.descriptions[response.name].count == 0 or response.constant:
            continue
        figures.append(
            _figure(f"curves-{k + 1}", response.label, caption, partial(plots.curve_figure, analysis, response))
        )
        caption = "As above."
    if not figures:
        return None
    more = len(analysis.runs.factors) - plots.MOST_PANELS
    remarks = (f"The {plots.MOST_PANELS} most important of {len(analysis.runs.factors)} factors.",) if more > 0 else ()
    return Section("Response curves", remarks, tuple(figures))


def _pairs(analysis: StudyAnalysis) -> Section | None:
    pairs = analysis.runs.study.report.scatter
    if not pairs:
        return None
    draw = partial(plots.scatter_figure, analysis, pairs)
    return Section("Pairs", (), (_figure("scatter", "Requested pairs", "Every point is a run.", draw),))


def _fronts(analysis: StudyAnalysis) -> Section | None:
    remarks = tuple(
        f"{pair}: its values are texts, which have no order, so that no Pareto front is drawn."
        for pair in analysis.not_numbers
    )
    if not analysis.fronts:
        return Section("Best compromises", remarks) if remarks else None
    caption = (
        "Blue: runs on the Pareto front, which no other run beats in both; the steps bound the known feasible region. "
    )
    caption += "Knee: point of the front, scaled to its range, farthest from the line through its ends."
    parts: list[SvgFigure | Undrawn | Table] = [
        _figure("pareto", "Pareto fronts", caption, lambda: plots.pareto_figure(analysis))
    ]
    for k, front in enumerate(analysis.fronts):
        x, y = analysis.runs.find(front.spec.x), analysis.runs.find(front.spec.y)
        others = [f for f in analysis.runs.factors if f not in (x, y) and len(f.levels) > 1]
        rows: list[list[Cell]] = []
        for j, run in enumerate(front.runs.tolist()):
            values: list[Cell] = [_cell(f, run) for f in others]
            rows.append([run, float(front.x[j]), float(front.y[j]), *values, "knee" if j == front.knee else ""])
        shown = [rows[i] for i in np.linspace(0, len(rows) - 1, min(len(rows), MOST_FRONT)).round().astype(int)]
        thin = f" {MOST_FRONT} of {len(rows)}, evenly through the front; study.csv holds all runs."
        note = f"From the best {x.name} on.{thin if len(shown) < len(rows) else ''}"
        heads = ("run", x.label, y.label, *(f.label for f in others), "")
        parts.append(Table(f"pareto-front-{k + 1}", f"Front of {x.name} and {y.name}", note, heads, shown))
    return Section("Best compromises", remarks, tuple(parts))


def _cell(factor: Factor, run: int) -> Cell:
    """Return a factor's value in a run as a cell of a table; whole numbers without decimals."""
    value: Cell = factor.values[run].item()
    whole = factor.numeric and bool(np.all(factor.levels == np.rint(factor.levels)))
    return int(value) if whole and isinstance(value, float) else value


def _convergence(analysis: StudyAnalysis) -> Section | None:
    rows: list[list[Cell]] = [
        [name, _STATISTICS[c.name], number(c.relative, 2), GOALS[c.name], "yes" if c.enough else "no", c.needed]
        for name, convergences in analysis.convergences.items()
        for c in convergences
    ]
    if not rows:
        return None
    heads = ("response", "statistic", "half-width [σ]", "goal [σ]", "enough", "runs needed")
    caption = "Half of the statistic's 95% interval, in sigmas of the response, and about how many runs reach the goal."
    if SAMPLERS[analysis.runs.kind].even:
        caption += " The intervals are those of independent runs; this design determines the mean better."
    return Section("Convergence", (), (Table("convergence", "", caption, heads, rows, within=STATISTICS),))


_STATISTICS = {"mean": "mean", "sigma": "standard deviation", "p95": "95% quantile", "p99.7": "99.7% quantile"}


# verdict, warnings and numbers as text

BAD_MODEL = 0.8
"""Cross-validated R² below which the report calls the polynomial chaos model of a response poor."""


def design_title(kind: str) -> str:
    """Return the name of a kind of design as the report writes it."""
    return "complete grid" if kind == GRID else SAMPLERS[kind].title


def warnings(analysis: StudyAnalysis) -> list[str]:
    """Return the warnings, which precede everything else in the report."""
    runs = analysis.runs
    failed = int(runs.failed.sum())
    out = []
    if failed:
        common = [f"{text} ({plural(n, 'run')})" for text, n in Counter(t for t in runs.messages if t).most_common(3)]
        why = f" Most often: {'; '.join(common)}." if common else ""
        out.append(f"{failed} of {plural(runs.count, 'run')} failed and are excluded from all statistics.{why}")
        if failed > MANY_FAILED * runs.count and failed < runs.count:
            out.append(
                "So many runs failed that the others no longer represent the design; the statistics hold only for "
                "feasible runs."
            )
    wrong = statistics.impossible_noise(runs)
    out += [str(issue) for issue in wrong.issues] if wrong is not None else []
    for name, part in analysis.indices.items():
        disagreeing = [index for index in part.axes if index.agrees is False] if isinstance(part, Indices) else []
        if disagreeing:
            out.append(
                f"{name}: the Sobol indices of {', '.join(index.name for index in disagreeing)} by polynomial chaos "
                "and by RBD-FAST do not agree, so that neither is reliable: use more runs."
            )
    doubts = [text for text in runs.doubts if text]
    if doubts:
        # the same words about other numbers are one reason
        common = [f"{text} ({plural(n, 'run')})" for text, n in Counter(map(_reason, doubts)).most_common(3)]
        out.append(
            f"σ does not hold in {len(doubts)} of {plural(runs.count, 'run')}; their readings are included in all "
            f"statistics: {'; '.join(common)}. The column doubt lists these runs."
        )
    for r in runs.responses:
        missing = int((~r.good & ~runs.failed).sum())
        if missing:
            out.append(f"{r.name} has no finite number in {plural(missing, 'run')} that did not fail.")
    if runs.sampled and failed < runs.count < statistics.LEAST:
        out.append(
            f"{plural(runs.count, 'run')} are few: distributions, upper quantiles and sensitivity indices need at "
            f"least {statistics.LEAST}, and intervals are wide."
        )
    return out


def _reason(doubt: str) -> str:
    """Return the start of a run's warning, without numbers and spot names, so that equal warnings can be counted."""
    head, _, rest = doubt.partition("; ")
    if "fit of the spots" in head:
        return f"the fit of spots is not good: {rest.partition(':')[0].partition('. ')[0]}"
    return head.removeprefix("σ does not hold: ").partition(" (")[0]


def index_remarks(analysis: StudyAnalysis) -> list[str]:
    """Return sentences on how the sensitivity indices were computed, and for which responses they are doubtful."""
    if analysis.runs.sampled:
        out = [
            f"From the runs ({design_title(analysis.runs.kind)}) by polynomial chaos, with intervals from {RESAMPLES} "
            f"bootstrap resamples. Events in less than {percent(3.7 / max(analysis.runs.count, 4), 1)} of the "
            "factors' distribution may be missed by all runs, and no interval covers them."
        ]
    else:
        out = ["The variance of the complete grid is decomposed exactly, with all combinations equally likely."]
    for name, part in analysis.indices.items():
        if isinstance(part, NoIndices):
            out.append(f"{name}: {part.reason}.")
        elif part.held_out is not None and part.held_out < BAD_MODEL and part.rest - (part.noise or 0.0) >= 0.05:
            out.append(f"{name}: such a poor model gives at best the order of importance (R² of held-out runs).")
    return out


LEAST_SHARE = 0.02
"""Fraction of a response's variance below which a factor is not named among the main factors."""


def verdict(analysis: StudyAnalysis) -> tuple[str, tuple[str, ...]]:
    """Return a study's verdict of two sentences, and the sentences that follow it.

    The verdict says how the requirements are met, or else which factors move the first response, and whether the runs
    suffice.
    """
    runs = analysis.runs
    failed = int(runs.failed.sum())
    first = [f"{plural(runs.count, 'run')}, {failed} failed" if failed else plural(runs.count, "run")]
    known = [r for r in analysis.requirements if r.share is not None]
    if known:
        # the last of several is all together
        worst = min(known, key=lambda r: (r.share, r.name))
        name = f"the requirement {worst.name} ({worst.text})" if worst.name else "all requirements together"
        least = ", the lowest share," if len(known) > 1 else ""
        are = "is" if worst.name else "are"
        whatever = _open_range(worst)
        first.append(
            f"{name} {are} met by {worst.met} of {plural(worst.count, 'run')} with a finite value{least}{whatever}"
        )
    elif runs.responses:
        first.append(f"Response {_response_text(analysis, runs.responses[0])}")
    short = [
        name
        for name, statistics in analysis.convergences.items()
        if not all(convergence.enough for convergence in statistics)
    ]
    if short:
        first.append(
            f"the runs are too few for some statistics of {plural(len(short), 'response')}: see the convergence"
        )
    return answer(*(part for text in first for part in text.split(". ")))


def _open_range(r: Requirement) -> str:
    """Return the possible range of the fraction that meets the requirement, as the end of a sentence.

    The range is open because failed runs may or may not have met it.
    """
    if r.bounds is None:
        return ""
    interval = f" (95% interval {span(r.bounds_interval)})" if r.bounds_interval is not None else ""
    return f", or by {r.met} to {r.most} of all {r.runs} runs, whatever the others would have given{interval}"


def _response_text(analysis: StudyAnalysis, response: statistics.Response) -> str:
    about, factors = analysis.descriptions[response.name], main_factors(analysis, response)
    if response.constant:
        return f"{response.name} {factors}: {with_unit(about.low, response.unit, 6)}."
    mean, std = (with_unit(e.value if e else None, response.unit) for e in (about.mean, about.std))
    where = "" if analysis.runs.sampled else " over the grid"
    text = f"{response.name}: mean {mean}, standard deviation {std}{where}."
    return f"{text} Main factors: {factors}." if factors else text


def main_factors(analysis: StudyAnalysis, response: statistics.Response) -> str:
    """Return up to three factors with the shares of a response's variance that they explain, or why there are none.

    The shares are total Sobol indices if the study asks for them, otherwise those of the main effects of a grid or of
    the linear model, whose factors count only where their effect exceeds its 95% interval.
    """
    count, model = analysis.descriptions[response.name].count, analysis.linear[response.name]
    if response.constant:
        return f"is the same in all {plural(count, 'run')}" if count else "the value is NaN in all runs"
    sure = set(analysis.runs.study.factors)
    if analysis.runs.sampled and model is not None and not isinstance(analysis.indices.get(response.name), Indices):
        ends = {e.factor: e.swing.interval for e in model.effects}
        sure = {name for name, (low, high) in ends.items() if (low or 0.0) > 0.0 or (high or 0.0) < 0.0}
    shares = analysis.influence(response.name).items()
    named = [(name, value) for name, value in shares if value >= LEAST_SHARE and name in sure]
    return ", ".join(f"{name} {percent(min(value, 1.0), 0)}" for name, value in named[:3])


DASH = "\N{EN DASH}"


def number(value: float | None, digits: int = 4) -> str:
    """Return a number as text with ``digits`` significant digits, or a dash for None."""
    return DASH if value is None else significant(value, digits, floor=0.0)


def with_unit(value: float | None, unit: str, digits: int = 3) -> str:
    """Return a number as text with its unit."""
    sign = statistics.typeset(unit)
    space = "" if sign in ("°", "") else " "
    return f"{number(value, digits)}{space}{sign}"


def limits(interval: statistics.Interval) -> str:
    """Return an interval as text, with a question mark for an end that is unknown (None)."""
    low, high = interval
    if low is None and high is None:
        return ""
    if low is not None and high is not None:
        decimals = decimals_for(0.5 * abs(high - low))
        if decimals < 7 and max(abs(low), abs(high)) < 1e6:
            return f"{fixed(low, decimals)} … {fixed(high, decimals)}"
    return f"{'?' if low is None else number(low, 4)} … {'?' if high is None else number(high, 4)}"


def with_limits(value: statistics.Estimate | None) -> str:
    """Return an estimate with its confidence interval as text; the interval determines the number of decimals."""
    if value is None:
        return DASH
    low, high = value.interval
    if low is not None and high is None and value.value <= low:
        return f"> {number(low)}"
    half = value.half_width
    if half == 0.0:
        return number(value.value)
    if half is not None:
        decimals = decimals_for(half)
        if decimals < 7 and abs(value.value) < 1e6:
            return f"{fixed(value.value, decimals)} ({limits(value.interval)})"
    text = limits(value.interval)
    return f"{number(value.value)} ({text})" if text else number(value.value)


def share(value: statistics.Estimate | None) -> str:
    """Return a sensitivity index between 0 and 1 with its confidence interval as text, with three decimals."""
    if value is None:
        return DASH
    low, high = value.interval
    text = fixed(value.value, 3)
    return text if low is None or high is None else f"{text} ({fixed(low, 3)} … {fixed(high, 3)})"


def percent(value: float | None, decimals: int = 1) -> str:
    """Return a fraction as percent; values that would round to 0 or 100 without being equal get a sign < or >."""
    if value is None:
        return DASH
    least = 10.0 ** -(decimals + 2)
    if 0.0 < value < 0.5 * least:
        return f"< {fixed(100.0 * least, decimals)}%"
    if 1.0 - 0.5 * least < value < 1.0:
        return f"> {fixed(100.0 * (1.0 - least), decimals)}%"
    return f"{fixed(100.0 * value, decimals)}%"


def span(interval: tuple[float, float] | None) -> str:
    """Return an interval of a fraction as text in percent, or a dash for None."""
    return DASH if interval is None else f"{percent(interval[0])} … {percent(interval[1])}"


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, such as "1 run" and "2 runs"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
