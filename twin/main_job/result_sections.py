"""Report sections on set-up, results, time series, spots, and the errors of the estimates of the main job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from analysis.arrays import ARCSEC
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from analysis.spots import CENTROIDS
from optics.geometry.tree import Motion
from optics.thermal.heat import Temperature
from scenes.models.disturbances import Component
from scenes.models.job_state import motions_of
from scenes.specs.course import moment
from scenes.specs.disturbances import JOINT
from scenes.specs.perturbation import perturbation_text
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
    plain,
    residual,
    residual_cell,
    residual_text,
    unit_for_reports,
)
from twin.framework.report import Section
from twin.main_job.render_results import JobRun, RenderRun
from twin.main_job.systematics import assumed, course_agrees, joined, systematics
from twin.monitor.reading_table import Reading, ReadingTable
from twin.monitor.time_series import TimeSeries

IN_PAGE = ""
"""Empty file name, for artefacts that appear only in the report page."""
_GROUND_TITLE = "Errors on the ground if changes are ignored"
_ANGLE_TITLE = "Angle between the cameras"


def figure(
    drawn: Mapping[str, str], name: str, caption: str, title: str = "", full: Table | None = None, count: int = 0
) -> SvgFigure:
    """Return a drawing of the run as a figure of the report page.

    Parameters
    ----------
    drawn : Mapping[str, str]
        Name -> <svg> element of each drawing.
    name : str
        Name of the drawing.
    caption : str
        Text below the figure.
    title : str
        Title of the figure.
    full : Table or None
        Table with all numbers of the figure.
    count : int
        Number of this figure among several of its kind.
    """
    file_name = name.partition(" ")[0] + f"-{count}" * (" " in name)
    return SvgFigure(file_name, title, caption, drawn[name], within=IN_PAGE, full=full)


def shown_time(run: JobRun) -> str:
    """Return the time of a time series that a run shows in full, as ``, at 12 min``; empty for a single state."""
    if not isinstance(run, RenderRun):
        return ""
    return "" if run.series is None else f", at {moment(float(run.series.times[run.series.shown]))}"


def result_tables(run: JobRun) -> tuple[Table, ...]:
    """Return the tables of recovered and true changes.

    For a time series, the errors over all its times come first, then the time that is shown; without a monitor there
    are only true changes.
    """
    if not isinstance(run, RenderRun):
        return (_change_table(run),)
    if run.series is None:
        return (_state_table(run, "results", "Recovered against true"),)
    return _course_table(run, run.series), _state_table(run, "shown_time", "")


def _change_table(run: JobRun) -> Table:
    """Return the table of true changes of the cameras, of the angle between two, and on the ground."""
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []
    titles = []
    for group, parameter, value in run.true_changes():
        titles.append({ANGLE_GROUP: _ANGLE_TITLE, GROUND_GROUP: _GROUND_TITLE}.get(group, f"Camera {group}"))
        change = Marked(fixed(value, parameter.decimals, sign=True), "", "truth", f"{group}.{parameter.key}")
        rows.append([Marked(parameter.label, parameter.meaning, "text"), change])
        full.append([group, parameter.symbol, parameter.unit, value])
    return Table(
        "results",
        "Changes, by exact chief rays",
        "Perturbed minus nominal. Angles are right-handed about the camera's axes; Δf refers to pixels of its line.",
        ("Parameter", "change"),
        rows,
        bands=_bands(titles),
        within=IN_PAGE,
        full=Table("results", "Results", "", ["of", "parameter", "unit", "change"], full),
    )


def _bands(titles: Sequence[str]) -> dict[int, str]:
    """Return number of the first row -> title, from the titles of all rows of a table, one after the other."""
    return {k: title for k, title in enumerate(titles) if title not in titles[:k]}


def part_title(run: RenderRun, reading: Reading, nominal: bool = True) -> str:
    """Return the heading of a group of changes: a camera, the angle between two, or points on the ground.

    The angle's heading has its nominal value if ``nominal`` is set.
    """
    if reading.group == GROUND_GROUP:
        return _GROUND_TITLE
    if reading.camera:
        return f"Camera {reading.camera}"
    return f"{_ANGLE_TITLE}, nominally {fixed(float(np.degrees(run.truth.angle)), 4)}°" if nominal else _ANGLE_TITLE


def _label(reading: Reading) -> Marked:
    return Marked(reading.parameter.label, reading.parameter.meaning, "text")


def _all_digits(run: RenderRun, name: str, table: ReadingTable, over: bool) -> Table:
    """Return a table of all changes with all digits: true value, and each estimator's value, sigma and noise sigma.

    If ``over`` is set, the table is over a time series and holds RMS errors instead of values.
    """
    heads = ["camera", "parameter", "unit", "true rms" if over else "true"]
    heads += _value_and_sigma(run, " error rms" if over else "")
    rows: list[list[Cell]] = []
    for rows_of_change in table.by_change():
        first = rows_of_change[0]
        row: list[Cell] = [first.where, first.parameter.symbol, first.parameter.unit, first.true]
        for reading in rows_of_change:
            row += [reading.error if over else reading.value, reading.sigma, reading.noise]
        rows.append(row)
    return Table(name, name, "", heads, rows)


def _value_and_sigma(run: RenderRun, label: str) -> list[str]:
    """Return the column names for value, total sigma and noise sigma of each estimator."""
    labels = (label, " sigma", " sigma noise")
    return [f"{estimator.title}{what}" for estimator in run.estimators.values() for what in labels]


def _state_table(run: RenderRun, name: str, title: str) -> Table:
    table = run.reading.table
    rows: list[list[Cell]] = []
    good = dict.fromkeys(run.estimators, 0)
    has_prior = run.experiment.prior is not None
    for rows_of_change in table.by_change():
        first, p = rows_of_change[0], rows_of_change[0].parameter
        key = first.group if first.where == "both" else f"{first.group}.{p.key}"
        finest = min((reading.sigma for reading in rows_of_change if reading.sigma > 0), default=0.0)
        row: list[Cell] = [_label(first), Marked(fixed(first.true, decimals_for(finest)), "", "truth", f"{key}.true")]
        for reading in rows_of_change:
            ratio = residual(reading.error, reading.sigma)
            good[reading.estimator] += ratio is None or abs(ratio) <= FAR
            hint = f"σ of noise alone: {fixed(reading.noise, decimals_for(reading.noise))} {p.unit}"
            text = f"{reading.shown(reading.value)} ± {reading.shown(reading.sigma)}"
            row.append(residual_cell(text, ratio, f"{key}.{reading.estimator}", hint))
        if has_prior:
            noise = next(reading.noise for reading in rows_of_change if reading.estimator == run.judged)
            row.append(Marked(fixed(noise, decimals_for(noise)), "", "number", f"{key}.noise"))
        rows.append(row)
    heads = ["Parameter", "true", *(estimator.title for estimator in run.estimators.values())]
    within = ", ".join(f"{e.title} {good[name]} of {len(rows)}" for name, e in run.estimators.items())
    caption = (
        f"± is one standard deviation. {assumed(run.reading)}. "
        + ("The noise part of other estimators is shown when pointing at a value. " if has_prior else "")
        + f"Below each value (recovered − true) in σ, ● within {FAR:g} σ, ▲ beyond. Within {FAR:g} σ: {within}."
    )
    heads += [f"σ of noise, {run.estimators[run.judged].title}"] if has_prior else []
    bands, full = (
        _bands([part_title(run, first) for first, *_ in table.by_change()]),
        _all_digits(run, name, table, False),
    )
    return Table("recovered", title, caption, heads, rows, bands=bands, within=IN_PAGE, full=full)


def _course_table(run: RenderRun, series: TimeSeries) -> Table:
    rows: list[list[Cell]] = []
    table = series.readings.rms
    for rows_of_change in table.by_change():
        first = rows_of_change[0]
        values = series.readings.row(first.group, first.parameter.key, first.estimator).true
        key = f"course.{first.camera}.{first.parameter.key}" if first.camera else "course.angle"
        finest = decimals_for(min(reading.sigma for reading in rows_of_change))
        row: list[Cell] = [_label(first), Marked(_range(values, finest), "", "truth", f"{key}.true")]
        for reading in rows_of_change:
            mark, kind = ("▲", "far") if reading.sigma > 0.0 and reading.far else ("●", "near")
            below = f"{mark} σ {reading.shown(reading.sigma)}"
            row.append(Marked(reading.shown(reading.error), below, kind, f"{key}.{reading.estimator}"))
        rows.append(row)
    return Table(
        "errors",
        "Errors over all times: root mean square of (recovered − true), and of σ",
        f"● error within {FAR:g} σ, ▲ beyond. {_worst(run, series)}",
        ["Parameter", "true, range", *(estimator.title for estimator in run.estimators.values())],
        rows,
        bands=_bands([part_title(run, first, nominal=False) for first, *_ in table.by_change()]),
        within=IN_PAGE,
        full=_all_digits(run, "results", table, True),
    )


def glance_figure(run: RenderRun, drawn: Mapping[str, str]) -> SvgFigure:
    """Return the figure of all spots before and after, for the first screen of the page."""
    caption = (
        f"Mean of {run.frames} frames. Crosses: measured centres before (light blue) and after (orange-red), "
        "with their shift below. All images have the same scale and stretch."
    )
    return figure(drawn, "glance", caption, f"Spots before and after{shown_time(run)}")


def glance_table(run: RenderRun) -> Table:
    """Return the table of true and recovered changes by the estimator that the verdict uses.

    For a time series it has RMS values over all times.
    """
    over, estimator = run.series is not None, run.estimators[run.judged]
    readings = run.series.readings.rms if run.series is not None else run.reading.table
    rows: list[list[Cell]] = []
    for reading in readings.of(run.judged):
        label = Marked(reading.parameter.label, "", "text", hint=reading.parameter.meaning)
        shown = reading.shown(reading.error if over else reading.value)
        ratio = residual(reading.error, reading.sigma)
        cell = residual_cell(f"{shown} ± {reading.shown(reading.sigma)}", ratio, "")
        rows.append([label, Marked(reading.shown(reading.true), "", "truth"), cell])
    over_text = "Root mean squares over all times, of errors and of σ. " if over else "± is one σ. "
    caption = f"{over_text}● within {FAR:g} σ of the truth, ▲ beyond."
    heads = ("Parameter", "true, RMS" if over else "true", f"error by {estimator.title}" if over else estimator.title)
    title = f"Recovered by the {estimator.title}"
    full = _all_digits(run, "glance", readings, over)
    bands = _bands([part_title(run, reading, nominal=False) for reading in readings.of(run.judged)])
    return Table("glance-table", title, caption, heads, rows, bands=bands, within=IN_PAGE, full=full)


def _range(values: np.ndarray, decimals: int) -> str:
    low, high = (fixed(float(end), decimals) for end in (values.min(), values.max()))
    low, high = low.strip(MINUS) if not low.strip(f"{MINUS}0.") else low, high
    return low if low == high else f"{low} … {high}"


def _worst(run: RenderRun, series: TimeSeries) -> str:
    """Return a sentence with the largest error in d_alpha of the estimator that the verdict uses.

    It names the camera, the size, the time and the true change.
    """
    candidates = [row for row in series.readings.of(run.judged) if row.parameter.key == "d_alpha_arcsec"]
    worst = max(candidates, key=lambda row: float(np.max(np.abs(row.error))))
    k = int(np.argmax(np.abs(worst.error)))
    decimals = decimals_for(float(worst.sigma[k]))
    error, true = (fixed(float(number[k]), decimals, sign=True) for number in (worst.error, worst.true))
    return (
        f"The largest error of Δα by {run.estimators[run.judged].title} is {error} arcsec, camera {worst.camera} at "
        f"{moment(float(series.times[k]))}, where the true change is {true} arcsec."
    )


def course_sections(run: RenderRun, drawn: Mapping[str, str], shown: Table) -> tuple[Section, ...]:
    """Return the sections with figures of a time series and with the time that the other sections show.

    Parameters
    ----------
    run : RenderRun
        Run with a time series.
    drawn : Mapping[str, str]
        Name -> <svg> element of its figures.
    shown : Table
        Table of the time that is shown.
    """
    series = run.series
    assert series is not None
    files = ", ".join(f"`images/{c.camera}_{c.name}_course.tiff`" for c in run.experiment.path.channels)
    parts: list[Artefact] = [
        figure(
            drawn,
            "course",
            f"True changes (line) and readings of every estimator from {run.frames} frames at each of "
            f"{len(series.times)} times (marks, side by side), with bars of one σ where they are larger than the "
            f"marks. {assumed(run.reading)}. Where marks leave the line, the monitor misreads another motion as a "
            "change of the camera.",
            full=_table_of_all_times(run),
        )
    ]
    if series.smoothed is not None:
        parts.append(
            figure(
                drawn,
                "smoothed",
                "Errors of the smoothed changes, with the smoother's total sigma: from all measurements together, by "
                f"the disturbances {series.smoothed.name} and their time laws. Between the measurements, the band "
                "shows how well the cameras are known. "
                f"{course_agrees(series.smoothed, series.times)}",
            )
        )
    parts.append(
        figure(
            drawn,
            "temperatures",
            "Temperatures of the job, perturbation included: change at each body's origin and gradient along the "
            "axes of its frame. Bodies that it carries inherit its field. Dotted: "
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


def _table_of_all_times(run: RenderRun) -> Table:
    """Return the table of every estimated change at every time, with all digits."""
    assert run.series is not None
    rows: list[list[Cell]] = []
    for rows_of_change in run.series.readings.by_change():
        first = rows_of_change[0]
        columns = [first.true, *(number for row in rows_of_change for number in (row.value, row.sigma, row.noise))]
        labels = (first.camera, first.parameter.symbol, first.parameter.unit)
        times = zip(run.series.times, *columns, strict=True) if first.camera else ()
        rows += [[float(time), *labels, *map(float, numbers)] for time, *numbers in times]
    heads = ["time [s]", "camera", "parameter", "unit", "true", *_value_and_sigma(run, "")]
    return Table("course", "Course", "", heads, rows)


def spot_section(run: RenderRun, drawn: Mapping[str, str]) -> Section:
    """Return the section with images of the spots (figures ``spots NAME``), their positions and shifts."""
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
    recovery, pitch = run.recovery, 1e6 * run.experiment.path.pitch
    for i, channel in enumerate(run.experiment.path.channels):
        for k, axis in enumerate(("row", "column")):
            before, after = float(recovery.before[0, i, k]), float(recovery.after[0, i, k])
            start, end = float(recovery.sigma_before[0, i, k]), float(recovery.sigma_after[0, i, k])
            sigma = float(recovery.shift_covariance[0, 2 * i + k, 2 * i + k]) ** 0.5
            shift = after - before
            cells_by_key = (
                ("before", _with_sigma(before, start)),
                ("after", _with_sigma(after, end)),
                ("shift_px", _with_sigma(shift, sigma, sign=True)),
                ("shift_um", _with_sigma(shift * pitch, sigma * pitch, sign=True)),
            )
            cells = [Marked(text, "", "number", f"{channel.key}.{axis}.{what}") for what, text in cells_by_key]
            rows.append([f"{channel.camera} {channel.name}", axis, *cells])
            full.append([channel.key, axis, before, start, after, end, shift, sigma, shift * pitch, sigma * pitch])
    heads = ["channel", "axis", "before [px]", "sigma [px]", "after [px]", "sigma [px]", "shift [px]", "sigma [px]"]
    heads += ["shift [µm]", "sigma [µm]"]
    positions = Table(
        "spots",
        "Spot positions, pixel coordinates, and their shifts",
        f"{pitch:g} µm pixels, pixel (0, 0) at the upper left. A column is along the camera's X (flight direction), a "
        "row along its Y (the line CCD). Left is the +Y end of the line. Sigma of a shift: the noise of both "
        "positions, without the pixel pattern that they have in common.",
        ("Channel", "Axis", "before [px]", "after [px]", "shift [px]", "shift [µm]"),
        rows,
        within=IN_PAGE,
        full=Table("spots", "Spots", "", heads, full),
    )
    return Section("Spots", (), (*figures, positions), 1, "spots")


def _with_sigma(value: float, sigma: float, sign: bool = False) -> str:
    decimals = decimals_for(sigma)
    return f"{fixed(value, decimals, sign)} ± {fixed(sigma, decimals)}"


def residual_section(run: RenderRun, drawn: Mapping[str, str]) -> Section:
    """Return the section with the errors of all estimators and how much of them the crosstalk table explains.

    The unexplained part of the error of the estimator that the verdict uses is compared with the noise alone.
    """
    title = run.estimators[run.judged].title
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []
    notes = []
    judged_rows = [r for r in run.reading.table.of(run.judged) if r.camera]
    for name in run.experiment.instrument.cameras:
        systematic = systematics(run, name)
        for k, r in enumerate(reading for reading in judged_rows if reading.camera == name):
            bias, decimals = float(systematic.bias[run.judged][k]), decimals_for(r.noise)
            error, expected, left = (fixed(v, decimals, sign=True) for v in (r.error, bias, r.error - bias))
            texts = (error, residual_text(residual(r.error, r.sigma)), expected, left)
            cells = [Marked(text, "", "number") for text in texts]
            judged = residual_cell("", residual(r.error - bias, r.noise), "")
            rows.append([name, r.parameter.label, *cells, judged])
            row: list[Cell] = [name, r.parameter.symbol, r.parameter.unit, r.error, r.sigma, r.noise]
            full.append([*row, bias, r.error - bias])
        outside, uncovered = joined(systematic.outside), joined(systematic.uncovered)
        outside_text = f"motions outside the family: {outside}." if outside else ""
        outside_text = "no motions outside the family." if not outside and not uncovered else outside_text
        if uncovered:
            outside_text += f" Perturbed but in no row of the table, so that the effect is unexplained: {uncovered}."
        notes.append(f"{name}: {outside_text.strip()}")
    heads = ["camera", "parameter", "unit", f"{title} - true", "sigma", "sigma noise", "expected from the crosstalk"]
    far = (
        "Far outside: larger motions than the prior expects, or other ones."
        if run.experiment.prior is not None
        else "Inside the band: noise. Far outside: the formula has a wrong factor, or a body moved that the "
        "estimators do not model."
    )
    caption = f"Recovered minus true in σ; shaded ±{FAR:g} σ. {assumed(run.reading)}. {far}"
    drawing = figure(drawn, "residuals", caption)
    explained_heads = ("expected from the crosstalk table", "unexplained", "in σ of noise")
    table = Table(
        "explained",
        f"Residuals of {title}, and the part explained by the crosstalk table",
        "",
        ("Camera", "Parameter", f"{title} − true", "in σ", *explained_heads),
        rows,
        within=IN_PAGE,
        full=Table("residuals", "Residuals", "", [*heads, "unexplained"], full),
    )
    moved = Text("moved", "Motions outside the model of the estimators", "", notes, within=IN_PAGE)
    return Section("Residuals", (), (drawing, table, moved), 2, "residuals")


_PAPER = "Wang et al., Acta Photonica Sinica 47(10) 1012001 (2018), doi 10.3788/gxzb20184710.1012001"
_BUILT = "The nominal state is the instrument as built: the frames before are of this state, and changes refer to it."
ZERO_CELSIUS = 273.15


def facts(run: JobRun) -> tuple[tuple[str, str], ...]:
    """Return the facts about the set-up and assumptions of a run, as pairs of title and text."""
    resolved, instrument = run.resolved, run.experiment.instrument
    spec, has_prior = resolved.instrument, run.experiment.prior is not None
    instrument_fact = ("Instrument", f"{spec.name}: {spec.description}" if spec.description else spec.name)
    as_built_fact = () if not spec.as_built else (("As built", f"{perturbation_text(spec.as_built)}. {_BUILT}"),)
    expansion_text = (
        "Structures expand freely and carry the bodies on them, mirrors and prisms bend (finite elements), and the "
        "index of glass changes."
    )
    if not isinstance(run, RenderRun):
        without = "The instrument has no monitor: changes are from the exact trace, and nothing is measured."
        return ("Assumptions", f"{without} {expansion_text}"), instrument_fact, *as_built_fact
    monitor, ccd, bits = spec.autocollimator, spec.autocollimator.area_ccd, resolved.area_detector.bit_depth
    fields = [float(np.degrees(channel.field)) for name in spec.cameras for channel in spec.channels_of(name).values()]
    family = "; ".join(e.title for e in run.estimators.values() if not e.needs_prior)
    judged = run.estimators[run.judged].title
    covered = f"σ covers this error for motions of the prior. The {judged} weighs them against the noise. "
    about = (
        "These estimators assume shifts of the line CCD along X and Y, its rotation about Z and a scale of the whole "
        f"optics: {family}. They read any other motion as a mixture of these, an error that more frames do not reduce "
        f"(Residuals, Crosstalk). {covered if has_prior else ''}{expansion_text}"
    )
    return (
        ("Assumptions", about),
        *((estimator.title, estimator.note) for estimator in run.estimators.values()),
        ("Paper", _PAPER),
        instrument_fact,
        *as_built_fact,
        (
            "Monitor",
            f"{plain(1e9 * monitor.wavelength)} nm, pinhole {plain(1e6 * monitor.reticle.pinhole)} µm, return face "
            f"{_all([1e3 * c.aperture for c in instrument.channels])} mm wide, area CCDs at {_fields(fields)}° of "
            "field",
        ),
        (
            "Area CCD",
            f"{ccd.rows} × {ccd.columns} pixels of {plain(1e6 * ccd.pitch)} µm, {bits} bits, "
            f"exposure {plain(1e3 * ccd.exposure)} ms",
        ),
        (
            "Light",
            f"{_all([1e-6 * c.photons for c in instrument.channels])} million photons per spot and frame expected at "
            "the CCD",
        ),
        ("Frames", f"{run.frames} before and {run.frames} after, seed {run.seed}"),
        ("Spot centres", CENTROIDS[resolved.job.analysis.centroid].title),
    )


def _all(values: list[float]) -> str:
    """Return the distinct values in a list of all channels' values, as text: ``50``, or ``34, 24``."""
    return ", ".join(dict.fromkeys(plain(value) for value in values))


