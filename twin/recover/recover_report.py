"""Verdict and report of a measurement: changes of the cameras recovered from measured frames, and their sigmas."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator

from analysis.monitor import parameters
from analysis.monitor.parameters import ANGLE_GROUP, GROUND_GROUP
from analysis.spots import CENTROIDS
from scenes.specs.course import moment
from twin.framework import svg
from twin.framework.artefact import FAR, Cell, SvgFigure, Table, decimals_for, fixed, plain, significant
from twin.framework.report import Report, Section, answer
from twin.main_job.monitor_reading import worst_checks
from twin.main_job.spot_plots import asinh_scale, cross, time_unit
from twin.main_job.systematics import NOISE, assumed, course_agrees, limits, share_text
from twin.recover.channel_measurement import ChannelResult, SpotResult
from twin.recover.recover_run import RecoverRun, state_name

_NOT_IN_SIGMA = (
    "σ does not include charge transfer losses of the CCD (tails away from the read-out), reflections too close to the "
    "spot to be separated from it, and errors of the specified geometry."
)


def _name(run: RecoverRun) -> str:
    return run.setup.model.instrument.name if run.setup.model is not None else ", ".join(run.last.cameras)


def _corrected(run: RecoverRun) -> tuple[int, int, SpotResult | None, str]:
    """Return how many sets of frames (one per channel and state) were corrected for artefacts, out of how many.

    The last two values are the spot that lost most accuracy, or None, and its name.
    """
    all_frames = [
        (result.channel.name, state_name(run.times, k), spot)
        for result in run.channels
        for k, (_, spot) in enumerate(result.states())
    ]
    corrected = [frames for frames in all_frames if not frames[2].clean]
    if not corrected:
        return 0, len(all_frames), None, ""
    channel, name, worst = max(corrected, key=lambda frames: frames[2].cost)
    return len(corrected), len(all_frames), worst, f"{channel} {name}"


def _verdict(run: RecoverRun) -> tuple[str, tuple[str, ...]]:
    """Return the verdict of the measurement and the sentences that follow it."""
    reading = run.last
    readings = reading.table.of(reading.judged)
    title = reading.estimators[reading.judged].title
    out = [row for row in readings if abs(row.size) > FAR]
    when = f" at {moment(run.times[-1])}, the last of {len(run.times)} times" if run.times else ""
    basis = "noise alone" if reading.disturbances is None else f"noise and disturbances {reading.disturbances.name}"
    if run.setup.model is None:
        largest = max(readings, key=lambda row: abs(row.size))
        first = f"The largest reading of the {title}{when} against the noise of the images alone is {largest.name}"
        first, second = f"{first}, {largest.read}", ""
    elif out:
        clearest = max(out, key=lambda row: abs(row.size))
        exceed = "exceeds" if len(out) == 1 else "exceed"
        first = f"{len(out)} of {len(readings)} readings of the {title}{when} {exceed} {FAR:g} σ (σ: {basis})"
        second = f"the clearest change is {clearest.name}, {clearest.read}"
    else:
        parts = []
        for p in parameters.CAMERA_PARAMETERS.values():
            sigmas = [row.sigma for row in readings if row.parameter == p]
            parts += [f"{p.symbol} {significant(FAR * max(sigmas), 2, floor=0.0)} {p.unit}"] if sigmas else []
        first = (
            f"No change is detected{when}: none of the {len(readings)} readings of the {title} exceeds {FAR:g} σ (σ: "
            f"{basis})"
        )
        second = f"changes below {', '.join(parts)} would not be detected"
    about = next((row for row in readings if row.group == ANGLE_GROUP), max(readings, key=lambda row: abs(row.size)))
    limit = ""
    if reading.disturbances is not None:
        body, share = limits(reading, about)
        what = f"{body} causes" if body == NOISE else f"motions of {body} cause"
        size = f"{significant(about.sigma, 2)} {about.parameter.unit}"
        limit = f"{what} {share_text(share)} of the variance of {about.name} (σ {size})"
    count, total, worst_spot, where = _corrected(run)
    cleaned = "the frames were used as they are" if run.setup.test.corrections == "none" else "the frames are clean"
    if worst_spot is not None:
        most = round(100.0 * worst_spot.cost, 1)
        cost = f"up to {plain(most, 3)} %" if most >= 0.1 else "less than 0.1 %"
        cleaned = f"artefacts were corrected in {count} of {total} sets of frames"
        cleaned += f", which increases the noise part of σ by {cost} ({where})"
    doubt = "" if reading.sigma_holds else "σ does not hold for this measurement: see the warnings"
    return answer(first, doubt, second, limit, cleaned)


def recover_report(run: RecoverRun) -> Report:
    """Return the report of ``python -m twin.recover``: verdict, changes, spots with their artefacts, estimators."""
    reading = run.last
    verdict, more = _verdict(run)
    facts = [
        ("instrument", _name(run) if run.setup.model is not None else f"geometry of {_name(run)}"),
        ("spot's shape", "from the model" if run.setup.test.template == "twin" else "learnt from the frames before"),
        ("centroid", CENTROIDS[reading.centroid].title),
        ("area CCD", f"{run.setup.detector.name}, pixels of {plain(1e6 * run.pitch)} µm"),
        ("frames", _frames_text(run)),
    ]
    sections = [_spots(run), _estimators(run)]
    if run.times is not None:
        sections.insert(0, _series(run))
    transfers = [result for result in run.channels if result.channel.transfer is not None]
    if transfers:
        sections.append(_transfer(transfers))
    return Report(
        title=f"{_name(run)}: readings of measured frames",
        verdict=verdict,
        lead=(*more, f"{assumed(reading)}."),
        facts=tuple(facts),
        summary=_summary(run),
        sections=tuple(sections),
        warnings=run.all_warnings,
        checks=worst_checks(run.readings),
    )


def _frames_text(run: RecoverRun) -> str:
    counts = {
        name: sorted(
            {len(spot.frames.frames) for r in run.channels for n, spot in r.states() if (n == "before") == name}
        )
        for name in (True, False)
    }
    before, after = ("–".join(map(str, sorted({c[0], c[-1]}))) for c in counts.values())
    return f"{before} before and {after} after of each of {len(run.channels)} channels"


def _summary(run: RecoverRun) -> Table:
    """Return the table of the cameras' changes by every estimator, with the sigma of the one that the verdict uses."""
    reading, alone = run.last, run.setup.model is None
    heads = ["camera", "change", *(estimator.title for estimator in reading.estimators.values())]
    heads += ["σ of noise"] if alone else ["σ", "σ of noise", "in σ"]
    rows: list[list[Cell]] = []
    for rows_of_change in reading.table.by_change():
        judged_row = next(row for row in rows_of_change if row.estimator == reading.judged)
        values = [fixed(row.value, decimals_for(judged_row.sigma, 3)) for row in rows_of_change]
        sigma, noise = (significant(part, 3, floor=0.0) for part in (judged_row.sigma, judged_row.noise))
        sigmas = [noise] if alone else [sigma, noise, fixed(judged_row.size, 1, sign=True)]
        rows.append([judged_row.where, judged_row.parameter.label, *values, *sigmas])
    at = f" at {moment(run.times[-1])}" if run.times else ""
    title = f"{_name(run)}: recovered from measured frames{at}"
    whose = "σ of noise is that" if alone else "σ and the last column are those"
    caption = f"{whose} of the {reading.estimators[reading.judged].title}."
    return Table("changes", title, caption, heads, rows)


