"""Report of a search for jitter."""

from __future__ import annotations

import numpy as np

from analysis.arrays import ARCSEC
from twin.orbit.jitter.jitter_numbers import FoundLine, blind_multiples, found_lines, noise_factors, transfers
from twin.orbit.jitter.jitter_plots import figure_svg
from twin.orbit.jitter.jitter_run import JitterRun, PassJitter
from twin.run.artefact import Cell, CsvFile, SvgFigure, Table, decimals_for, fixed, significant
from twin.run.data_files import csv_table
from twin.run.report import Report, Section, answer

_COURSE = 0.02
"""Seconds between rows of the course at least."""
_ROWS = 5000
_MOST_WRONG = 0.3
_NAMED = 8
"""Aliases that a sentence names."""
_FIT = 1.3
"""Times the covariances' noise: more is worth a warning."""


def jitter_report(run: JitterRun) -> Report:
    """Report of a run."""
    sections = []
    for name, one in run.passes.items():
        suffix = "" if len(run.passes) == 1 else f"-{name.lower()}"
        head = "" if len(run.passes) == 1 else f" of {name}"
        sections += [_spectrum(run, one, suffix, head), _blind(one, suffix, head), _course(run, one, suffix, head)]
    return Report(
        "Jitter of the attitude", *_verdict(run), _facts(run), _summary(run), tuple(sections), warnings=_warnings(run)
    )


def _verdict(run: JitterRun) -> tuple[str, tuple[str, ...]]:
    rate = run.setup.test.search.false_alarm
    every = [one for name in run.passes for one in found_lines(run, run.passes[name])]
    if not every:
        least = min(float(np.median(one.found.detectable[~one.found.before.blind])) for one in run.passes.values())
        return answer(
            f"No oscillation was found, at a false-alarm rate of {rate:g} over all frequencies",
            f"one of {significant(least / ARCSEC, 2)} arcsec would have been, at half of the frequencies",
        )
    best = max(every, key=lambda one: float(np.max(one.one.found.lines.amplitude[one.number])))
    f, sigma = best.frequency
    sizes = ", ".join(
        f"{axis} {significant(v / ARCSEC, 3)} ± {significant(s / ARCSEC, 1)} arcsec"
        for axis, v, s in zip(
            run.axes,
            best.one.found.lines.amplitude[best.number],
            best.one.found.lines.amplitude_sigma[best.number],
            strict=True,
        )
    )
    more = f"{len(every)} oscillations were found" if len(every) > 1 else "One oscillation was found"
    return answer(
        f"{more}, the largest at {fixed(f, decimals_for(sigma))} ± {fixed(sigma, decimals_for(sigma))} Hz: {sizes}",
        f"the false-alarm rate is {rate:g} over all frequencies that were looked at",
        "; ".join(text for one in every for text in _doubts(one)),
        "see Blind frequencies for those that the lines cannot see",
    )


def _doubts(one: FoundLine) -> list[str]:
    """Return what makes a frequency another one than it seems."""
    frequency = f"{one.frequency[0]:.4g} Hz"
    doubts = []
    if not one.in_search:
        doubts.append(f"{frequency} lies beyond the search, in which it shows as a slower oscillation")
    if one.aliases:
        others = ", ".join(f"{f:.4g}" for f in one.aliases[:_NAMED]) + (" ..." if len(one.aliases) > _NAMED else "")
        doubts.append(f"{frequency} may as well be {others} Hz: the points' moments do not tell them apart")
    return doubts


def _facts(run: JitterRun) -> tuple[tuple[str, str], ...]:
    search = run.setup.test.search
    return (
        ("Camera", run.setup.camera.name),
        ("Frequencies", f"{search.lowest:g} to {search.highest:g} Hz"),
        ("Axes", ", ".join(run.axes)),
        ("False-alarm rate", f"{search.false_alarm:g} over all frequencies"),
        ("Description", run.setup.test.description),
    )


def _summary(run: JitterRun) -> Table:
    rows: list[tuple[Cell, ...]] = []
    heads = ["pass", "frequency [Hz]", "σ [Hz]"]
    for axis in run.axes:
        heads += [f"{axis} [arcsec]", f"σ {axis}", f"{axis} [px]"]
    heads.append("chance")
    true = ["true [Hz]", *(f"true {axis}" for axis in run.axes)] if run.simulated else []
    for name, one in run.passes.items():
        for found in found_lines(run, one):
            lines, k = one.found.lines, found.number
            cells: list[Cell] = [name, *found.frequency]
            for a, s in zip(lines.amplitude[k], lines.amplitude_sigma[k], strict=True):
                cells += [float(a / ARCSEC), float(s / ARCSEC), float(a / one.sights.pixel)]
            cells.append(float(lines.chance[k]))
            if true:
                truth = found.truth
                stated = (None, *(None for _ in run.axes)) if truth is None else (truth[0], *(truth[1] / ARCSEC))
                cells += [None if v is None else float(v) for v in stated]
            rows.append(tuple(cells))
    return Table(
        "oscillations",
        "Oscillations found",
        "Amplitudes are half of what swings from end to end; chance is the largest probability that noise alone shows "
        "one like it anywhere.",
        (*heads, *true),
        rows,
        digits=4,
    )