def _fields(degrees: list[float]) -> str:
    """Return distinct field angles, in degrees, as text: ``±1.22``, or ``±1.22, 1.25`` if one end has the second."""
    ends: dict[str, set[bool]] = {}
    for field in degrees:
        ends.setdefault(plain(abs(field)), set()).add(field > 0.0)
    signs = {frozenset((True, False)): "±", frozenset((True,)): "", frozenset((False,)): MINUS}
    return ", ".join(signs[frozenset(end)] + size for size, end in ends.items())


def setup_section(run: JobRun) -> Section:
    """Return the section with a table of the cameras and one of the prior on disturbances, cause by cause."""
    spec, instrument = run.resolved.instrument, run.experiment.instrument
    rows: list[list[Cell]] = []
    for name, model in instrument.cameras.items():
        focal, line = float(run.experiment.nominal_truth.principal_distance[name]), model.spec.line
        row: list[Cell] = [name, model.spec.name, float(np.degrees(spec.cameras[name].look)), focal]
        f_number = model.paraxial.focal_length / model.entrance_pupil
        row += [f_number, line.pixels, 1e6 * line.pitch, 1e3 * line.pixels * line.pitch]
        rows.append([*row, 1e3 * float(instrument.separation[name])] if instrument.channels else row)
    heads = ["camera", "prescription", "look angle [deg]", "principal distance [m]", "F-number", "pixels"]
    heads += ["pitch [µm]", "line [mm]", *(["distance of the area CCDs [mm]"] if instrument.channels else [])]
    decimals = (None, None, 2, 4, 1, None, None, 1, 2)[: len(heads)]
    cameras = Table("cameras", "Cameras", "", heads, rows, decimals, within=IN_PAGE)
    prior_tables = () if run.experiment.prior is None else (_prior_table(run),)
    title = "Cameras, and the prior on disturbances" if prior_tables else "Cameras"
    return Section(title, (), (*prior_tables, cameras), closed=True)