def _spots(run: RecoverRun) -> Section:
    """Return the report's section with the frames' artefacts, the spots' positions and figures."""
    heads = ["channel", "state", "frames", "row [px]", "column [px]", "σ [px]", "artefacts", "increase of σ [%]"]
    rows: list[list[Cell]] = []
    for i, result in enumerate(run.channels):
        for k, (_, spot) in enumerate(result.states()):
            r = run.readings[max(k - 1, 0)].recovery
            position, sigma = (r.before, r.sigma_before) if k == 0 else (r.after, r.sigma_after)
            digits = decimals_for(float(sigma[0, i].min()))
            artefacts = "; ".join(f"{finding.kind}: {finding.text}" for finding in spot.findings) or "none"
            rms_sigma = significant(float(np.sqrt(np.mean(np.square(sigma[0, i])))), 2, floor=0.0)
            coordinates = [fixed(float(coordinate), digits) for coordinate in position[0, i]]
            frames: list[Cell] = [result.channel.name, state_name(run.times, k), len(spot.frames.frames)]
            rows.append([*frames, *coordinates, rms_sigma, artefacts, fixed(100.0 * spot.cost, 1)])
    caption = (
        "Rows and columns count on the whole CCD, from the centre of its first pixel. The increase of σ is that of the "
        "spot's position, relative to the same light without excluded pixels or fitted artefacts."
    )
    cameras = list(run.last.cameras)
    excluded = "excluded pixels are marked."
    about = f"Mean frames, stretched to show faint light, with the centres before and after; {excluded}"
    figures = [SvgFigure(f"spots-{name}", f"Spots of {name}", about, spots_svg(run, name)) for name in cameras]
    fitted = [name for name in cameras if any(s.residual is not None for r in _of(run, name) for _, s in r.states())]
    about = f"Mean frame minus fitted spot and background in standard deviations of each pixel; {excluded}"
    figures += [
        SvgFigure(f"residuals-{name}", f"Residuals of the fitted shape, {name}", about, residuals_svg(run, name))
        for name in fitted
    ]
    text = () if run.setup.test.corrections == "automatic" else ("The frames were not searched for artefacts.",)
    return Section(
        "Spots", text, (Table("spots", "Spot positions and artefacts of the frames", caption, heads, rows), *figures)
    )


