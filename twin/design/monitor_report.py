"""Report of a search for a monitor's layout: Pareto front, limiting causes, drawings and the instruments' files."""

from math import sqrt

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from scenes.models.instrument_builder import build_instrument
from scenes.models.monitor_layout import layout_spec, number_of
from twin.design.layout_bench import LayoutFacts
from twin.design.layout_search import ALIKE, optima
from twin.design.monitor_design import GOAL_NAMES, UNITS, MonitorDesignRun, Point, verdict
from twin.framework.artefact import CameraFile, Cell, SvgFigure, Table, decimals_for, unit_for_reports
from twin.framework.report import Report, Section, answer
from twin.framework.svg import BLUE, GREY, INK, LIGHT, ORANGE, SKY, VERMILION, look, new_figure, plain_axes, to_svg
from twin.main_job.light_path_plots import side_view_svg
from twin.pictures.light_paths import trace_light_paths
from twin.sensors.area_detector import coarse_warnings


def monitor_design_report(run: MonitorDesignRun) -> Report:
    """Return the report: Pareto-optimal layouts, causes that limit them, drawings and the instruments' files."""
    setup, results = run.setup, run.results
    start, test = setup.instrument.name, setup.test
    rows = [_row(run, start, results.start), *(_row(run, point.name, point.facts) for point in run.points)]
    goals = (f"{GOAL_NAMES[g]}, σ [{unit_for_reports(UNITS[g][0])}]" for g in test.goal.wanted)
    costs = ("worst σ / goal", "pupil [%]", "prisms [kg]", "glass path [m]", "spots, σ [px]")
    heads = ("layout", "beams per end", *goals, *costs)
    goal_decimals = [
        decimals_for(min(run.worst(f, g) for _, f in _named(run)) / UNITS[g][1], 3) for g in test.goal.wanted
    ]
    decimals = (None, None, *goal_decimals, 2, 1, 1, 2, 1)
    priors = ", ".join(setup.disturbances)
    caption = f"One standard deviation, the worst over cameras and disturbances ({priors})."
    summary = Table("layouts", "The start and the layouts on the front", caption, heads, rows, decimals)
    best = run.points[0]
    with look("layouts"):
        front = SvgFigure("front", "Sigma against cost", _FRONT, to_svg(_front_figure(run)))
        pupils = SvgFigure("pupils", "Beams in the entrance pupil", _PUPILS, to_svg(_pupil_figure(run)))
    drawings = tuple(_drawing(run, point) for point in run.points[:2])
    remarks = (_search_text(run), *([starts_text(run)] if len(results.ends) > 1 else []))
    sections = (
        Section("The front", remarks, (front, _beams_table(run))),
        Section("Limiting causes", (), tuple(_cause_table(run, name) for name in setup.disturbances)),
        Section("The layouts", (), (pupils, *drawings)),
        Section(
            "The instruments",
            ("Each file can be named by a job of twin.render, or stand in scenes/library/instruments.",),
            tuple(
                CameraFile(p.name.lower(), p.name, f"The instrument of layout {p.name}.", p.text) for p in run.points
            ),
        ),
    )
    facts = (("start", start), ("disturbances", priors), ("best", best.name))
    lead = (f"The instrument of the best layout is artefacts/{best.name.lower()}.yaml.",)
    title = f"Layout of {test.name}"
    head, more = answer(*verdict(run))
    return Report(title, head, (*more, *lead), facts, summary, sections, warnings=coarse_warnings(run.setup))


_FRONT = (
    "Every feasible layout: its largest ratio of a standard deviation to its goal, against the share of the imaging "
    "pupil that its prisms block and against their mass. Named layouts are on the front: no other is better in all "
    "three."
)
"""Caption of the figure of accuracy against obstructed pupil fraction and mass."""
_PUPILS = "Seen along the light into the first camera; X points toward the central prism. Filled: left; open: right."
"""Caption of the figure of the beams' positions in the pupil."""


def _row(run: MonitorDesignRun, name: str, facts: LayoutFacts) -> list[str | int | float]:
    goals = [run.worst(facts, goal) / UNITS[goal][1] for goal in run.setup.test.goal.wanted]
    ends = [run.merit(facts), 100.0 * facts.pupil_share, facts.mass, facts.glass_path, facts.spot_sigma]
    return [name, len(facts.beams), *goals, *ends]