def _prior_table(run: JobRun) -> Table:
    prior, spec = run.experiment.prior, run.resolved.disturbances
    assert prior is not None
    assert spec is not None
    rows: list[list[Cell]] = []
    full: list[list[Cell]] = []

    def listed(name: str, when: str, why: str) -> list[Component]:
        """Add the motions due to one cause to the table with all digits, and return them."""
        components = [c for c in prior.components if c.cause == name]
        full.extend(
            [name, c.body, c.what, c.sigma / c.unit_size, unit_for_reports(c.unit), when, why] for c in components
        )
        return components

    for name, cause in spec.causes.items():
        components = listed(name, cause.time.text, cause.reason)
        bodies = list(dict.fromkeys(c.body for c in components))
        sizes: dict[tuple[str, str], list[str]] = {}
        for c in components:
            if c.body == bodies[0]:
                size = f"{plain(c.sigma / c.unit_size)} {unit_for_reports(c.unit)}"
                sizes.setdefault((c.kind, size), []).append(c.what.removeprefix(c.kind).strip())
        what = []
        for (kind, size), axes in sizes.items():
            bodies_text = "" if axes in (["x", "y", "z"], [""]) else f" {', '.join(axes)}"
            what.append(f"{kind.replace('_', ' ')}{bodies_text} {size}")
        if cause.together is not None:
            what.append(f"bodies together {plain(cause.together)}")
        if cause.correlations:
            what.append(f"{len(cause.correlations)} correlations")
        bodies_text = f"{len(bodies)}: `{', '.join(cause.bodies)}`"
        rows.append([name.replace("_", " "), bodies_text, "; ".join(what), cause.time.text, cause.reason])
    if (joint := spec.joint) is not None:
        components = listed(JOINT, joint.time.text, joint.reason)
        bodies = list(dict.fromkeys(c.body for c in components))
        bodies_text = f"{len(bodies)}: `{', '.join(bodies[:3])}`" + (", ..." if len(bodies) > 3 else "")
        rows.append(
            [JOINT, bodies_text, f"{len(components)} components, listed one by one", joint.time.text, joint.reason]
        )
    heads = ["cause", "body", "motion", "sigma", "unit", "in time", "reason"]
    return Table(
        "disturbances",
        f"Prior on disturbances, {spec.name}: one standard deviation of each component of each body",
        f"{spec.description.strip()} Component by component." if spec.description else "Component by component.",
        ("Cause", "Bodies", "One standard deviation", "In time", "Reason"),
        rows,
        within=IN_PAGE,
        full=Table("disturbances", "Disturbances", "", heads, full),
    )


