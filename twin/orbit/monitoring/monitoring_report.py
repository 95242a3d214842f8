"""Report of a monitored orbit, without or with a closed loop, and its figures.

Figures: the angle, heights with and without monitoring, the interval and the remaining errors; for a closed loop, the
remaining errors over the orbit and the positions of the mechanisms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from analysis.monitor import disturbances
from analysis.monitor.model_fit import UnobservableMode
from analysis.monitor.monitor_formulas import PER_SI
from analysis.statistics import rms
from scenes.specs.course import moment
from scenes.specs.orbit.monitor import PARAMETERS
from scenes.yaml.errors import names_text
from twin.framework import svg
from twin.framework.artefact import SYMBOLS, CsvFile, SvgFigure, Table, significant, unit_for_reports
from twin.framework.data_files import csv_table
from twin.framework.report import Report, Section, answer, inputs
from twin.monitor.time_series import jump_text
from twin.orbit.monitoring import monitoring_numbers as numbers
from twin.orbit.monitoring.loop_run import LoopRun, height_rms
from twin.orbit.monitoring.monitoring_numbers import positions
from twin.orbit.monitoring.monitoring_run import FALSE_ALARM, MonitorRun
from twin.sensors.area_detector import coarse_warnings

PARTS = {
    "prisms": ("temperatures of the monitor's prisms", svg.VERMILION),
    "other_systematic": ("other errors of the monitor without noise", svg.ORANGE),
    "noise": ("noise of the monitor", svg.GREY),
    "not_applied": ("parameters that are not applied", svg.PURPLE),
    "beyond_parameters": ("beyond the four parameters", svg.SKY),
    "interpolation": ("interpolation over the interval", svg.GREEN),
}
"""Name in reports and colour in figures of each part of the height error, by its key."""
_DRAWN_PART = 5e-3
"""Size, in metres, that a part of the height error must reach at some time to be drawn."""
_COLOURS = (svg.BLUE, svg.VERMILION, svg.GREEN, svg.PURPLE, svg.ORANGE, svg.SKY)
_BESIDE = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}
"""Position of a legend beside the axes, where it does not hide curves."""
_BODIES, _MOTIONS = 3, 3
"""Largest numbers of bodies, and of motions of each, that the report names for an unobservable mode."""
_LEAST = 1e-6
"""Size below which values of an unobservable mode are rounding errors and are not reported."""


def _figure(name: str, title: str, caption: str, draw: Callable[..., Figure], run: Any) -> SvgFigure:
    return SvgFigure(name, title, caption, svg.drawn(f"monitor-{name}", draw, run))


def _panels(height: float, rows: int, zero: bool = True, label: str = "time [min]", **options: Any) -> Any:
    """Return a figure of vertically stacked panels with a common axis of time, and a line at zero error."""
    figure = svg.new_figure(height)
    panels = list(np.ravel(figure.subplots(rows, 1, sharex=True, **options)))
    panels[-1].set_xlabel(label)
    for axes in panels:
        svg.gridded(axes)
        if zero:
            axes.axhline(0.0, color=svg.GREY, lw=0.7, zorder=0.5)
    return figure, panels


def _band(axes: Axes, minutes: np.ndarray, middle: Any, sigma: np.ndarray, colour: str, **options: Any) -> None:
    axes.fill_between(minutes, middle - sigma, middle + sigma, color=colour, lw=0, **options)


def _angle_figure(run: MonitorRun) -> Figure:
    """Draw the change of the intersection angle, true and monitored, and their difference."""
    minutes = run.times / 60.0
    figure, (above, below) = _panels(4.4, 2, height_ratios=(2.2, 1.0))
    true, monitored = run.angle_change / ARCSEC, run.angle.change_rad / ARCSEC
    above.plot(minutes, true, color=svg.INK, lw=1.3, label="true, traced")
    above.plot(minutes, monitored, "o", color=svg.BLUE, ms=4, label="monitored")
    above.set_ylabel("change of the angle [arcsec]")
    _band(below, minutes, 0.0, run.angle.sigma_rad / ARCSEC, svg.SKY, alpha=0.4, label="σ")
    below.plot(minutes, monitored - true, "o-", color=svg.VERMILION, ms=3, lw=1.0)
    below.set_ylabel("monitored − true,\narcsec")
    for axes in (above, below):
        axes.legend(loc="best")
    return figure


def _height_figure(run: MonitorRun) -> Figure:
    """Draw the mean height error due to the cameras alone and the points' RMS over the orbit."""
    minutes, cases = run.times / 60.0, run.cases
    figure, (above, below) = _panels(5.2, 2)
    for name, colour, style, label in (
        ("none", svg.VERMILION, "o-", "without monitoring"),
        ("interval", svg.GREEN, "s--", f"monitored every {run.spec.cadence / 60.0:g} min, linear between"),
        ("monitored", svg.BLUE, "o-", "monitored at every time"),
    ):
        above.plot(minutes, cases[name].camera, style, color=colour, ms=3.5, lw=1.2, label=label)
        below.plot(minutes, cases[name].height, style, color=colour, ms=3.5, lw=1.2)
    below.plot(minutes, cases["true"].height, ":", color=svg.INK, lw=1.3, label="true cameras: image, orbit, attitude")
    above.set_ylabel("mean height error\nby the cameras [m]")
    below.set_ylabel("RMS in height of\nall errors [m]")
    below.set_ylim(bottom=0.0)
    for axes in (above, below):
        axes.legend(loc="best")
    return figure


