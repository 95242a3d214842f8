"""Report of a study: ``report.html``, the figures and tables in ``artefacts``, and ``statistics.json``."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.text import Text

from scenes.specs.study import SAMPLERS, FactorSpec, StudySpec
from scenes.yaml.errors import key_text
from twin.framework import page, run_folder, svg
from twin.framework.artefact import Cell, SvgFigure, Table, Undrawn, fixed, plain
from twin.framework.report import Report, Section
from twin.framework.run_folder import RunFolder
from twin.study.report import conclusions as words
from twin.study.report import study_analysis
from twin.study.report import study_plots as plots
from twin.study.report.sensitivity_indices import Indices
from twin.study.report.study_analysis import GOALS, StudyAnalysis
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
    (head, more), runs = words.verdict(analysis), analysis.runs
    about = (
        f"{words.plural(runs.count, 'run')} of {study.base.command}, {int(runs.failed.sum())} of them failed; "
        f"{words.design_title(runs.kind)}, seed {study.design.seed}."
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
    report = replace(report, warnings=(*input_warnings, *undrawn, *words.warnings(analysis)))
    contents = {artefact.file: artefact.content() for artefact in report.artefacts if artefact.within is None}
    contents[STATISTICS] = run_folder.json_text(report.with_verdict(study_analysis.STATISTICS(analysis))).encode()
    numbers = page.links((*files, "study.json", STATISTICS, "config.yaml"))
    contents["report.html"] = page.report_page(report, (PROGRAM, "config.yaml"), [("Numbers", numbers)]).encode()
    return StudyReport(head, contents, undrawn, report.warnings)


MOST_NAMED = 6
"""Largest number of a factor's values that the table of factors lists one by one."""
STATISTICS = "statistics.json"
"""Name of the file with all digits of those tables that show rounded numbers and have no file of their own."""


def _factor_table(runs: StudyRuns) -> Table:
    """Return the table of factors: name, key in the base job, distribution, and the values of the runs."""
    rows: list[list[Cell]] = []
    for factor in runs.factors:
        positions = [key_text(key) for key in factor.spec.key_paths]
        positions += [f"{key_text(scale.key)} (power {scale.power:g})" for scale in factor.spec.scales]
        rows.append([factor.name, typeset(factor.unit), "; ".join(positions), _source(factor.spec), _values(factor)])
    heads = ("factor", "unit", "in the base", "distribution", "values run")
    return Table("factors", "", "Varied factors.", heads, rows, within="config.yaml")


def _source(spec: FactorSpec) -> str:
    if spec.kind == "table":
        assert spec.table is not None
        return f"table {spec.table.file}, column {spec.table.column}"
    if spec.kind == "values":
        return f"list of {words.plural(len(spec.scalars()), 'value')}"
    values = [plain(value, 6) for value in spec.numbers().values]
    if spec.kind == "normal":
        return f"normal, mean {values[0]}, σ {values[1]}"
    if spec.kind == "truncated":
        return f"normal, mean {values[0]}, σ {values[1]}, cut to {values[2]} … {values[3]}"
    if spec.kind in ("range", "uniform"):
        return f"{spec.kind}, {values[0]} … {values[1]}"
    raise KeyError(f"a factor of kind {spec.kind!r} has no words")


def _values(factor: Factor) -> str:
    levels = factor.levels
    if not factor.numeric:
        named = [str(level) for level in levels[:MOST_NAMED]]
        return ", ".join(named) + (f" and {len(levels) - MOST_NAMED} more" if len(levels) > MOST_NAMED else "")
    if len(levels) <= MOST_NAMED:
        return ", ".join(plain(float(level), 6) for level in levels)
    return f"{plain(float(np.min(levels)), 5)} … {plain(float(np.max(levels)), 5)}"


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
        estimates = [words.with_limits(e) for e in (d.mean, d.std, d.median, d.p95, d.p997)]
        normal = [words.DASH if d.normality is None else f"{d.normality.p:.2g}"] * sampled
        ends = words.number(d.low), words.number(d.high)
        rows.append([r.name, typeset(r.unit), d.count, *estimates, *ends, *normal, words.main_factors(analysis, r)])
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
    failed = int(analysis.runs.failed.sum())
    lacking = any(r.bounds is not None for r in analysis.requirements)
    rows: list[list[Cell]] = [
        [
            r.name or "all",
            r.text,
            typeset(r.unit),
            r.met,
            r.count,
            words.percent(r.share),
            words.span(r.interval),
            *((words.DASH if r.bounds is None else f"{r.met} … {r.most} of {r.runs}",) if lacking else ()),
            *((words.span(r.bounds_interval),) if lacking else ()),
            *(
                words.number(estimate.value if estimate else None)
                for estimate in (r.judged and r.judged.p95, r.judged and r.judged.p997)
            ),
        ]
        for r in analysis.requirements
    ]
    how = (
        "The interval is Clopper and Pearson's, 95%."
        if analysis.runs.sampled
        else "A grid is not a sample: no interval."
    )
    failed_text = f" {failed} failed runs are not counted." if failed else ""
    more = ("all runs, if none … all without a value meet it", "interval of all runs") if lacking else ()
    caption = (
        f"Over the runs with a finite value.{failed_text} {how} The last columns are quantiles of the response or its "
        "absolute value."
    )
    heads = ("requirement", "", "unit", "met", "of", "share", "interval", *more, "95%", "99.7%")
    title = "Share of the runs that meet them"
    return Section("Requirements", (), (Table("requirements", title, caption, heads, rows, within=STATISTICS),))


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
        texts.append(f"{r.name} {words.percent(max(model.adjusted, 0.0))}")
        for e in model.effects:
            ends = " … ".join(end if isinstance(end, str) else words.number(end, 3) for end in e.span)
            swing = words.with_limits(e.swing) if sampled else words.number(e.swing.value)
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
        return words.DASH
    return words.with_limits(estimate) if sampled else words.number(estimate.value, 3)


def _indices(analysis: StudyAnalysis) -> Section | None:
    if not analysis.runs.study.report.sobol:
        return None
    remarks = words.index_remarks(analysis)
    chaos = analysis.runs.sampled
    rows: list[list[Cell]] = []
    for r in analysis.runs.everything:
        part = analysis.indices[r.name]
        if not isinstance(part, Indices):
            continue
        for index in part.axes:
            check = words.DASH if index.check is None else fixed(index.check, 2)
            rows.append(
                [r.name, index.name, words.share(index.first), words.share(index.total), *([check] if chaos else [])]
            )
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
        [name, _STATISTICS[c.name], words.number(c.relative, 2), GOALS[c.name], "yes" if c.enough else "no", c.needed]
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