def _search_text(run: MonitorDesignRun) -> str:
    results = run.results
    tried, feasible, compared, built = map(results.total, ("tried", "feasible", "compared", "built"))
    text = (
        f"{tried} beams were evaluated alone, of which {feasible} are feasible; {compared} combinations were compared "
        f"and {built} built as a whole, {len(results.layouts)} of them feasible."
    )
    refused = sorted(results.refused.items(), key=lambda item: -item[1])[:3]
    if refused:
        text += (
            " Most frequent reasons of rejection: "
            + "; ".join(f"{reason} ({count})" for reason, count in refused)
            + "."
        )
    return text


def starts_text(run: MonitorDesignRun) -> str:
    """Return a sentence on whether all starts reach the same optimum."""
    groups, count = optima(run.results, run.bench), len(run.results.ends)
    infeasible = count - sum(len(group) for group in groups)
    best = [run.merit(group[0].layouts[0]) for group in groups]
    worst = max(run.merit(end.layouts[0]) for group in groups for end in group)
    if len(groups) == 1:
        text = f"All {count - infeasible} searches end within {100.0 * (worst / best[0] - 1.0):.2g} % of the same merit"
    else:
        texts = "; ".join(
            f"{value:.4g} ({', '.join(end.name for end in group)})" for value, group in zip(best, groups, strict=True)
        )
        text = (
            f"The searches end at {len(groups)} merits that differ by more than {100.0 * ALIKE:.0f} %: {texts}. There "
            "are several optima, or the searches were too short to converge"
        )
    return f"{text}; {infeasible} found no feasible layout." if infeasible else f"{text}."


def _beams_table(run: MonitorDesignRun) -> Table:
    heads = ("layout", "beam", "pupil x [mm]", "pupil y [mm]", "width [mm]", "field [deg]", "180° prism [m]")
    more = ("0° prism [m]", "shift [mm]", "facet x [mm]", "facet y [mm]", "photons [1e6]", "prisms", "area CCD")
    rows: list[list[Cell]] = []
    for name, facts in _named(run):
        for n, beam in enumerate(facts.beams, 1):
            mm = [1e3 * v for v in (beam.pupil_x, beam.pupil_y, beam.width)]
            rest = [1e3 * v for v in (beam.shift, beam.spread_x, beam.spread_y)]
            positions = [float(np.degrees(beam.field)), beam.prism_180_distance, beam.prism_0_distance]
            light = 1e-6 * number_of(run.setup, beam, "photons")
            rows.append([name, n, *mm, *positions, *rest, light, beam.prisms, beam.area_ccd])
    title = "Beams of the layouts"
    decimals = (None, None, 1, 1, 1, 3, 3, 3, 1, 1, 1, 1, None, None)
    return Table("beams", title, "Each is at both ends of both lines.", (*heads, *more), rows, decimals)


def _named(run: MonitorDesignRun) -> list[tuple[str, LayoutFacts]]:
    return [(run.setup.instrument.name, run.results.start), *((p.name, p.facts) for p in run.points)]


def _causes_of(run: MonitorDesignRun, facts: LayoutFacts, name: str, goal: str, measured: bool) -> dict[str, float]:
    """Return cause -> its contribution to the standard deviation of a goal's quantity, in the goal's unit.

    It is given for the camera in which the quantity is less accurate.
    """
    key = max(run.bench.goals_of(goal), key=lambda quantity: facts.sigmas[name][quantity])
    shares = (facts.shares if measured else facts.shares_before)[name][key]
    return {cause: sqrt(max(share, 0.0)) / UNITS[goal][1] for cause, share in shares.items()}


def _cause_table(run: MonitorDesignRun, name: str) -> Table:
    heads, columns = ["cause"], []
    for goal in run.setup.test.goal.wanted:
        unit = unit_for_reports(UNITS[goal][0])
        columns.append(_causes_of(run, run.results.start, name, goal, False))
        heads.append(f"{GOAL_NAMES[goal]}, unmeasured [{unit}]")
        for label, facts in _named(run)[:2]:
            columns.append(_causes_of(run, facts, name, goal, True))
            heads.append(f"{label} [{unit}]")
    causes = dict.fromkeys(cause for column in columns for cause in column)
    rows: list[list[Cell]] = [[cause, *(column.get(cause, 0.0) for column in columns)] for cause in causes]
    totals = [sqrt(sum(v * v for v in column.values())) for column in columns]
    rows.append(["together", *totals])
    decimals = (None, *(decimals_for(0.01 * total, 1) for total in totals))
    title = f"By cause: {name}"
    return Table(
        f"causes-{name.lower()}".replace("/", "-").replace(".", "-"), title, "σ.", tuple(heads), rows, decimals
    )