def done_table(run: JobRun) -> Table:
    """Return the table of the motions and temperatures that the job applies to each body at the time shown.

    Bodies that only move because another body carries them are omitted.
    """
    job = run.resolved.job
    shown = _shown(run)
    motions, fields = motions_of(job, shown), job.fields(shown)
    rows: list[list[Cell]] = []
    for path in dict.fromkeys((*motions, *fields)):
        motion, perturbation = motions.get(path, Motion()), job.perturb.get(path)
        has_table = perturbation is not None and perturbation.heat.table is not None
        parts = [_motion_text(motion)]
        if path in fields and not (has_table and fields[path] == Temperature()):
            parts.append(_heat_text(fields[path]))
        if perturbation is not None and perturbation.deformation is not None:
            parts.append("deformed by a table of nodes")
        if has_table:
            parts.append("temperatures by a table of nodes")
        rows.append([path, "; ".join(filter(None, parts)) or "nothing (all zero)", motion.pivot])
    heated, caption = _heated(run), "In each body's own frame: rotation vector about the pivot, then shift."
    if heated:
        caption += (
            f" A temperature is the change from {fixed(run.resolved.instrument.temperature - ZERO_CELSIUS, 2)} °C at "
            "the body's origin plus gradient · r; bodies that it carries have the same field unless they are "
            f"listed. {heated} bodies are at other temperatures than nominal."
        )
    return Table("perturbation", "", caption, ("body", "motion", "pivot"), rows, within=IN_PAGE)


