"""Report of a monitored orbit: the main table, sections."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.monitor.monitoring import PER_SI
from analysis.units import ARCSEC
from scenes.specs.course import moment
from scenes.specs.orbit.monitor import PARAMETERS
from twin.monitor.time_series import jump_text
from twin.orbit.monitoring.monitoring_numbers import MONITOR, SUMMARY
from twin.orbit.monitoring.monitoring_plots import PART_NAMES, figure_svg
from twin.orbit.monitoring.monitoring_run import FALSE_ALARM, MonitorRun, rms
from twin.run.artefact import SYMBOLS, Cell, SvgFigure, Table
from twin.run.report import Report, Section, answer
from twin.sensors.area_detector import coarse_warnings

if TYPE_CHECKING:
    from scenes.specs.orbit.setup import MonitorSetup


def _sections(run: MonitorRun) -> tuple[Section, ...]:
    """All parts."""
    smoothed = (_smoothed(run),) if run.smoothing else ()
    return (_angle(run), _height(run), *smoothed, _interval(run), _rest(run), _conversion(run), _noise(run))


def _angle(run: MonitorRun) -> Section:
    error = (run.angle - run.angle_change) / ARCSEC
    text = (
        f"Traced, the angle changes by {np.ptp(run.angle_change) / ARCSEC:.3g} arcsec over the course. The monitor "
        f"follows it to {rms(error):.2g} arcsec RMS, {np.abs(error).max():.2g} arcsec at worst. Both are counted from "
        f"the reference at {moment(run.flight.spec.reference)}, when the cameras were calibrated and the monitor took "
        "its reference.",
    )
    figure = SvgFigure(
        "angle",
        "Intersection angle over the orbit",
        f"Estimator {run.flight.estimator}, all frames.",
        figure_svg("angle", run),
    )
    return Section("Intersection angle", text, (figure, *(_changes(run, name) for name in run.flight.pair)))


def _changes(run: MonitorRun, name: str) -> Table:
    flight = run.flight
    rows: list[tuple[Cell, ...]] = []
    for time, true, monitored in zip(flight.times, flight.truth[name], flight.monitored[name].vector, strict=True):
        both = zip(true * PER_SI, monitored * PER_SI, strict=True)
        rows.append((float(time / 60.0), *(float(v) + 0.0 for pair in both for v in pair)))
    heads = ["time [min]"]
    for key in PARAMETERS:
        heads += [f"{SYMBOLS[key]} [{'µm' if key == 'd_f' else 'arcsec'}]", "monitored"]
    return Table(
        f"changes-{name.lower()}",
        f"Changes of {name}, true and monitored",
        "Since the reference.",
        tuple(heads),
        rows,
        (1, *([3] * 6), 1, 1),
    )


def _height(run: MonitorRun) -> Section:
    floor = run.cases["true"]
    text = (
        "What the cameras alone do is the difference to the true cameras with the same image points, orbit and "
        f"attitude. True cameras leave {floor.height_rms:.3g} m in height and {floor.plan_rms:.3g} m in plan.",
        "Attitude errors that both cameras share turn the body, not the angle: the monitor does not see them. One "
        f"arcsecond in pitch of both makes {abs(run.conversion.of_common):.2f} m of height, for the pair does not look "
        "evenly forward and back.",
    )
    caption = "Above: mean over the points. Below: all errors, with the points' noise."
    figure = SvgFigure("height", "Height errors over the orbit", caption, figure_svg("height", run))
    return Section("Heights with and without monitoring", text, (figure,))


def _smoothed(run: MonitorRun) -> Section:
    spec, stated = run.flight.spec, run.setup.disturbances
    assert stated is not None
    chosen = run.smoothed
    found = chosen.consistency
    rows: list[tuple[Cell, ...]] = [
        (
            float(interval / 60.0),
            len(spec.measured(interval)),
            one.interpolated.camera_height_rms,
            one.case.camera_height_rms,
            one.factor,
            rms(one.sigma),
            one.furthest,
            one.consistency.chi_square / one.consistency.degrees,
        )
        for interval, one in run.smoothing.items()
    ]
    table = Table(
        "smoothing",
        "Heights smoothed against heights interpolated, from the same measurements",
        "By the cameras alone, RMS over all times, metres; the sigma that the smoother states; the largest error over "
        f"its sigma, limit {chosen.limit:.2f}; chi-square of the shifts over its degrees of freedom.",
        ("interval [min]", "measurements", "linear [m]", "smoothed [m]", "factor", "σ [m]", "largest/σ", "χ²/n"),
        rows,
        (1, None, 3, 3, 2, 3, 2, 2),
    )
    fits = "agree" if found.agrees else "do not agree"
    reach = "lies within" if chosen.agrees else "goes beyond"
    text = (
        f"All measurements together, by the prior ({stated.name}) and its time laws: the best "
        f"linear estimate at every time. Measured every {moment(spec.interval)}, it makes the cameras' height error "
        f"{_times(chosen.factor, 'smaller')} than values that are linear between the measurements.",
        f"Its sigma is {rms(chosen.sigma):.2f} m RMS; the largest error is {chosen.furthest:.2f} of its sigma, which "
        f"{reach} the limit of {chosen.limit:.2f} (false alarm at most {FALSE_ALARM:g}). Measured shifts {fits} with "
        f"the prior: chi-square {found.chi_square:.4g} of {found.degrees} degrees of freedom, limit "
        f"{found.limit:.4g}.",
    )
    caption = "Mean over the points, with the total sigma of the smoothed height."
    figure = SvgFigure("smoothed", "Heights between the measurements", caption, figure_svg("smoothed", run))
    return Section("Between the measurements", text, (figure, table))


def _interval(run: MonitorRun) -> Section:
    rows: list[tuple[Cell, ...]] = [
        (
            float(interval / 60.0),
            len(run.flight.spec.measured(interval)),
            case.height_rms,
            case.worst,
            case.camera_height_rms,
            case.plan_rms,
        )
        for interval, case in run.intervals.items()
    ]
    table = Table(
        "intervals",
        "Height error against the monitoring interval",
        "Measured from the reference on, linear between, held before the first and after the last; metres.",
        ("interval [min]", "measurements", "height RMS", "worst time", "by the cameras", "plan RMS"),
        rows,
        (1, None, 3, 3, 3, 3),
    )
    figure = SvgFigure("interval", "RMS in height against the interval", "Over all times.", figure_svg("interval", run))
    return Section("How often to measure", (), (figure, table))


def _rest(run: MonitorRun) -> Section:
    flight = run.flight
    rows: list[tuple[Cell, ...]] = [
        (PART_NAMES[name], rms(part), float(np.abs(part).max())) for name, part in run.parts.items()
    ]
    parts = Table(
        "parts",
        "Parts of the corrected cameras' height error",
        "Metres, over all times; signed, they add up to the whole but for products of two small errors.",
        ("part", "RMS [m]", "largest [m]"),
        rows,
        (None, 4, 4),
    )
    causes: list[tuple[Cell, ...]] = []
    for cause in flight.causes:
        without, left = run.cause_heights(cause)
        errors = [float(cause.error[n][0] / ARCSEC) + 0.0 for n in flight.pair]
        causes.append((cause.what, cause.path, without, left, *errors))
    table = Table(
        "causes",
        f"Each cause alone, at {moment(float(flight.times[flight.worst]))}",
        "Height that it makes without monitoring, and height that the monitor makes by misreading it; error of the "
        "monitored Δα.",
        ("cause", "node", "unmonitored [m]", "misread [m]", *(f"{n} Δα [arcsec]" for n in flight.pair)),
        causes,
        (None, None, 3, 3, 4, 4),
    )
    largest = max(run.parts, key=lambda name: rms(run.parts[name]))
    text = (
        f"Most of the rest comes from {PART_NAMES[largest]}, {rms(run.parts[largest]):.2g} m RMS. A prism that bends "
        "the beam by its own temperature looks to the monitor like a camera that has turned.",
        "The true four parameters put through the correction leave "
        f"{1e3 * rms(run.parts['beyond_parameters']):.2g} mm RMS in height and {run.residual / ARCSEC:.2g} arcsec at "
        "the worst place of a line: what a camera does beyond them, such as a change of distortion.",
        *_worse(run),
    )
    caption = "Mean over the points; parts below 5 mm are left out."
    figure = SvgFigure("remainder", "What the correction leaves", caption, figure_svg("remainder", run))
    return Section("Where the rest comes from", text, (figure, parts, table))


def _worse(run: MonitorRun) -> tuple[str, ...]:
    """What the monitor says worse than nothing would."""
    flight, found = run.flight, []
    for name in flight.pair:
        for k, key in enumerate(PARAMETERS):
            error, change = (rms(v[:, k]) for v in (flight.clean[name] - flight.truth[name], flight.truth[name]))
            if error > change and key in flight.spec.apply:
                found.append(
                    f"{SYMBOLS[key]} of {name}, by {error * PER_SI[k]:.2g} {'µm' if key == 'd_f' else 'arcsec'} RMS"
                )
    if not found:
        return ()
    return (
        f"The monitor misreads by more than the true change: {'; '.join(found)}. Such values are better left out, by "
        "the key apply.",
    )


def _conversion(run: MonitorRun) -> Section:
    conversion, flight = run.conversion, run.flight
    rows: list[tuple[Cell, ...]] = []
    at = flight.spec.referred
    for name in flight.pair:
        slopes = [float(v) for v in run.slopes[name][at] / PER_SI]
        rows.append((name, conversion.traced[name], conversion.theory[name], *slopes))
    table = Table(
        "conversion",
        "Metres of height",
        "Of a whole camera turned by 1 arcsec about its Y and traced, by base to height, and of each parameter that "
        "the analysis is told wrongly: a bias of the monitor acts like this.",
        (
            "camera",
            "traced [m/arcsec]",
            "theory [m/arcsec]",
            "Δα [m/arcsec]",
            "Δβ [m/arcsec]",
            "Δγ [m/arcsec]",
            "Δf [m/µm]",
        ),
        rows,
        (None, 4, 4, 4, 4, 4, 6),
    )
    predicted = -sum(run.slopes[n][:, 0] * flight.truth[n][:, 0] for n in flight.pair)
    none = run.cases["none"].camera
    size = rms(none) or 1.0
    by_angle = -conversion.of_angle * run.angle_change / ARCSEC
    text = (
        f"Base to height is {conversion.base_to_height:.3f}. An arcsecond of the angle, half from each camera, is "
        f"{abs(conversion.of_angle):.2f} m; it is more by the camera that looks farther aside, so that the angle alone "
        f"gives the height without monitoring to {100.0 * rms(none - by_angle) / size:.1f}% of its RMS, and the "
        f"Δα of both cameras to {100.0 * rms(none - predicted) / size:.1f}%.",
    )
    return Section("From arcseconds to metres", text, (table,))


def _noise(run: MonitorRun) -> Section:
    seen, (low, high) = run.scatter, run.scatter.limits
    verdict = "agrees" if seen.agrees else "does not agree"
    text = (
        f"Measured {len(seen.heights)} times at {moment(float(run.flight.times[run.flight.worst]))}, reference images "
        f"and detectors' patterns drawn anew, heights scatter by {1e3 * seen.spread:.2f} mm; the monitor's covariance "
        f"propagates to {1e3 * seen.sigma:.2f} mm. The ratio {seen.spread / seen.sigma:.3f} {verdict} with its limits "
        f"{low:.2f} to {high:.2f} (false alarm {FALSE_ALARM:g}).",
    )
    return Section("Noise of the monitor", text)


def monitor_report(run: MonitorRun) -> Report:
    """Report of a monitored orbit."""
    setup = run.setup
    cases, spec = run.cases, setup.test
    none, chosen, floor = cases["none"], cases["interval"], cases["true"]
    bought = none.height_rms - chosen.height_rms
    others = floor.height_rms**2 > 0.5 * chosen.height_rms**2
    limit = "images, orbit and attitude" if others else "the remaining errors of the monitor"
    verdict, more = answer(
        f"Monitoring every {moment(spec.interval)} changes the heights' error from {none.height_rms:.2f} m to "
        f"{chosen.height_rms:.2f} m RMS{'' if bought > 0.0 else ', which is no gain'}",
        f"with the true cameras {floor.height_rms:.2f} m would remain, so that {limit} cause most of the error",
        f"the intersection angle changes by {np.ptp(run.angle_change) / ARCSEC:.2g} arcsec: see the errors over the "
        "course",
        _gain(run),
    )
    lead = (
        *more,
        f"The cameras alone: {none.camera_height_rms:.2f} m without, {chosen.camera_height_rms:.2f} m with this "
        f"interval, {cases['monitored'].camera_height_rms:.2f} m monitored at every time. "
        f"One arcsecond of the angle is {abs(run.conversion.of_angle):.1f} m of height.",
    )
    return Report(
        "What on-board monitoring buys on the ground",
        verdict,
        lead,
        _facts(setup),
        _table(run),
        _sections(run),
        warnings=_warnings(run),
    )


def _times(factor: float, less: str) -> str:
    """Factor by which an error is smaller, or larger, in words."""
    if factor >= 1.0:
        return f"{factor:.2f} times {less}"
    return f"{1.0 / factor:.2f} times {'more' if less == 'less' else 'larger'}"


def _gain(run: MonitorRun) -> str:
    """What smoothing buys at the file's interval; empty where nothing is stated to move."""
    if not run.smoothing:
        return ""
    chosen = run.smoothed
    fits = "agrees with" if chosen.agrees else "contradicts"
    return (
        f"smoothed together, the same measurements leave {chosen.case.camera_height_rms:.2f} m by the cameras, "
        f"{_times(chosen.factor, 'less')} than by linear interpolation, which {fits} their sigma of "
        f"{rms(chosen.sigma):.2f} m"
    )