def _smoothed_figure(run: MonitorRun) -> Figure:
    """Draw the mean height error due to the cameras for smoothed and interpolated readings, with its sigma."""
    spec, minutes, chosen = run.spec, run.times / 60.0, run.smoothed
    figure, (axes,) = _panels(3.8, 1)
    for many, alpha, label in ((2.0, 0.2, "2σ of the smoother"), (1.0, 0.4, "σ of the smoother")):
        _band(axes, minutes, 0.0, many * chosen.sigma, svg.SKY, alpha=alpha, label=label)
    axes.plot(minutes, run.cases["interval"].camera, "s--", color=svg.GREEN, ms=3.5, lw=1.0, label="linear between")
    axes.plot(minutes, chosen.case.camera, "o-", color=svg.PURPLE, ms=3.5, lw=1.2, label="smoothed")
    at = spec.measured(spec.cadence)
    low = axes.get_ylim()[0]
    axes.plot(minutes[at], np.full(len(at), low), "|", color=svg.INK, ms=9, mew=1.4, label="measurements")
    axes.set_ylim(bottom=low)
    axes.set_ylabel("mean height error\nby the cameras [m]")
    axes.legend(**_BESIDE)
    return figure


def _interval_figure(run: MonitorRun) -> Figure:
    """Draw the RMS error in height against the interval between measurements of the monitor."""
    figure, (axes,) = _panels(3.6, 1, False, "interval between measurements [min]")
    minutes, intervals = np.array(list(run.intervals)) / 60.0, run.intervals.values()
    curves = [
        ([case.height_rms for case in intervals], "o-", svg.BLUE, 5, "all errors"),
        ([case.camera_height_rms for case in intervals], "s--", svg.GREEN, 4, "by the cameras alone, linear between"),
    ]
    if run.smoothing:
        chosen = [run.smoothing[interval] for interval in run.intervals]
        smoothed = [smoothing.case.camera_height_rms for smoothing in chosen]
        curves.append((smoothed, "D-", svg.PURPLE, 4, "by the cameras alone, smoothed"))
        curves.append(([rms(smoothing.sigma) for smoothing in chosen], ":", svg.PURPLE, 4, "σ of the smoother"))
    for values, style, colour, size, label in curves:
        axes.loglog(minutes, values, style, color=colour, ms=size, lw=1.2, label=label)
    axes.axhline(run.cases["none"].height_rms, color=svg.VERMILION, lw=1.1, label="without monitoring")
    axes.axhline(run.cases["true"].height_rms, color=svg.INK, lw=1.1, ls=":", label="true cameras")
    axes.set_xticks(minutes, [f"{m:g}" for m in minutes])
    axes.minorticks_off()
    low, high = axes.get_ylim()
    marks = [v for v in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0) if low <= v <= high]
    if marks:
        axes.set_yticks(marks, [f"{v:g}" for v in marks])
    axes.set_ylabel("RMS in height [m]")
    axes.legend(loc="best")
    return figure


def _parts_figure(run: MonitorRun) -> Figure:
    """Draw the mean height error of the corrected cameras over time, split into its causes (`PARTS`)."""
    minutes = run.times / 60.0
    figure, (axes,) = _panels(3.8, 1)
    axes.plot(minutes, run.cases["interval"].camera, color=svg.INK, lw=1.6, label="together, with the file's interval")
    for name, part in run.parts.items():
        if np.abs(part).max() > _DRAWN_PART:
            label, colour = PARTS[name]
            axes.plot(minutes, part, "o-", color=colour, ms=3, lw=1.0, label=label)
    axes.set_ylabel("mean height error [m]")
    axes.legend(**_BESIDE)
    return figure