def _shown(run: JobRun) -> int | None:
    """Return the index of the time of a time series that is shown in full; None for a single state."""
    return run.series.shown if isinstance(run, RenderRun) and run.series is not None else None


def _heated(run: JobRun) -> int:
    """Return the number of bodies whose temperature is not nominal, faces of prisms not counted."""
    fields = run.experiment.thermal.fields(run.experiment.fields(run.resolved.job, _shown(run)))
    return sum(path in run.experiment.thermal.materials and field != Temperature() for path, field in fields.items())


def _motion_text(motion: Motion) -> str:
    parts = []
    for name, vector, unit, size in (("rotate", motion.rotate, "arcsec", ARCSEC), ("shift", motion.shift, "µm", 1e-6)):
        if any(vector):
            parts.append(f"{name} ({', '.join(plain(v / size) for v in vector)}) {unit}")
    if motion.scale:
        parts.append(f"scale {plain(1e6 * motion.scale)} ppm")
    terms = [f"Z{j} {plain(1e9 * a)} nm" for j, a in motion.figure.items() if a]
    if terms:
        parts.append(f"figure {', '.join(terms)}")
    return "; ".join(parts)


def _heat_text(field: Temperature) -> str:
    text = f"temperature {plain(field.change)} K"
    if any(field.gradient):
        text += f", gradient ({', '.join(plain(1e3 * g) for g in field.gradient)}) mK/m"
    return text