def _spectrum(run: JitterRun, one: PassJitter, suffix: str, head: str) -> Section:
    found, sights = one.found, one.sights
    left = float(found.after.chance(found.after.power[found.after.best]))
    text = (
        f"{sights.points} places were seen by two of {', '.join(sights.lines)} or more, over "
        f"{sights.observations.span:.3g} s. At every frequency an oscillation is fitted to what the lines disagree by; "
        "nothing is interpolated. The readings of the attitude serve as a slow reference only, so that their noise "
        "and their interval are not in the spectrum.",
        f"{found.used.mean():.1%} of the observations were used; the rest were wrong matches. What remains beside the "
        f"oscillations is the noise that the points' covariances say times {_factors(one)}; the highest "
        f"power in it has a chance of {significant(left, 2)}. Aliases of what was found were looked for up to "
        f"{found.beyond:.4g} Hz.",
    )
    f, before = found.before.frequency, found.before
    rows: list[tuple[Cell, ...]] = []
    for k in range(len(f)):
        cells: list[Cell] = [float(f[k])]
        for a in range(len(run.axes)):
            least = found.detectable[k, a]
            sigma = before.sigma[k, a]
            cells += [
                float(before.amplitude[k, a] / ARCSEC),
                float(found.after.amplitude[k, a] / ARCSEC),
                float(sigma / ARCSEC) if np.isfinite(sigma) else None,
                float(least / ARCSEC) if np.isfinite(least) else None,
                float(before.response[k, a]),
            ]
        rows.append((*cells, int(before.blind[k])))
    heads = ["frequency [Hz]"]
    for axis in run.axes:
        heads += [f"{axis} [arcsec]", f"{axis} left", f"σ {axis}", f"{axis} detectable", f"{axis} response"]
    listed = csv_table([(*heads, "blind"), *rows]).decode()
    full = CsvFile(f"frequencies{suffix}", "Amplitudes by frequency, all numbers", "", listed)
    spectrum = SvgFigure(
        f"spectrum{suffix}",
        "Amplitudes by frequency",
        "Fitted at every frequency; an oscillation above the dashed line would be found.",
        figure_svg("spectrum", run, one),
    )
    disparity = SvgFigure(
        f"disparity{suffix}",
        "Disparities over time",
        "What the second line sees farther along and later than the first, less what is smooth over the strip.",
        figure_svg("disparity", run, one),
    )
    shown = transfers(run, one)
    if not shown:
        return Section(f"Spectrum{head}", text, (disparity, spectrum, full))
    directions = list(next(iter(shown.values())))
    table = Table(
        f"transfer{suffix}",
        "What the oscillations do to the images",
        "Transfer at Nyquist of all that were found, root mean square over their phases, by the time over which each "
        "line collects light.",
        ("line", *(word.replace("_", " the " if word == "along_track" else " ") for word in directions)),
        [(name, *values.values()) for name, values in shown.items()],
        digits=4,
    )
    return Section(f"Spectrum{head}", text, (disparity, spectrum, table, full))


def _factors(one: PassJitter) -> str:
    return ", ".join(f"{factor:.2g} in {line}" for line, factor in noise_factors(one).items())


def _blind(one: PassJitter, suffix: str, head: str) -> Section:
    rows: list[tuple[Cell, ...]] = [
        (m.first, m.second, m.gap * 1e3, m.order, m.frequency, m.response, "blind" if m.blind else "seen")
        for m in blind_multiples(one)
    ]
    table = Table(
        f"blind{suffix}",
        "Where two lines by themselves are blind",
        "A whole number of periods between their sights; the response is that of all lines together, of the worst axis "
        "as against its best.",
        ("first", "second", "gap [ms]", "periods", "frequency [Hz]", "response", "by all lines"),
        rows,
        (None, None, 2, None, 3, 3, None),
    )
    intervals = [f"{a:.3g} to {b:.3g} Hz" for a, b in one.found.before.intervals()]
    text = (
        f"All lines together are blind at {', '.join(intervals)}; no oscillation is sought there."
        if intervals
        else "All lines together are blind nowhere among the frequencies that were looked at.",
    )
    return Section(f"Blind frequencies{head}", text, (table,))


def _course(run: JitterRun, one: PassJitter, suffix: str, head: str) -> Section:
    first, last = one.sights.observations.ends
    step = max(_COURSE, (last - first) / _ROWS)
    seconds = np.arange(first, last, step)
    heads, columns = ["time [s]"], [seconds]
    sources = [("", one.found.lines.course(seconds))]
    if one.course is not None:
        sources.append((" spline", one.course.at(seconds)))
    for word, (value, spread) in sources:
        for k, axis in enumerate(run.axes):
            heads += [f"{axis}{word} [arcsec]", f"σ {axis}{word}"]
            columns += [value[:, k] / ARCSEC, np.sqrt(np.maximum(spread[:, k, k], 0.0)) / ARCSEC]
    rows = csv_table([heads, *np.stack(columns, axis=-1).tolist()]).decode()
    full = CsvFile(f"attitude{suffix}", "Attitude over time, all numbers", "", rows)
    figure = SvgFigure(
        f"course{suffix}",
        "Attitude over time",
        "Less what is slow. Its mean and what is blind are not in it.",
        figure_svg("course", run, one),
    )
    return Section(f"Course{head}", (), (figure, full))


def _warnings(run: JitterRun) -> tuple[str, ...]:
    found = []
    for name, one in run.passes.items():
        if one.found.used.mean() < 1.0 - _MOST_WRONG:
            found.append(f"{1.0 - one.found.used.mean():.0%} of the observations of {name} were left out as wrong")
        if max(noise_factors(one).values()) > _FIT:
            found.append(
                f"what remains in {name} is the noise that the points' covariances say times {_factors(one)}: noise of "
                "a band, or covariances that are too small"
            )
        found += [f"{name}: {text}" for line in found_lines(run, one) for text in _doubts(line)]
    return tuple(found)