def _course_figure(run: LoopRun) -> Figure:
    """Draw angle, height and foci over the orbit, with the loop open and closed."""
    minutes = run.closed.course.times / 60.0
    label = "time [min]; bands: posterior ±σ"
    figure, panels = _panels(2.2 * (2 + len(run.pair)), 2 + len(run.pair), label=label)
    for state, outcome, style, colour in (
        ("open", run.open, "s--", svg.VERMILION),
        ("closed", run.closed, "o-", svg.BLUE),
    ):
        shown = {
            "angle [arcsec]": (outcome.true(outcome.angle), outcome.angle, ARCSEC),
            "height by the\ncameras [m]": (outcome.heights.camera, outcome.slopes, 1.0),
        }
        for name in run.pair:
            row = run.model.unit(name, "defocus")
            shown[f"defocus of\n{name} [µm]"] = outcome.true(row), row, 1e-6
        for axes, (quantity, (true, rows, size)) in zip(panels, shown.items(), strict=True):
            middle, sigma = outcome.posterior(rows)
            _band(axes, minutes, middle / size, sigma / size, colour, alpha=0.2)
            axes.plot(minutes, true / size, style, color=colour, ms=3.0, lw=1.1, label=f"loop {state}, true")
            axes.set_ylabel(quantity)
    panels[0].legend(loc="best")
    return figure


def _positions_figure(run: LoopRun) -> Figure:
    """Draw the commanded positions of the mechanisms over the orbit."""
    units = list(dict.fromkeys(corrector.unit[0] for corrector in run.model.correctors))
    figure, panels = _panels(1.0 + 2.2 * len(units), len(units), False, "time [min]; dotted: at the end of a range")
    minutes = run.closed.course.times / 60.0
    for axes, unit in zip(panels, units, strict=True):
        for k, corrector in enumerate(corrector for corrector in run.model.correctors if corrector.unit[0] == unit):
            colour = _COLOURS[k % len(_COLOURS)]
            axes.step(minutes, positions(run, corrector.name), where="post", color=colour, lw=1.2, label=corrector.name)
            for number in run.loops[corrector.name].ends:
                axes.axvline(minutes[number], color=colour, lw=0.8, ls=":")
        axes.set_ylabel(f"position [{unit_for_reports(unit)}]")
        axes.legend(loc="best", ncols=2)
    return figure


def monitor_report(run: MonitorRun | LoopRun) -> Report:
    """Return the report of a monitored orbit: heights with and without monitoring, their errors and warnings."""
    if isinstance(run, LoopRun):
        return Report(
            "A monitor in the loop",
            *_loop_verdict(run),
            _facts(run),
            _loop_summary(run),
            (_orbit(run), _loops(run), _unobservable(run)),
            warnings=(*numbers.LOOP.warnings(run), *_worse_warnings(run), *_loop_warnings(run)),
        )
    smoothed = (_smoothed(run),) if run.smoothing else ()
    return Report(
        "Effect of on-board monitoring on the ground",
        *_verdict(run),
        _facts(run),
        _table(run),
        (_angle(run), _height(run), *smoothed, _interval(run), _rest(run), _conversion(run), _noise(run)),
        warnings=_warnings(run),
    )


def _facts(run: MonitorRun | LoopRun) -> tuple[tuple[str, str], ...]:
    setup, test, errors, on = run.setup, run.setup.test, run.setup.test.errors, run.setup.test.errors.switched_on
    span = f"{moment(test.times[0])} to {moment(test.times[-1])} in steps of {moment(test.step)}"
    prior = setup.disturbances.name if setup.disturbances else "none: sigmas contain the noise alone"
    keys = ("reference", "apply") if isinstance(run, MonitorRun) else ()
    return (
        ("Instrument", f"{setup.instrument.name}, {setup.instrument.description}"),
        ("Pair", f"{setup.pair[0]} against {setup.pair[1]}"),
        ("Course", f"{span}, from {test.orbit.epoch}"),
        ("Motions", "of the course" if test.course is not None else "drawn by the disturbances' laws in time"),
        ("Disturbances", prior),
        *inputs(test, *keys, "ground"),
        ("Image points", f"σ {errors.image:g} px, drawn" if on else "exact"),
        ("Monitor's frames", "with noise" if on and errors.monitor else "without noise"),
        ("Effects on the light", "assumed corrected"),
        ("Description", test.description),
    )