def _of(run: RecoverRun, camera: str) -> list[ChannelResult]:
    return [result for result in run.channels if result.channel.name.split("/")[0] == camera]


def _estimators(run: RecoverRun) -> Section:
    """Return the section with the cameras' changes by every estimator, and their sigmas."""
    reading = run.last
    heads = ["camera", "change", "unit"]
    for estimator in reading.estimators.values():
        heads += [estimator.title, f"{estimator.title} σ", f"{estimator.title} σ of noise"]
    rows: list[list[Cell]] = []
    for rows_of_change in reading.table.by_change():
        first = rows_of_change[0]
        row: list[Cell] = [first.camera or "both", first.parameter.symbol, first.parameter.unit]
        for reading_row in rows_of_change:
            row += [reading_row.value, reading_row.sigma, reading_row.noise]
        rows.append(row)
    notes = [f"{reading_row.title}: {reading_row.note}." for reading_row in reading.estimators.values()]
    table = Table("estimators", "All estimators", " ".join(notes), heads, rows, digits=5)
    return Section("Estimators", (_NOT_IN_SIGMA,), (table,), 1)


def _series(run: RecoverRun) -> Section:
    assert run.times is not None
    smoothed = run.smoothed
    heads = ["time [s]", "camera", "change", "unit", "value", "σ", "σ of noise"]
    rows: list[list[Cell]] = []
    for time, reading in zip(run.times, run.readings, strict=True):
        for change in reading.table.of(reading.judged):
            labels: list[Cell] = [time, change.camera or "both", change.parameter.symbol, change.parameter.unit]
            rows.append([*labels, change.value, change.sigma, change.noise])
    judged = run.last.estimators[run.last.judged].title
    caption = f"Value: reading of the {judged} at each time alone, relative to the same frames before."
    legend = f"Marks: readings of the {judged} at each time alone, with one total standard deviation."
    text: tuple[str, ...] = ()
    if smoothed is not None:
        heads += ["filtered", "σ, filtered", "smoothed", "σ, smoothed"]
        reads = run.last.table.of(run.last.judged)
        for number, row in enumerate(rows):
            k, j = divmod(number, len(reads))
            for estimator in ("filtered", "smoothed"):
                row_of_change = smoothed.changes.row(reads[j].group, reads[j].parameter.key, estimator)
                row += [float(row_of_change.value[k]), float(row_of_change.sigma[k])]
        caption += " Filtered: from all times up to it; smoothed: from all times."
        legend += (
            " Line and bands: from all times together (smoothed), by the time laws of the disturbances "
            f"{smoothed.name}, with one and two standard deviations, also between the times."
        )
        text = (course_agrees(smoothed, np.array(run.times)),)
    figure = SvgFigure("series", "Changes over time", legend, changes_svg(_drawn(run)))
    return Section("Series", text, (figure, Table("times", "All times", caption, heads, rows)), 1)