def _table(run: MonitorRun) -> Table:
    spec = run.flight.spec
    names = {
        "none": "as calibrated, no monitoring",
        "interval": f"monitored every {moment(spec.interval)}",
        "smoothed": "the same measurements, smoothed",
        "monitored": "monitored at every time",
        "parameters": "true four parameters (bound)",
        "true": "true cameras (bound)",
    }
    return SUMMARY.table(
        "cases",
        "Errors at check points over the course",
        "RMS of all points and times; worst: RMS of the worst time; by the cameras: without image, orbit and attitude.",
        {name: SUMMARY(run.cases[key]) for key, name in names.items() if key in run.cases},
        [one.key for one in SUMMARY if one.head],
        "cameras",
    )


def _facts(setup: MonitorSetup) -> tuple[tuple[str, str], ...]:
    test, errors = setup.test, setup.test.errors
    times = test.course.times
    span = f"{moment(times[0])} to {moment(times[-1])} in steps of {moment(test.step)}"
    on = errors.switched_on
    return (
        ("Instrument", f"{setup.instrument.name}, {setup.instrument.description}"),
        ("Pair", f"{setup.pair[0]} against {setup.pair[1]}"),
        ("Course", f"{span}, from {test.orbit.epoch}"),
        ("Reference", moment(test.reference)),
        ("Applied", ", ".join(test.apply)),
        (
            "Disturbances",
            setup.disturbances.name if setup.disturbances else "none stated: sigmas are of the noise alone",
        ),
        ("Check points", f"{test.ground.points} at each time, both views from the state at that time"),
        ("Image points", f"σ {errors.image:g} px, drawn, not matched in images" if on else "exact"),
        ("Monitor's frames", "with noise" if on and errors.monitor else "without noise"),
        ("Calibration at the reference", "taken as exact"),
        ("Effects on the light", "taken as corrected"),
        ("Description", test.description),
    )


def _warnings(run: MonitorRun) -> tuple[str, ...]:
    out = [*coarse_warnings(run.setup), *run.flight.doubts]
    together = run.flight.smoothed.get(run.flight.spec.interval)
    out += [jump_text(one) for one in (together.jumps if together is not None else None) or ()]
    out += MONITOR.warnings(run)
    if run.cases["monitored"].camera_height_rms > run.cases["none"].camera_height_rms:
        out.append("monitoring makes heights worse: the monitor's own errors are larger than the cameras' changes")
    return tuple(out)