def _verdict(run: MonitorRun) -> tuple[str, tuple[str, ...]]:
    cases, spec = run.cases, run.spec
    none, chosen, floor = cases["none"], cases["interval"], cases["true"]
    gain = none.height_rms - chosen.height_rms
    others = floor.height_rms**2 > 0.5 * chosen.height_rms**2
    limit = "images, orbit and attitude" if others else _largest_part(run)
    return answer(
        f"Monitoring every {moment(spec.cadence)} changes the height error from {none.height_rms:.2f} m to "
        f"{chosen.height_rms:.2f} m RMS{'' if gain > 0.0 else ', which is no gain'}",
        f"with the true cameras {floor.height_rms:.2f} m would remain: most of the error comes from {limit}",
        _gain(run),
    )


def _gain(run: MonitorRun) -> str:
    """Return a sentence on how much smoothing reduces the height error; empty without a prior."""
    if not run.smoothing:
        return ""
    chosen = run.smoothed
    return (
        f"smoothing the same measurements changes the height error by the cameras to "
        f"{chosen.case.camera_height_rms:.2g} m, from {chosen.interpolated.camera_height_rms:.2g} m by linear "
        f"interpolation; the predicted sigma is {rms(chosen.sigma):.2g} m, the errors are {rms(chosen.ratios):.2g} σ "
        f"RMS, {chosen.largest_ratio:.1f} σ at most (limit {chosen.limit:.1f} σ)"
    )


def _largest_part(run: MonitorRun) -> str:
    """Return the largest part of the monitored cameras' height error in words."""
    return PARTS[max(run.parts, key=lambda name: rms(run.parts[name]))][0]


def _table(run: MonitorRun) -> Table:
    spec = run.spec
    names = {
        "none": "as calibrated, no monitoring",
        "interval": f"monitored every {moment(spec.cadence)}",
        "smoothed": "the same measurements, smoothed",
        "monitored": "monitored at every time",
        "parameters": "true four parameters (bound)",
        "true": "true cameras (bound)",
    }
    return numbers.SUMMARY.table(
        "cases",
        "Errors at check points over the course",
        "RMS of all points and times; worst: RMS of the worst time; by the cameras: without the errors of image "
        "points, orbit and attitude.",
        {name: numbers.SUMMARY(run.cases[key]) for key, name in names.items() if key in run.cases},
        numbers.SUMMARY.headed,
        "cameras",
    )


def _angle(run: MonitorRun) -> Section:
    error = (run.angle.change_rad - run.angle_change) / ARCSEC
    text = (
        f"The true angle changes by {np.ptp(run.angle_change) / ARCSEC:.3g} arcsec over the course. The monitor "
        f"measures it with an error of {rms(error):.2g} arcsec RMS, {np.abs(error).max():.2g} arcsec at worst.",
    )
    caption = f"Estimator {run.estimator}, all frames."
    figure = _figure("angle", "Intersection angle over the orbit", caption, _angle_figure, run)
    return Section("Intersection angle", text, (figure, *(_changes(run, name) for name in run.pair)))


def _changes(run: MonitorRun, name: str) -> Table:
    both = np.stack([run.truth[name], run.monitored[name].vector], axis=-1) * PER_SI[:, None]
    heads = ["time [min]"]
    for key in PARAMETERS:
        heads += [f"{SYMBOLS[key]} [{'µm' if key == 'd_f' else 'arcsec'}]", "monitored"]
    rows = np.column_stack([run.times / 60.0, both.reshape(len(both), -1)]) + 0.0
    title = f"Changes of {name}, true and monitored"
    decimals = (1, *([3] * 6), 1, 1)
    return Table(f"changes-{name.lower()}", title, "Changes since the reference.", heads, rows.tolist(), decimals)


def _height(run: MonitorRun) -> Section:
    text = (
        f"A common pitch of both cameras by one arcsecond, which the monitor does not measure, changes heights by "
        f"{abs(run.conversion.of_common):.2f} m.",
    )
    caption = "Above: mean over the points. Below: all errors, with the points' noise."
    figure = _figure("height", "Height errors over the orbit", caption, _height_figure, run)
    return Section("Heights with and without monitoring", text, (figure,))


