"""What the report says of readings and truth: result, time course, spots, residuals."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from scenes.specs.course import moment
from twin.framework.artefact import (
    FAR,
    MINUS,
    Artefact,
    Cell,
    Marked,
    SvgFigure,
    Table,
    Text,
    decimals_for,
    fixed,
    residual,
    residual_cell,
    residual_text,
)
from twin.framework.report import Section
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.systematics import assumed, course_agrees, joined, systematics
from twin.monitor.reading_table import Reading, ReadingTable
from twin.monitor.time_series import TimeSeries

IN_PAGE = ""
"""File of what only the page shows."""
_GROUND_TITLE = "Points on the ground, located as if the cameras had not changed: error"
_ANGLE_TITLE = "Angle between the cameras"


def figure(
    drawn: Mapping[str, str], name: str, caption: str, title: str = "", full: Table | None = None, count: int = 0
) -> SvgFigure:
    """A drawing of the run in the page, the ``count``-th of its kind."""
    own = name.partition(" ")[0] + f"-{count}" * (" " in name)
    return SvgFigure(own, title, caption, drawn[name], within=IN_PAGE, full=full)


def shown_time(run: JobRun) -> str:
    """``, at 12 min``: the time of a course that a run shows in full; empty without a course."""
    if not isinstance(run, RenderRun):
        return ""
    return "" if run.series is None else f", at {moment(float(run.series.times[run.series.shown]))}"


def result_tables(run: JobRun) -> tuple[Table, ...]:
    """Recovered against true; of a course first the errors over all its times, then one of these times. Without a
    monitor the true changes alone.
    """
    if not isinstance(run, RenderRun):
        return (_change_table(run),)
    if run.series is None:
        return (_state_table(run, "results", "Recovered against true"),)
    return _course_table(run, run.series), _state_table(run, "shown_time", "")


def _change_table(run: JobRun) -> Table:
    """True changes of the cameras, of the angle between two, and on the ground."""
    rows: list[list[Cell]] = []
    bands: dict[int, str] = {}
    for group, one, value in run.true_changes():
        title = {ANGLE_GROUP: _ANGLE_TITLE, GROUND_GROUP: _GROUND_TITLE}.get(group, f"Camera {group}")
        if title not in bands.values():
            bands[len(rows)] = title
        key = f"{group}.{one.key}"
        label = Marked(one.label, one.meaning, "text")
        rows.append([label, Marked(fixed(value, one.decimals, sign=True), "", "truth", key)])
    full: list[list[Cell]] = [[group, one.symbol, one.unit, value] for group, one, value in run.true_changes()]
    return Table(
        "results",
        "What changed, by exact chief rays",
        "Perturbed minus nominal. Angles are right-handed about the camera's own axes; Δf is in pixels of its line.",
        ("Parameter", "change"),
        rows,
        bands=bands,
        within=IN_PAGE,
        full=Table("results", "Results", "", ["of", "parameter", "unit", "change"], full),
    )


def part_title(run: RenderRun, reading: Reading, nominal: bool = True) -> str:
    """What a reading and those beside it are about: a camera, the angle of two (``nominal``: and what it is), or points
    on the ground.
    """
    if reading.group == GROUND_GROUP:
        return _GROUND_TITLE
    if reading.camera:
        return f"Camera {reading.camera}"
    return f"{_ANGLE_TITLE}, nominally {fixed(float(np.degrees(run.truth.angle)), 4)}°" if nominal else _ANGLE_TITLE


def _label(reading: Reading) -> Marked:
    return Marked(reading.parameter.label, reading.parameter.meaning, "text")


def _all_digits(run: RenderRun, name: str, found: ReadingTable, over: bool) -> Table:
    """A row for each change: truth, and of each estimator value (over times its error), sigma and that of the noise."""
    heads = ["camera", "parameter", "unit", "true rms" if over else "true"]
    heads += _value_and_sigma(run, " error rms" if over else "")
    rows: list[list[Cell]] = []
    for same in found.by_change():
        first = same[0]
        row: list[Cell] = [first.where, first.parameter.symbol, first.parameter.unit, first.true]
        for one in same:
            row += [one.error if over else one.value, one.sigma, one.noise]
        rows.append(row)
    return Table(name, name, "", heads, rows)


def _value_and_sigma(run: RenderRun, label: str) -> list[str]:
    """Value, total sigma and noise sigma of each estimator."""
    said = (label, " sigma", " sigma noise")
    return [f"{estimator.title}{what}" for estimator in run.estimators.values() for what in said]


def _state_table(run: RenderRun, name: str, title: str) -> Table:
    found = run.reading.table
    rows: list[list[Cell]] = []
    bands: dict[int, str] = {}
    good = dict.fromkeys(run.estimators, 0)
    stated = run.experiment.stated is not None
    for same in found.by_change():
        first, p = same[0], same[0].parameter
        heading = part_title(run, first)
        if heading not in bands.values():
            bands[len(rows)] = heading
        key = first.group if first.where == "both" else f"{first.group}.{p.key}"
        finest = min((one.sigma for one in same if one.sigma > 0), default=0.0)
        row: list[Cell] = [_label(first), Marked(fixed(first.true, decimals_for(finest)), "", "truth", f"{key}.true")]
        for one in same:
            ratio = residual(one.error, one.sigma)
            good[one.estimator] += ratio is None or abs(ratio) <= FAR
            hint = f"σ of noise alone: {fixed(one.noise, decimals_for(one.noise))} {p.unit}"
            text = f"{one.shown(one.value)} ± {one.shown(one.sigma)}"
            row.append(residual_cell(text, ratio, f"{key}.{one.estimator}", hint))
        if stated:
            noise = next(one.noise for one in same if one.estimator == run.judged)
            row.append(Marked(fixed(noise, decimals_for(noise)), "", "number", f"{key}.noise"))
        rows.append(row)
    heads = ["Parameter", "true", *(estimator.title for estimator in run.estimators.values())]
    within = ", ".join(f"{e.title} {good[name]} of {len(rows)}" for name, e in run.estimators.items())
    caption = (
        f"± is one standard deviation. {assumed(run.reading)}. "
        + ("The noise's part of other estimators is shown by pointing at a value. " if stated else "")
        + f"Below each value (recovered − true) in σ, ● within {FAR:g} σ, ▲ beyond. Within {FAR:g} σ: {within}."
    )
    return Table(
        "recovered",
        title,
        caption,
        [*heads, *([f"σ of noise, {run.estimators[run.judged].title}"] if stated else ())],
        rows,
        bands=bands,
        within=IN_PAGE,
        full=_all_digits(run, name, found, False),
    )


def _course_table(run: RenderRun, series: TimeSeries) -> Table:
    rows: list[list[Cell]] = []
    bands: dict[int, str] = {}
    found = series.readings.rms
    for same in found.by_change():
        first = same[0]
        values = series.readings.row(first.group, first.parameter.key, first.estimator).true
        heading = part_title(run, first, nominal=False)
        if heading not in bands.values():
            bands[len(rows)] = heading
        key = f"course.{first.camera}.{first.parameter.key}" if first.camera else "course.angle"
        finest = decimals_for(min(one.sigma for one in same))
        row: list[Cell] = [_label(first), Marked(_range(values, finest), "", "truth", f"{key}.true")]
        for one in same:
            far = one.sigma > 0.0 and one.far
            below = f"{'▲' if far else '●'} σ {one.shown(one.sigma)}"
            row.append(Marked(one.shown(one.error), below, "far" if far else "near", f"{key}.{one.estimator}"))
        rows.append(row)
    return Table(
        "errors",
        "Errors over all times: root mean square of (recovered − true), and of σ",
        f"● error within {FAR:g} σ, ▲ beyond: more than σ allows. {_worst(run, series)}",
        ["Parameter", "true, range", *(estimator.title for estimator in run.estimators.values())],
        rows,
        bands=bands,
        within=IN_PAGE,
        full=_all_digits(run, "results", found, True),
    )


def _range(values: np.ndarray, places: int) -> str:
    low, high = (fixed(float(end), places) for end in (values.min(), values.max()))
    low, high = low.strip(MINUS) if not low.strip(f"{MINUS}0.") else low, high
    return low if low == high else f"{low} … {high}"


def _worst(run: RenderRun, series: TimeSeries) -> str:
    """The camera that the judged estimator reads worst in Δα, by how much, when, and how much truly happened."""
    own = [row for row in series.readings.of(run.judged) if row.parameter.key == "d_alpha_arcsec"]
    worst = max(own, key=lambda row: float(np.max(np.abs(row.error))))
    k = int(np.argmax(np.abs(worst.error)))
    places = decimals_for(float(worst.sigma[k]))
    error, true = (fixed(float(number[k]), places, sign=True) for number in (worst.error, worst.true))
    return (
        f"The largest error of Δα by {run.estimators[run.judged].title} is {error} arcsec, camera {worst.camera} at "
        f"{moment(float(series.times[k]))}, where it truly is {true} arcsec."
    )


def course_sections(run: RenderRun, drawn: Mapping[str, str], shown: Table) -> tuple[Section, ...]:
    """Figures of a course, and its one time that the other sections show.

    Args:
        run: with a course.
        drawn: name -> <svg> element of its figures.
        shown: table of that time.
    """
    series = run.series
    assert series is not None
    files = ", ".join(f"`images/{c.camera}_{c.name}_course.tiff`" for c in run.experiment.path.channels)
    parts: list[Artefact] = [
        figure(
            drawn,
            "course",
            f"True changes (line) and what every estimator reads in {run.frames} frames of each of {len(series.times)} "
            "times (marks, side by side), with bars of one σ where they are larger than the marks. "
            f"{assumed(run.reading)}. Where marks leave the line, the monitor takes something else for a change of the "
            "camera.",
            full=_every_time(run),
        )
    ]
    if series.smoothed is not None:
        parts.append(
            figure(
                drawn,
                "smoothed",
                "Errors of the smoothed changes, with the total sigma that the smoother states: from all measurements "
                f"together, by the disturbances {series.smoothed.name} and how they go on in time. Between the "
                "measurements the band says how well the cameras are known there. "
                f"{course_agrees(series.smoothed, series.times)}",
            )
        )
    parts.append(
        figure(
            drawn,
            "temperatures",
            "Temperatures that were given, perturbation included: change at each body's origin and gradient along the "
            "axes of its own frame. What a body carries inherits its field. Dotted: "
            f"{shown_time(run).removeprefix(', at ')}, the time that the other sections show. All numbers: "
            f"`course.json`. Expected images: `course.nc`. The first of the {run.frames} frames of every time, one "
            f"page each: {files}.",
            "Temperatures and files",
        )
    )
    return (
        Section("Time course", (), tuple(parts), 1, "course"),
        Section(f"Recovered against true{shown_time(run)}", (), (shown,), name="shown"),
    )


def _every_time(run: RenderRun) -> Table:
    """Every reading of every time, with all digits."""
    assert run.series is not None
    rows: list[list[Cell]] = []
    for same in run.series.readings.by_change():
        first = same[0]
        columns = [first.true, *(number for row in same for number in (row.value, row.sigma, row.noise))]
        told = (first.camera, first.parameter.symbol, first.parameter.unit)
        times = zip(run.series.times, *columns, strict=True) if first.camera else ()
        rows += [[float(time), *told, *map(float, numbers)] for time, *numbers in times]
    heads = ["time [s]", "camera", "parameter", "unit", "true", *_value_and_sigma(run, "")]
    return Table("course", "Course", "", heads, rows)


def spot_section(run: RenderRun, drawn: Mapping[str, str]) -> Section:
    """Images of the spots, their measured positions and shifts; figures as ``spots NAME`` of each camera."""
    figures: list[Artefact] = []
    for k, name in enumerate(run.experiment.instrument.cameras):
        caption = f"Camera {name}: mean of {run.frames} frames."
        if k == 0:
            caption += (
                " Crosses: measured centres before (light blue) and after (orange-red), known to some thousandths of a "
                "pixel; the third column shows the core with both. One asinh stretch for all grey images, one "
                "symmetric scale for the differences."
            )
        figures.append(figure(drawn, f"spots {name}", caption, count=k))
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []
    found, pitch = run.recovery, 1e6 * run.experiment.path.pitch
    for i, channel in enumerate(run.experiment.path.channels):
        for k, axis in enumerate(("row", "column")):
            before, after = float(found.before[0, i, k]), float(found.after[0, i, k])
            start, end = float(found.sigma_before[0, i, k]), float(found.sigma_after[0, i, k])
            sigma = float(found.shift_covariance[0, 2 * i + k, 2 * i + k]) ** 0.5
            shift = after - before
            told = (
                ("before", _with_sigma(before, start)),
                ("after", _with_sigma(after, end)),
                ("shift_px", _with_sigma(shift, sigma, sign=True)),
                ("shift_um", _with_sigma(shift * pitch, sigma * pitch, sign=True)),
            )
            cells = [Marked(text, "", "number", f"{channel.key}.{axis}.{what}") for what, text in told]
            rows.append([f"{channel.camera} {channel.name}", axis, *cells])
            full.append([channel.key, axis, before, start, after, end, shift, sigma, shift * pitch, sigma * pitch])
    heads = ["channel", "axis", "before [px]", "sigma [px]", "after [px]", "sigma [px]", "shift [px]", "sigma [px]"]
    heads += ["shift [µm]", "sigma [µm]"]
    positions = Table(
        "spots",
        "Spot positions, pixel coordinates, and their shifts",
        f"{pitch:g} µm pixels, pixel (0, 0) at the upper left. A column is along the camera's X (flight direction), a "
        "row along its Y (the line CCD). Left is the +Y end of the line. Sigma of a shift: the noise of both "
        "positions, without the pixel pattern that both share.",
        ("Channel", "Axis", "before [px]", "after [px]", "shift [px]", "shift [µm]"),
        rows,
        within=IN_PAGE,
        full=Table("spots", "Spots", "", heads, full),
    )
    return Section("Spots", (), (*figures, positions), 1, "spots")


def _with_sigma(value: float, sigma: float, sign: bool = False) -> str:
    places = decimals_for(sigma)
    return f"{fixed(value, places, sign)} ± {fixed(sigma, places)}"


def residual_section(run: RenderRun, drawn: Mapping[str, str]) -> Section:
    """Residuals of all estimators, and what the crosstalk table explains of the judged one's; what is left over is
    noise, and judged by it alone.
    """
    title = run.estimators[run.judged].title
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []
    notes = []
    own = [r for r in run.reading.table.of(run.judged) if r.camera]
    for name in run.experiment.instrument.cameras:
        found = systematics(run, name)
        for k, r in enumerate(one for one in own if one.camera == name):
            bias, places = float(found.bias[run.judged][k]), decimals_for(r.noise)
            error, expected, left = (fixed(v, places, sign=True) for v in (r.error, bias, r.error - bias))
            texts = (error, residual_text(residual(r.error, r.sigma)), expected, left)
            cells = [Marked(text, "", "number") for text in texts]
            judged = residual_cell("", residual(r.error - bias, r.noise), "")
            rows.append([name, r.parameter.label, *cells, judged])
            row: list[Cell] = [name, r.parameter.symbol, r.parameter.unit, r.error, r.sigma, r.noise]
            full.append([*row, bias, r.error - bias])
        outside, uncovered = joined(found.outside), joined(found.uncovered)
        said = f"moved outside the family: {outside}." if outside else ""
        said = "nothing moved outside the family." if not outside and not uncovered else said
        if uncovered:
            said += f" Moved but in no row of the table, so that its effect is left over: {uncovered}."
        notes.append(f"{name}: {said.strip()}")
    heads = ["camera", "parameter", "unit", f"{title} - true", "sigma", "sigma noise", "expected from the crosstalk"]
    stated = run.experiment.stated is not None
    far = (
        "Far outside: more moved than is stated, or something else."
        if stated
        else "Inside the band: noise. Far outside: the formula has another factor, or something moved that the "
        "estimators do not assume."
    )
    caption = f"Recovered minus true in σ; shaded ±{FAR:g} σ. {assumed(run.reading)}. {far}"
    drawing = figure(drawn, "residuals", caption)
    table = Table(
        "explained",
        f"Residuals of {title}, and how much of them the crosstalk table explains",
        "",
        (
            *("Camera", "Parameter", f"{title} − true", "in σ", "expected from the crosstalk table", "left over"),
            "of noise",
        ),
        rows,
        within=IN_PAGE,
        full=Table("residuals", "Residuals", "", [*heads, "left over"], full),
    )
    moved = Text("moved", "What moved beside what the estimators assume", "", notes, within=IN_PAGE)
    return Section("Residuals", (), (drawing, table, moved), 2, "residuals")
