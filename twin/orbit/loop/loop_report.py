"""Report of a loop along an orbit."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from analysis.monitor.disturbances import FALSE_ALARM
from analysis.monitor.model_fit import UnseenMode
from analysis.units import ARCSEC
from scenes.specs.course import moment
from scenes.yaml.errors import names_text
from twin.monitor.time_series import jump_text
from twin.orbit.loop.loop_numbers import IMAGES, LOOP, PASS, angle_of, motions_of, positions
from twin.orbit.loop.loop_plots import figure_svg
from twin.orbit.loop.loop_run import LoopFacts, LoopRun, height_rms
from twin.orbit.monitoring.monitoring_run import rms
from twin.run.artefact import Cell, CsvFile, SvgFigure, Table, significant
from twin.run.data_files import csv_table
from twin.run.report import Report, Section, answer
from twin.sensors.area_detector import coarse_warnings

_BODIES, _MOTIONS = 3, 3
"""Bodies and motions of a mode that are named in words."""


def loop_report(run: LoopRun) -> Report:
    """Report of a run."""
    return Report(
        "A monitor in the loop",
        *_verdict(run),
        _facts(run),
        _summary(run),
        (_orbit(run), *_images(run), _loops(run), _unseen(run)),
        warnings=(*LOOP.warnings(run), *_worse(run), *_warnings(run)),
    )


def _verdict(run: LoopRun) -> tuple[str, tuple[str, ...]]:
    left, free = height_rms(run.closed), height_rms(run.open)
    sigma, hidden = rms(run.closed.told(run.closed.slopes)[1]), rms(run.unseen[0])
    stands = "" if run.margins_hold else f"the loop is {'barely stable' if run.stable else 'unstable'}; "
    if run.worse:
        stands += f"the loop makes {names_text(list(run.worse))} worse; "
    angle = rms(run.closed.true(run.closed.angle)) / ARCSEC, rms(run.open.true(run.open.angle)) / ARCSEC
    return answer(
        f"{stands}with the loop closed the cameras make height errors of {significant(left, 2)} m RMS over the orbit, "
        f"with the loop open {significant(free, 2)} m; the posterior's sigma is {significant(sigma, 2)} m",
        f"what no spot shows costs {significant(hidden, 2)} m, which no gain takes away, and {_margin(run)}",
        f"the angle between the lines of sight is {significant(angle[0], 2)} arcsec RMS off, with the loop open "
        f"{significant(angle[1], 2)} arcsec",
        _focus_words(run),
    )


def _margin(run: LoopRun) -> str:
    if not math.isfinite(run.margin):
        return "no correction acts"
    phase = f", the smallest phase margin {run.phase_deg:.0f} deg" if math.isfinite(run.phase_deg) else ""
    return f"all gains together may be {significant(run.margin, 3)} times as large before the loop is unstable{phase}"


def _focus_words(run: LoopRun) -> str:
    """What the loop does to the focus, and what the spots tell of it."""
    told = []
    for k, name in enumerate(run.pair):
        row = run.model.row(name, "defocus")
        prior = float(np.sqrt(_row_variance(run, row)))
        if prior > 0.0:
            told.append(f"{float(run.unseen[1 + k].max()) / prior:.1%} of {name}'s")
    return f"of the standard deviation of the focus the spots leave {' and '.join(told)} as it was" if told else ""


def _row_variance(run: LoopRun, row: int) -> float:
    """Variance of one of the quantities before any reading."""
    effect = run.model.stated.parameters[row]
    return float(effect @ run.model.stated.correlation @ effect)


def _facts(run: LoopRun) -> tuple[tuple[str, str], ...]:
    test, errors = run.setup.test, run.setup.test.errors
    on = errors.switched_on
    assert run.setup.disturbances is not None
    return (
        ("Instrument", f"{run.setup.instrument.name}, {run.setup.instrument.description}"),
        ("Pair", f"{run.pair[0]} against {run.pair[1]}"),
        ("Readings", f"{test.readings.count}, every {moment(test.readings.every)}, rendered and recovered"),
        ("Disturbances", f"{run.setup.disturbances.name}, drawn by its laws in time, which the estimate knows"),
        ("Check points", f"{test.ground.points} at each moment, both views from the state at that moment"),
        ("Lines of sight", "exact, traced; points are drawn about them; matched where line images are rendered"),
        ("Image points", f"σ {errors.image:g} px" if on else "exact"),
        ("Monitor's frames", "with noise" if on and errors.monitor else "without noise"),
        ("Description", test.description),
    )


def _summary(run: LoopRun) -> Table:
    return PASS.table(
        "loop",
        "What the loop leaves",
        "RMS over the moments. Height: mean over the points, by the cameras alone; all errors: of each point, with "
        "those of image points, orbit and attitude; σ: as the posterior says it; MTF at Nyquist, the least of all.",
        {"loop open": PASS((run, run.open)), "loop closed": PASS((run, run.closed))},
        [one.key for one in PASS if one.head],
        "course",
    )


def _orbit(run: LoopRun) -> Section:
    course = SvgFigure(
        "course",
        "What is left over the orbit",
        "True values by the exact trace; bands are what the posterior says after each reading, ±σ.",
        figure_svg("course", run),
    )
    places = SvgFigure(
        "positions", "Where the mechanisms stand", "When images are taken.", figure_svg("positions", run)
    )
    heads = ["time [s]"]
    columns: list[np.ndarray] = [run.closed.course.times]
    for label, one in (("open", run.open), ("closed", run.closed)):
        told, sigma = one.told(one.slopes)
        heads += [f"{label} angle [arcsec]", f"{label} height [m]", f"{label} height told [m]", f"{label} σ [m]"]
        columns += [one.true(one.angle) / ARCSEC, one.heights.camera, told, sigma]
    for corrector in run.model.correctors:
        heads.append(f"{corrector.name} [{corrector.unit[0]}]")
        columns.append(positions(run, corrector.name))
    rows = csv_table([heads, *np.stack(columns, axis=-1).tolist()]).decode()
    text = (
        "At every moment the spots are rendered where the mechanisms stand and recovered, the filter of the stated "
        "laws takes them less what the known positions do to the spots, commands go out, mechanisms move, and images "
        "are taken. The estimate never sees the state.",
        f"True cameras leave {significant(run.bare.height_rms, 2)} m RMS in height by image points, orbit and "
        "attitude.",
        "Turns that both cameras share with the base turn the body and not the angle: no monitor sees them, the star "
        "trackers do.",
    )
    return Section("Over the orbit", text, (course, places, CsvFile("moments", "All numbers", "", rows)))


def _images(run: LoopRun) -> tuple[Section, ...]:
    if not run.closed.images:
        return ()
    rows = {
        f"{label}, {moment(float(one.course.times[pair.moment]))}": IMAGES((one, pair))
        for label, one in (("open", run.open), ("closed", run.closed))
        for pair in one.images
    }
    table = IMAGES.table(
        "images",
        "Heights from rendered line images",
        "Points of the second camera's image, matched in the first one's: mean height error with σ by their scatter; "
        "the same of drawn points over the whole swath, and by the cameras alone; matching, found minus true place, "
        "and the σ that it states.",
        rows,
        [one.key for one in IMAGES if one.head and one.key != "time_s"],
        "loop, after",
    )
    text = (
        "At these moments both lines are rendered over the same ground through the states that the mechanisms have "
        "left, their points matched, and intersected by the lines that the user knows.",
    )
    return (Section("Line images", text, (table,)),)


def _loops(run: LoopRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for name, one in run.loops.items():
        spec = one.corrector.spec
        rows.append(
            (
                name,
                f"{spec.camera} {spec.quantity}",
                spec.mechanism or "on the ground",
                spec.gain,
                spec.delay,
                one.margins.limit,
                one.margins.gain if math.isfinite(one.margins.gain) else None,
                one.margins.phase_deg if math.isfinite(one.margins.phase_deg) else None,
                None if one.cycle is None else one.cycle.steps,
                _of_seen(run, one),
            )
        )
    table = Table(
        "corrections",
        "Each correction as a loop",
        "Limit: gain below which a loop of this delay is stable. Cycle: steps by which a mechanism of whole steps goes "
        "to and fro at worst although nothing changes. Told: share of what a mechanism does beyond what is known that "
        "the spots tell.",
        (
            "name",
            "quantity",
            "mechanism",
            "gain",
            "delay",
            "limit",
            "gain margin",
            "phase margin [deg]",
            "cycle",
            "told",
        ),
        rows,
        (None, None, None, 3, None, 4, 2, 1, None, 3),
    )
    text = (
        "An integrator of gain g whose command has its effect d readings later has the open loop "
        "L(z) = g z^-(d+1) / (1 - 1/z) by readings, and is stable below g = 2 sin(π / (4 d + 2)).",
        f"Together, with what mechanisms do to each other's quantities, the largest eigenvalue is {run.radius:.3f}.",
    )
    figure = SvgFigure(
        "open-loop",
        "Open loop, and what the closed loop leaves of a drift",
        "Left: L in the complex plane with the point −1. Right: share of a swing that is left when images are taken.",
        figure_svg("open-loop", run),
    )
    return Section("Stability", text, (table, figure))


def _of_seen(run: LoopRun, one: LoopFacts) -> float | None:
    if one.corrector.motion is None:
        return None
    return float(run.model.seen[[c.name for c in run.model.correctors].index(one.corrector.name)])


def _unseen(run: LoopRun) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for mode in run.modes:
        height, *foci = mode.quantities.tolist()
        angle = angle_of(run, mode) / ARCSEC
        told = (height, angle, *(1e6 * f for f in foci))
        rows.append((*(v if abs(v) > _LEAST else 0.0 for v in told), _bodies(mode), _motions(run, mode)))
    table = Table(
        "unseen",
        "Motions that no spot shows",
        "For one standard deviation of each mode: combinations of stated motions that leave every spot where it is.",
        ("height [m]", "angle [arcsec]", *(f"defocus {name} [µm]" for name in run.pair), "bodies", "largest motions"),
        rows,
        (3, 4, 2, 2, None, None),
    )
    hidden = rms(run.unseen[0])
    foci = " and ".join(significant(1e6 * float(one.max()), 2) for one in run.unseen[1:])
    text = (
        f"{run.model.stated.spots.shape[0]} spot coordinates stand against {len(run.model.stated.labels)} stated "
        f"motions. What they do to heights and no spot shows is {significant(hidden, 2)} m, to the focus {foci} µm, "
        "one standard deviation; no gain, no rate of readings and no filter goes below, unless something else than the "
        "spots is measured.",
    )
    return Section("What the loop cannot see", text, (table,))


_LEAST = 1e-6


def _bodies(mode: UnseenMode) -> str:
    return ", ".join(f"{body} {share:.0%}" for body, share in list(mode.bodies.items())[:_BODIES])


def _motions(run: LoopRun, mode: UnseenMode) -> str:
    every = motions_of(run, mode)[:_MOTIONS]
    return ", ".join(f"{one['motion']} {significant(one['amount'], 2, sign=True)} {one['unit']}" for one in every)


def _worse(run: LoopRun) -> Iterator[str]:
    """Yield a warning of every error that is larger with the loop closed."""
    for label, (free, left) in run.worse.items():
        times = f"{significant(left / free, 3)} times that of the loop open" if free else "0 with the loop open"
        yield f"the loop makes {label} worse: its error, RMS over the moments, is {times}"


def _warnings(run: LoopRun) -> tuple[str, ...]:
    out = [*coarse_warnings(run.setup)]
    for name, one in run.loops.items():
        if one.ends:
            first = moment(float(run.closed.course.times[one.ends[0]]))
            out.append(f"the range of {name} ends: held at {len(one.ends)} of the readings, first at {first}")
        if one.cycle is not None and one.cycle.steps > 1:
            out.append(
                f"{name} can go to and fro by {one.cycle.steps} steps although nothing changes: a smaller gain, a "
                "shorter delay or a dead band stops it"
            )
    for label, course in (("closed", run.closed.course), ("open", run.open.course)):
        out += [f"with the loop {label} {jump_text(one)}" for one in course.jumps]
        out += PASS.warnings((run, run.closed if label == "closed" else run.open))
        if course.evidence is not None:
            spots = [channel.key for channel in run.model.experiment.path.channels]
            doubt = course.evidence.course_doubt([moment(float(time)) for time in course.times], spots)
            out += [] if doubt is None else [f"with the loop {label}, {doubt}"]
    worst = max(run.ratios, key=lambda name: run.ratios[name])
    if run.ratios[worst] > run.ratio_limit:
        out.append(
            f"the posterior's {worst} is wrong by up to {run.ratios[worst]:.3g} of its sigma, limit "
            f"{run.ratio_limit:.2f} (false alarm {FALSE_ALARM:g})"
        )
    return tuple(out)