def _smoothed(run: MonitorRun) -> Section:
    chosen = run.smoothed
    consistency = chosen.consistency
    table = numbers.SMOOTHED.table(
        "smoothing",
        "Heights smoothed against heights interpolated, from the same measurements",
        "Height errors by the cameras alone, RMS over all times; sigma predicted by the smoother; largest error over "
        f"its sigma, limit {chosen.limit:.2f}; chi-square of the shifts and its degrees of freedom.",
        [numbers.SMOOTHED((run, *item)) for item in run.smoothing.items()],
        numbers.SMOOTHED.headed,
    )
    text = (
        f"Measured shifts {'agree' if consistency.agrees else 'do not agree'} with the prior: chi-square "
        f"{consistency.chi_square:.4g} for {consistency.degrees} degrees of freedom, limit {consistency.limit:.4g}.",
    )
    caption = "Mean over the points, with the total sigma of the smoothed height."
    figure = _figure("smoothed", "Heights between the measurements", caption, _smoothed_figure, run)
    return Section("Between the measurements", text, (figure, table))


def _interval(run: MonitorRun) -> Section:
    table = numbers.INTERVAL.table(
        "intervals",
        "Height error against the monitoring interval",
        "Measurements from the reference on, interpolated linearly, constant before the first and after the last.",
        [numbers.INTERVAL((run, interval)) for interval in run.intervals],
        numbers.INTERVAL.headed,
    )
    figure = _figure("interval", "RMS in height against the interval", "Over all times.", _interval_figure, run)
    return Section("Monitoring interval", (), (figure, table))


def _rest(run: MonitorRun) -> Section:
    parts = numbers.PART.table(
        "parts",
        "Parts of the corrected cameras' height error",
        "RMS and largest over all times. The signed parts add up to the whole except for products of two small errors.",
        {PARTS[name][0]: numbers.PART(part) for name, part in run.parts.items()},
        numbers.PART.headed,
        "part",
    )
    causes = numbers.CAUSE.table(
        "causes",
        f"Each cause alone, at {moment(float(run.times[run.worst]))}",
        "Height error by the cause without monitoring, and height error by the monitor's misreading of it.",
        [numbers.CAUSE((run, cause)) for cause in run.causes],
        ("what", "node", "height_without_monitoring_m", "height_left_by_monitor_m"),
    )
    size = max(map(rms, run.parts.values()))
    text = (
        f"Most of the remaining error comes from {_largest_part(run)}, {size:.2g} m RMS. With the "
        f"true four parameters, {1e3 * rms(run.parts['beyond_parameters']):.2g} mm RMS in height and "
        f"{run.residual / ARCSEC:.2g} arcsec at the worst point of a line would remain.",
        *_worse(run),
    )
    caption = "Mean over the points; parts below 5 mm are omitted."
    figure = _figure("remainder", "Remaining error after the correction", caption, _parts_figure, run)
    return Section("Sources of the remaining error", text, (figure, parts, causes))


def _worse(run: MonitorRun) -> tuple[str, ...]:
    """Return a sentence on the parameters for which the monitor's errors are larger than the true changes."""
    worse = []
    for name in run.pair:
        for k, key in enumerate(PARAMETERS):
            error, change = (rms(v[:, k]) for v in (run.clean[name] - run.truth[name], run.truth[name]))
            if error > change and key in run.spec.apply:
                worse.append(
                    f"{SYMBOLS[key]} of {name}, by {error * PER_SI[k]:.2g} {'µm' if key == 'd_f' else 'arcsec'} RMS"
                )
    if not worse:
        return ()
    return (
        f"Some errors of the monitor exceed the true changes: {'; '.join(worse)}. Exclude such parameters with the key "
        "`apply`.",
    )


def _conversion(run: MonitorRun) -> Section:
    conversion = run.conversion
    table = numbers.BY_CAMERA.table(
        "conversion",
        "Height changes",
        "Height change when a whole camera is rotated by 1 arcsec about its Y, by ray trace and by base to height, and "
        "for an error of each parameter in the analysis, as a bias of the monitor causes it.",
        {name: numbers.BY_CAMERA((run, name)) for name in run.pair},
        label="camera",
    )
    text = (
        f"Base to height is {conversion.base_to_height:.3f}. One arcsecond of the angle, half from each camera, "
        f"changes heights by {abs(conversion.of_angle):.2f} m.",
    )
    return Section("From arcseconds to metres", text, (table,))