def _drawn(run: RecoverRun) -> list[Line]:
    """Return the changes of the cameras and of their angle that the figure of a series shows."""
    assert run.times is not None
    out = []
    rows_by_time = [reading.table.of(reading.judged) for reading in run.readings]
    for number, change in enumerate(rows_by_time[-1]):
        if change.group == GROUND_GROUP:
            continue
        values, sigmas = ([getattr(reads[number], name) for reads in rows_by_time] for name in ("value", "sigma"))
        band = None
        if run.smoothed is not None:
            parts = ((run.times, run.smoothed.changes), (run.smoothed.times, run.smoothed.between))
            parts_of_change = [
                (times, table.row(change.group, change.parameter.key, "smoothed")) for times, table in parts
            ]
            points = np.concatenate([np.stack([times, row.value, row.sigma], axis=1) for times, row in parts_of_change])
            band = points[np.argsort(points[:, 0])].T
        out.append(Line(change.camera, change.parameter.label, np.array([run.times, values, sigmas]), band))
    return out


def _transfer(results: list[ChannelResult]) -> Section:
    heads = ["channel", "gain [DN/e]", "dark noise [e]", "dark level [DN]", "PRNU [%]", "DSNU [e]"]
    rows: list[list[Cell]] = []
    for result in results:
        t = result.channel.transfer
        assert t is not None
        pairs = (
            (t.gain_dn_per_e, t.gain_sigma),
            (t.dark_noise_e, t.dark_noise_sigma),
            (100.0 * t.prnu, 100.0 * t.prnu_sigma),
            (t.dsnu_e, t.dsnu_sigma),
        )
        gain, noise, prnu, dsnu = (f"{fixed(v, decimals_for(s))} ± {fixed(s, decimals_for(s))}" for v, s in pairs)
        rows.append([result.channel.name, gain, noise, fixed(t.dark_level_dn, 2), prnu, dsnu])
    caption = "From the variances of dark and flat frames, over the frames and over the pixels."
    return Section("Photon transfer", (), (Table("photon_transfer", "Measured noise", caption, heads, rows),))


LIMIT = 5.0
"""Limit of the colour scale of fit residuals, in standard deviations of a pixel."""


def _panels(run: RecoverRun, camera: str) -> list[tuple[str, list[tuple[str, SpotResult, np.ndarray]]]]:
    """Return the images to be drawn of a camera: for each channel the states before and last after.

    An entry has the channel's name and, for each of the two states, its name, the measured spot, and the spot's centre
    on the CCD, in pixels.
    """
    out = []
    for i, result in enumerate(run.channels):
        name, channel = result.channel.name.split("/")
        if name != camera:
            continue
        r = run.last.recovery
        states = result.states()
        name = state_name(run.times, len(states) - 1)
        out.append((channel, [("before", states[0][1], r.before[0, i]), (name, states[-1][1], r.after[0, i])]))
    return out


def _extent(spot: SpotResult) -> tuple[float, float, float, float]:
    """Return the region of the CCD that a spot's image shows, in pixels, as Matplotlib's ``extent``."""
    (row, column), (height, width) = spot.frames.offset, spot.mean.shape
    return column - 0.5, column + width - 0.5, row + height - 0.5, row - 0.5


def _mark_unused(axes: Axes, spot: SpotResult) -> None:
    row, column = np.nonzero(~spot.used)
    at = spot.frames.offset
    axes.plot(column + at[1], row + at[0], "s", ms=2.2, mfc="none", mec=svg.ORANGE, mew=0.6, ls="none")


def spots_svg(run: RecoverRun, camera: str) -> str:
    """Draw the mean frames of one camera, a row for each channel."""
    norm = asinh_scale(np.concatenate([s.mean.ravel() for _, states in _panels(run, camera) for _, s, _ in states]))

    def draw(axes: Axes, name: str, spot: SpotResult, position: np.ndarray) -> AxesImage:
        shown = axes.imshow(spot.mean, cmap=svg.GRAY, norm=norm, interpolation="none", extent=_extent(spot))
        cross(axes, position, svg.BEFORE if name == "before" else svg.AFTER, 0.11 * spot.mean.shape[1])
        return shown

    return _images_svg(run, camera, "measured", "mean frame [DN], asinh stretch", draw)


def residuals_svg(run: RecoverRun, camera: str) -> str:
    """Draw the fit residuals of one camera's spots in standard deviations, a row for each channel."""

    def draw(axes: Axes, _name: str, spot: SpotResult, _position: np.ndarray) -> AxesImage:
        residual = np.zeros_like(spot.mean) if spot.residual is None else spot.residual
        return svg.signed_map(axes, residual, LIMIT, interpolation="none", extent=_extent(spot))

    return _images_svg(run, camera, "left", "frame \N{MINUS SIGN} fit [σ]", draw)