def _front_figure(run: MonitorDesignRun) -> Figure:
    """Plot the largest ratio of sigma to goal of all layouts against obstructed pupil fraction and against mass."""
    figure = new_figure(3.6)
    left, right = figure.subplots(1, 2, sharey=True)
    costs = (("share of the imaging pupil [%]", lambda f: 100.0 * f.pupil_share), ("prisms [kg]", lambda f: f.mass))
    for axes, (label, cost) in zip((left, right), costs, strict=True):
        layouts = run.results.layouts
        axes.plot(
            [cost(f) for f in layouts], [run.merit(f) for f in layouts], "o", ms=3.5, color=LIGHT, mec=GREY, mew=0.5
        )
        for k, point in enumerate(run.points):
            x, y = cost(point.facts), run.merit(point.facts)
            axes.plot([x], [y], "o", ms=6, color=VERMILION if k == 0 else BLUE)
            text = point.name.removeprefix(f"{run.points[0].name}_") if k else "best"
            above = k % 2 == 0  # neighbours on the front may stand close
            axes.annotate(text, (x, y), (5, 5) if above else (-9, -11), textcoords="offset points", fontsize=8)
        start = run.results.start
        axes.plot([cost(start)], [run.merit(start)], "s", ms=6, color=INK)
        axes.annotate(run.setup.instrument.name, (cost(start), run.merit(start)), (6, -10), textcoords="offset points")
        axes.axhline(1.0, color=ORANGE, lw=1.0)
        axes.set(xlabel=label, yscale="log")
        axes.grid(color=LIGHT, lw=0.4, which="both")
        axes.set_axisbelow(True)
        axes.margins(0.12)
        plain_axes(axes)
    left.annotate(
        "goal", (1.0, 1.0), (-2, 3), xycoords=("axes fraction", "data"), textcoords="offset points", ha="right"
    )
    left.set_ylabel("worst σ relative to the goal")
    return figure


def _pupil_figure(run: MonitorDesignRun) -> Figure:
    """Plot the positions of the beams in the entrance pupil, for the starting layout and each new one."""
    shown = _named(run)[:4]
    figure = new_figure(3.0)
    radius = 0.5e3 * next(iter(run.setup.cameras.values())).entrance_pupil
    panels = figure.subplots(1, len(shown), squeeze=False)[0]
    for axes, (name, facts) in zip(panels, shown, strict=True):
        axes.add_patch(Circle((0.0, 0.0), radius, fill=False, ec=INK, lw=1.2))
        for k, beam in enumerate(facts.beams):
            colour = (VERMILION, BLUE, ORANGE, SKY)[k % 4]
            for sign, fill in ((1.0, True), (-1.0, False)):
                centre = (1e3 * beam.pupil_x, sign * 1e3 * beam.pupil_y)
                axes.add_patch(Circle(centre, 0.5e3 * beam.width, fill=fill, fc=colour, ec=colour, alpha=0.7, lw=1.2))
        axes.set(xlim=(-1.1 * radius, 1.1 * radius), ylim=(-1.1 * radius, 1.1 * radius), aspect="equal", title=name)
        axes.set_xlabel("X [mm]")
        plain_axes(axes)
    panels[0].set_ylabel("Y, along the line [mm]")
    return figure


def _drawing(run: MonitorDesignRun, point: Point) -> SvgFigure:
    spec = layout_spec(run.setup, point.facts.beams)
    instrument = build_instrument(spec, run.setup.cameras, run.bench.backend)
    drawing = side_view_svg(instrument, trace_light_paths(instrument, run.bench.backend, {}))
    caption = "Base X-Z plane; all prisms, and the beams of the left end of each line."
    return SvgFigure(f"side-{point.name.lower()}", f"{point.name} from the side", caption, drawing)