def _noise(run: MonitorRun) -> Section:
    scatter, (low, high) = run.scatter, run.scatter.limits
    verdict = "lies within" if scatter.agrees else "lies outside"
    text = (
        f"In {len(scatter.heights)} measurements at {moment(float(run.times[run.worst]))}, with reference images and "
        f"detectors' patterns drawn anew, heights scatter by {1e3 * scatter.spread:.2f} mm; the monitor's covariance "
        f"predicts {1e3 * scatter.sigma:.2f} mm. The ratio {scatter.spread / scatter.sigma:.3f} {verdict} its limits "
        f"{low:.2f} to {high:.2f} (false alarm {FALSE_ALARM:g}).",
    )
    return Section("Noise of the monitor", text)


def _warnings(run: MonitorRun) -> tuple[str, ...]:
    warnings = [*coarse_warnings(run.setup), *run.doubts]
    together = run.together.get(run.spec.cadence)
    warnings += [jump_text(jump) for jump in (together.jumps if together is not None else None) or ()]
    warnings += numbers.MONITOR.warnings(run)
    if run.cases["monitored"].camera_height_rms > run.cases["none"].camera_height_rms:
        warnings.append("monitoring makes heights worse: errors of the monitor are larger than the cameras' changes")
    return tuple(warnings)


def _loop_verdict(run: LoopRun) -> tuple[str, tuple[str, ...]]:
    closed, opened = height_rms(run.closed), height_rms(run.open)
    sigma, unobservable = rms(run.closed.posterior(run.closed.slopes)[1]), rms(run.unobservable_sigma[0])
    prefix = "" if run.margins_hold else f"the loop is {'barely stable' if run.stable else 'unstable'}; "
    if run.worse:
        prefix += f"the loop makes {names_text(list(run.worse))} worse; "
    return answer(
        f"{prefix}with the loop closed the height error by the cameras is {significant(closed, 2)} m RMS over the "
        f"orbit, with the loop open {significant(opened, 2)} m; the posterior's sigma is {significant(sigma, 2)} m",
        f"unobservable motions cause {significant(unobservable, 2)} m, which no gain can remove, and {_margin(run)}",
    )


def _margin(run: LoopRun) -> str:
    if not math.isfinite(run.margin):
        return "no correction is active"
    phase = f", the smallest phase margin {run.phase_deg:.0f} deg" if math.isfinite(run.phase_deg) else ""
    return f"the gain margin of all loops together is {significant(run.margin, 3)}{phase}"


def _loop_summary(run: LoopRun) -> Table:
    return numbers.PASS.table(
        "loop",
        "Errors with the loop open and closed",
        "RMS over the moments. Height: mean over the points, by the cameras alone; all errors: of each point, with "
        "those of image points, orbit and attitude; σ: predicted by the posterior; MTF with the pixel at Nyquist, "
        "smallest value.",
        {"loop open": numbers.PASS((run, run.open)), "loop closed": numbers.PASS((run, run.closed))},
        numbers.PASS.headed,
        "course",
    )


def _orbit(run: LoopRun) -> Section:
    caption = "True values by the exact trace; bands: posterior ±σ after each reading."
    course = _figure("course", "Errors over the orbit", caption, _course_figure, run)
    mechanisms = _figure("positions", "Positions of the mechanisms", "When images are taken.", _positions_figure, run)
    columns: dict[str, list[float]] = {"time_s": run.closed.course.times.tolist()}
    for label, outcome in (("open", run.open), ("closed", run.closed)):
        columns |= {f"{label}_{key}": values for key, values in numbers.MOMENTS(outcome).items()}
    for corrector in run.model.correctors:
        columns[f"{corrector.name} [{corrector.unit[0]}]"] = numbers.positions(run, corrector.name).tolist()
    rows = csv_table([list(columns), *zip(*columns.values(), strict=True)]).decode()
    text = (
        f"With the true cameras, {significant(run.closed.flight.true_case.height_rms, 2)} m RMS in height would "
        "remain, by image points, orbit and attitude.",
    )
    return Section("Over the orbit", text, (course, mechanisms, CsvFile("moments", "All numbers", "", rows)))