def _images_svg(
    run: RecoverRun, camera: str, name: str, label: str, draw: Callable[[Axes, str, SpotResult, np.ndarray], AxesImage]
) -> str:
    """Draw an image of every spot of a camera before and after, with marks on the pixels that are not used."""
    with svg.look(f"{name}-{camera}"):
        panels = _panels(run, camera)
        figure = svg.new_figure(0.7 + 4.3 * len(panels), {"w_pad": 0.03, "h_pad": 0.03})
        grid = figure.subplots(len(panels), 2, squeeze=False)
        for line, (channel, states) in enumerate(panels):
            for axes, (state, spot, position) in zip(grid[line], states, strict=True):
                shown = draw(axes, state, spot, position)
                _mark_unused(axes, spot)
                _labels(axes, f"{channel}, {state}", line == len(panels) - 1)
        figure.colorbar(shown, ax=list(grid.ravel()), label=label, fraction=0.03, pad=0.02)
        return svg.to_svg(figure)


def _labels(axes: Axes, title: str, last: bool) -> None:
    axes.set_title(title)
    axes.set_ylabel("row [px]")
    if last:
        axes.set_xlabel("column [px]")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.tick_params(length=2.5, color=svg.INK)


@dataclass(frozen=True, eq=False)
class Line:
    """One change of a camera over time, as the figure of a time series draws it.

    Attributes
    ----------
    camera : str
        Name of the camera; empty for a change of both cameras together, such as that of their angle.
    name : str
        Name of the change with its unit.
    marks : (3, T) ndarray
        For each of T measured times: time in seconds, value and standard deviation, estimated from that time alone.
    band : (3, F) ndarray or None
        For F times at and between the measured ones: time, value and standard deviation, estimated from all times
        together; None without a prior.
    """

    camera: str
    name: str
    marks: np.ndarray
    band: np.ndarray | None


def changes_svg(lines: Sequence[Line]) -> str:
    """Draw changes over time, cameras side by side, and below them the changes of both together.

    Parameters
    ----------
    lines : Sequence[Line]
        All changes.
    """
    with svg.look("measured-series"):
        size, unit = time_unit(lines[0].marks[0])
        cameras = list(dict.fromkeys(line.camera for line in lines if line.camera))
        lines_of_camera = {camera: [line for line in lines if line.camera == camera] for camera in cameras}
        shared = [line for line in lines if not line.camera]
        rows = max(map(len, lines_of_camera.values())) + len(shared)
        figure = svg.new_figure(0.7 + 1.5 * rows)
        grid = figure.add_gridspec(rows, len(cameras))
        for column, camera in enumerate(cameras):
            for row, line in enumerate(lines_of_camera[camera]):
                axes = figure.add_subplot(grid[row, column])
                _change(axes, line, size)
                axes.set_ylabel(line.name if column == 0 else "")
                axes.tick_params(labelbottom=row == rows - 1)
                if row == 0:
                    axes.set_title(f"Camera {camera}", loc="left", fontweight="bold")
                if row == rows - 1:
                    axes.set_xlabel(f"time [{unit}]")
        for k, line in enumerate(shared):
            axes = figure.add_subplot(grid[rows - len(shared) + k, :])
            _change(axes, line, size)
            axes.set_ylabel(line.name)
            axes.set_title("Angle between the cameras", loc="left", fontweight="bold")
            axes.set_xlabel(f"time [{unit}]")
        svg.shared_legend(figure, figure.axes[0])
        figure.align_ylabels()
        return svg.to_svg(figure)


def _change(axes: Axes, line: Line, size: float) -> None:
    axes.axhline(0.0, color=svg.LIGHT, lw=0.8, zorder=0)
    if line.band is not None:
        time, value, sigma = line.band
        for times, alpha in ((2.0, 0.25), (1.0, 0.45)):
            low, high = value - times * sigma, value + times * sigma
            label = f"{'2' if times > 1.0 else ''}σ, smoothed"
            axes.fill_between(time / size, low, high, color=svg.SKY, alpha=alpha, lw=0, label=label)
        axes.plot(time / size, value, color=svg.BLUE, lw=1.0, label="smoothed")
    time, value, sigma = line.marks
    axes.errorbar(
        time / size, value, sigma, fmt="o", color=svg.INK, ms=3.0, elinewidth=0.8, capsize=2, label="each time alone"
    )
    svg.gridded(axes, "y")