def _loops(run: LoopRun) -> Section:
    rows = {name: numbers.CORRECTION((run, name, loop)) for name, loop in run.loops.items()}
    for row in rows.values():
        row["mechanism"] = row["mechanism"] or "on the ground"
    table = numbers.CORRECTION.table(
        "corrections",
        "Each correction as a loop",
        "Limit: gain below which a loop of this delay is stable. Cycle: largest limit cycle, in steps, of a mechanism "
        "with discrete steps. Observed: share of a mechanism's unmodelled response that one reading of the spots "
        "reveals.",
        rows,
        (
            *("camera", "quantity", "mechanism", "gain", "delay", "gain_limit", "gain_margin", "phase_margin_deg"),
            *("cycle_steps", "observed_share"),
        ),
        "name",
    )
    text = (f"The spectral radius of all loops together, with the coupling between mechanisms, is {run.radius:.3f}.",)
    return Section("Stability", text, (table,))


def _unobservable(run: LoopRun) -> Section:
    rows = []
    for mode in run.modes:
        row = {
            key: v if isinstance(v, dict | list) or abs(v) > _LEAST else 0.0
            for key, v in numbers.MODE((run, mode)).items()
        }
        rows.append(row | {"bodies": _bodies(mode), "motions": _motions(run, mode)})
    table = numbers.MODE.table(
        "unobservable-modes",
        "Unobservable modes",
        f"Combinations of motions of the prior that move no spot, for one standard deviation of each. "
        f"First and second camera: {run.pair[0]} and {run.pair[1]}.",
        rows,
        ("height_m", "angle_arcsec", "defocus_first_um", "defocus_second_um", "bodies", "motions"),
    )
    height = rms(run.unobservable_sigma[0])
    foci = " and ".join(significant(1e6 * float(focus.max()), 2) for focus in run.unobservable_sigma[1:])
    text = (
        f"The monitor has {run.model.prior.spots.shape[0]} spot coordinates for {len(run.model.prior.labels)} motions "
        f"of the prior. Unobservable motions cause {significant(height, 2)} m in height and {foci} µm of defocus, one "
        "standard deviation.",
    )
    return Section("Unobservable modes", text, (table,))


def _bodies(mode: UnobservableMode) -> str:
    return ", ".join(f"{body} {share:.0%}" for body, share in list(mode.bodies.items())[:_BODIES])


def _motions(run: LoopRun, mode: UnobservableMode) -> str:
    motions = numbers.motions_of(run, mode)[:_MOTIONS]
    return ", ".join(
        f"{motion['motion']} {significant(motion['amount'], 2, sign=True)} {motion['unit']}" for motion in motions
    )


def _worse_warnings(run: LoopRun) -> Iterator[str]:
    """Yield a warning for every error that is larger with the loop closed."""
    for label, (open_error, closed_error) in run.worse.items():
        times = (
            f"{significant(closed_error / open_error, 3)} times that of the loop open"
            if open_error
            else "0 with the loop open"
        )
        yield f"the loop makes {label} worse: its error, RMS over the moments, is {times}"


def _loop_warnings(run: LoopRun) -> tuple[str, ...]:
    warnings = [*coarse_warnings(run.setup)]
    for name, loop in run.loops.items():
        if loop.ends:
            first = moment(float(run.closed.course.times[loop.ends[0]]))
            warnings.append(
                f"{name} reaches the end of its range at {len(loop.ends)} of the readings, first at {first}"
            )
        if loop.cycle is not None and loop.cycle.steps > 1:
            warnings.append(
                f"{name} can oscillate by {loop.cycle.steps} steps without any drift (limit cycle): a smaller "
                "gain, a shorter delay or a dead band prevents it"
            )
    for label, course in (("closed", run.closed.course), ("open", run.open.course)):
        warnings += [f"with the loop {label} {jump_text(loop)}" for loop in course.jumps]
        warnings += numbers.PASS.warnings((run, run.closed if label == "closed" else run.open))
        if course.evidence is not None:
            spots = [channel.key for channel in run.model.experiment.path.channels]
            doubt = course.evidence.course_doubt([moment(float(time)) for time in course.times], spots)
            warnings += [] if doubt is None else [f"with the loop {label}, {doubt}"]
    worst = max(run.ratios, key=lambda name: run.ratios[name])
    if run.ratios[worst] > run.ratio_limit:
        warnings.append(
            f"errors of the posterior's {worst} reach {run.ratios[worst]:.3g} times its sigma, limit "
            f"{run.ratio_limit:.2f} (false alarm {disturbances.FALSE_ALARM:g})"
        )
    return tuple(warnings)
