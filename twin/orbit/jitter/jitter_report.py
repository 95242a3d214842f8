"""Report of a search for jitter, with its figures: disparities over time, spectrum, course."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from analysis.arrays import ARCSEC
from analysis.statistics import robust_sigma
from twin.framework import svg
from twin.framework.artefact import Cell, CsvFile, SvgFigure, Table, decimals_for, fixed, significant
from twin.framework.data_files import csv_table
from twin.framework.report import Report, Section, answer
from twin.orbit.jitter.jitter_run import MULTIPLE, JitterRun, Oscillation, PassJitter, blind_multiples, transfers

_MOST, _SIGMAS = 4000, 5.0
"""Points of a drawn disparity, and robust standard deviations to either side that its axis reaches."""
_COURSE, _ROWS = 0.02, 5000
"""Seconds between the rows of a course, and rows of a long one."""
_MOST_WRONG = 0.3
"""Share of left-out observations that is told."""
_NAMED = 8
"""Aliases that are named."""
_FIT = 1.3
"""Noise that remains, in sigmas of the covariances, from which it is told."""


def jitter_report(run: JitterRun) -> Report:
    """Report of a search."""
    sections = []
    for name, one in run.passes.items():
        suffix, head = ("", "") if len(run.passes) == 1 else (f"-{name.lower()}", f" of {name}")
        sections += [_spectrum(one, suffix, head), _blind(one, suffix, head), _course(one, suffix, head)]
    search = run.setup.test.search
    facts = (
        ("Camera", run.setup.camera.name),
        ("Frequencies", f"{search.lowest:g} to {search.highest:g} Hz"),
        ("Axes", ", ".join(search.axes)),
        ("False-alarm rate", f"{search.false_alarm:g} over all frequencies"),
        ("Description", run.setup.test.description),
    )
    return Report(
        "Jitter of the attitude", *_verdict(run), facts, _summary(run), tuple(sections), warnings=_warnings(run)
    )


def _verdict(run: JitterRun) -> tuple[str, tuple[str, ...]]:
    search = run.setup.test.search
    every = [line for one in run.passes.values() for line in one.oscillations]
    if not every:
        least = min(float(np.median(one.found.detectable[~one.found.before.blind])) for one in run.passes.values())
        return answer(
            f"No oscillation was found, at a false-alarm rate of {search.false_alarm:g} over all frequencies",
            f"one of {significant(least / ARCSEC, 2)} arcsec would have been, at half of the frequencies",
        )
    best = max(every, key=lambda line: float(np.max(line.amplitude[0])))
    frequency, sigma = (fixed(value, decimals_for(best.frequency[1])) for value in best.frequency)
    sizes = ", ".join(
        f"{axis} {significant(v / ARCSEC, 3)} ± {significant(s / ARCSEC, 1)} arcsec"
        for axis, v, s in zip(search.axes, *best.amplitude, strict=True)
    )
    more = f"{len(every)} oscillations were found" if len(every) > 1 else "One oscillation was found"
    return answer(
        f"{more}, the largest at {frequency} ± {sigma} Hz: {sizes}",
        f"the false-alarm rate is {search.false_alarm:g} over all frequencies that were looked at",
        "; ".join(text for line in every for text in _doubts(line)),
        "see Blind frequencies for those that the lines cannot see",
    )


def _doubts(line: Oscillation) -> list[str]:
    """Why the frequency may be another."""
    frequency, doubts = f"{line.frequency[0]:.4g} Hz", []
    if not line.in_search:
        doubts.append(f"{frequency} lies beyond the search, in which it shows as a slower oscillation")
    if line.aliases:
        others = ", ".join(f"{f:.4g}" for f in line.aliases[:_NAMED]) + " ..." * (len(line.aliases) > _NAMED)
        doubts.append(f"{frequency} may as well be {others} Hz: the points' moments do not tell them apart")
    return doubts


def _summary(run: JitterRun) -> Table:
    axes = run.setup.test.search.axes
    heads = ["pass", "frequency [Hz]", "σ [Hz]"]
    heads += [head for axis in axes for head in (f"{axis} [arcsec]", f"σ {axis}", f"{axis} [px]")]
    heads += ["chance", *(("true [Hz]", *(f"true {axis}" for axis in axes)) if run.simulated else ())]
    rows: list[tuple[Cell, ...]] = []
    for name, one in run.passes.items():
        for line in one.oscillations:
            sizes = np.stack([*(v / ARCSEC for v in line.amplitude), line.pixels], axis=-1).ravel()
            cells = (name, *line.frequency, *sizes.tolist(), float(one.found.lines.chance[line.number]))
            truth: tuple[Cell, ...] = (None,) * (1 + len(axes)) if run.simulated else ()
            if line.truth is not None:
                truth = (line.truth[0], *(line.truth[1] / ARCSEC).tolist())
            rows.append((*cells, *truth))
    return Table(
        "oscillations",
        "Oscillations found",
        "Amplitudes are half of what swings from end to end; chance is the largest probability that noise alone shows "
        "one like it anywhere.",
        heads,
        rows,
        digits=4,
    )


def _spectrum(one: PassJitter, suffix: str, head: str) -> Section:
    found, sights, axes = one.found, one.sights, one.setup.test.search.axes
    text = (
        f"{sights.points} places were seen by two of {', '.join(sights.lines)} or more, over "
        f"{sights.observations.span:.3g} s. {found.used.mean():.1%} of the observations were used; the rest were wrong "
        "matches. What remains beside the oscillations is the noise that the points' covariances say times "
        f"{_factors(one)}; the highest power in it has a chance of {significant(one.chance_of_the_next, 2)}. Aliases "
        f"of what was found were looked for up to {found.beyond:.4g} Hz.",
    )
    before, after = found.before, found.after
    in_arcsec = np.stack([before.amplitude, after.amplitude, before.sigma, found.detectable], axis=-1) / ARCSEC
    columns = np.concatenate([in_arcsec, before.response[..., None]], axis=-1).reshape(len(before.frequency), -1)
    heads = ["frequency [Hz]"]
    for axis in axes:
        heads += [f"{axis} [arcsec]", f"{axis} left", f"σ {axis}", f"{axis} detectable", f"{axis} response"]
    rows = [
        (float(frequency), *(value if np.isfinite(value) else None for value in row), int(blind))
        for frequency, row, blind in zip(before.frequency, columns.tolist(), before.blind, strict=True)
    ]
    listed = csv_table([(*heads, "blind"), *rows]).decode()
    parts: list[Any] = [
        SvgFigure(
            f"disparity{suffix}",
            "Disparities over time",
            "What the second line sees farther along and later than the first, less what is smooth over the strip.",
            svg.drawn("jitter-disparity", _disparity_figure, one),
        ),
        SvgFigure(
            f"spectrum{suffix}",
            "Amplitudes by frequency",
            "Fitted at every frequency; an oscillation above the dashed line would be found.",
            svg.drawn("jitter-spectrum", _spectrum_figure, one),
        ),
    ]
    if shown := transfers(one):
        directions = [
            word.replace("_", " the " if word == "along_track" else " ") for word in next(iter(shown.values()))
        ]
        parts.append(
            Table(
                f"transfer{suffix}",
                "What the oscillations do to the images",
                "Transfer at Nyquist of all that were found, root mean square over their phases, by the time over "
                "which each line collects light.",
                ("line", *directions),
                [(name, *values.values()) for name, values in shown.items()],
                digits=4,
            )
        )
    full = CsvFile(f"frequencies{suffix}", "Amplitudes by frequency, all numbers", "", listed)
    return Section(f"Spectrum{head}", text, (*parts, full))


def _factors(one: PassJitter) -> str:
    return ", ".join(f"{factor:.2g} in {line}" for line, factor in one.noise_factors.items())


def _blind(one: PassJitter, suffix: str, head: str) -> Section:
    table = MULTIPLE.table(
        f"blind{suffix}",
        "Where two lines by themselves are blind",
        "A whole number of periods between their sights; the response is that of all lines together, of the worst axis "
        "as against its best.",
        [MULTIPLE(of) | {"blind": "blind" if of.blind else "seen"} for of in blind_multiples(one)],
    )
    intervals = ", ".join(f"{a:.3g} to {b:.3g} Hz" for a, b in one.found.before.intervals())
    text = (
        f"All lines together are blind at {intervals}; no oscillation is sought there."
        if intervals
        else "All lines together are blind nowhere among the frequencies that were looked at.",
    )
    return Section(f"Blind frequencies{head}", text, (table,))


def _course(one: PassJitter, suffix: str, head: str) -> Section:
    first, last = one.sights.observations.ends
    seconds = np.arange(first, last, max(_COURSE, (last - first) / _ROWS))
    heads, columns = ["time [s]"], [seconds]
    sources = [("", one.found.lines.course(seconds))]
    if one.course is not None:
        sources.append((" spline", one.course.at(seconds)))
    for word, (value, spread) in sources:
        for k, axis in enumerate(one.setup.test.search.axes):
            heads += [f"{axis}{word} [arcsec]", f"σ {axis}{word}"]
            columns += [value[:, k] / ARCSEC, np.sqrt(np.maximum(spread[:, k, k], 0.0)) / ARCSEC]
    rows = csv_table([heads, *np.stack(columns, axis=-1).tolist()]).decode()
    full = CsvFile(f"attitude{suffix}", "Attitude over time, all numbers", "", rows)
    figure = SvgFigure(
        f"course{suffix}",
        "Attitude over time",
        "Less what is slow. Its mean and what is blind are not in it.",
        svg.drawn("jitter-course", _course_figure, one),
    )
    return Section(f"Course{head}", (), (figure, full))


def _panels(one: PassJitter, least: float, each: float, label: str) -> tuple[Figure, list[Axes]]:
    """A panel for each axis of the body, below each other."""
    names = one.setup.test.search.axes
    figure = svg.new_figure(least + each * len(names))
    panels = list(np.atleast_1d(figure.subplots(len(names), 1, sharex=True)))
    for axes, name in zip(panels, names, strict=True):
        axes.set_ylabel(f"{name} [arcsec]")
        svg.gridded(axes)
    panels[-1].set_xlabel(label)
    return figure, panels


def _disparity_figure(one: PassJitter) -> Figure:
    """Disparities of the widest pair of neighbours over time."""
    pair, (seconds, moved) = max(one.sights.pairs.items(), key=lambda item: abs(one.sights.gaps[item[0]][1]))
    figure = svg.new_figure(4.0)
    panels = figure.subplots(2, 1, sharex=True)
    step = max(len(seconds) // _MOST, 1)
    for axes, column, words in zip(panels, moved.T, ("along the line", "along the track"), strict=True):
        axes.plot(seconds[::step], column[::step], ".", color=svg.BLUE, ms=2.5)
        middle = np.median(column)
        reach = _SIGMAS * robust_sigma(column - middle)
        axes.set(ylim=(middle - reach, middle + reach), ylabel=f"{words} [px]")
        svg.gridded(axes)
    panels[1].set_xlabel(f"time of the sight by {pair[0]}, before {pair[1]} [s]")
    return figure


def _spectrum_figure(one: PassJitter) -> Figure:
    """Amplitude over frequency, before and after the oscillations found are taken out."""
    found = one.found
    figure, panels = _panels(one, 2.0, 2.0, "frequency [Hz]; shaded: blind")
    for k, axes in enumerate(panels):
        for which, colour, label in ((found.before, svg.SKY, "observed"), (found.after, svg.BLUE, "beside all found")):
            shown = np.where(which.blind, np.nan, which.amplitude[:, k] / ARCSEC)
            axes.semilogy(which.frequency, shown, color=colour, lw=0.9, label=label)
        least = np.where(np.isfinite(found.detectable[:, k]), found.detectable[:, k] / ARCSEC, np.nan)
        axes.semilogy(found.before.frequency, least, color=svg.VERMILION, lw=1.0, ls="--", label="would be found")
        for first, last in found.before.intervals():
            axes.axvspan(first, last, color=svg.LIGHT, lw=0)
        for value in found.lines.frequency:
            axes.axvline(value, color=svg.INK, lw=0.6, ls=":")
    panels[0].legend(loc="best")
    return figure


def _course_figure(one: PassJitter) -> Figure:
    """Attitude over time by the oscillations, and by the spline."""
    seconds = np.linspace(*one.sights.observations.ends, 1200)
    figure, panels = _panels(one, 1.5, 1.7, "time [s]")
    curves = [(one.found.lines.course(seconds), svg.BLUE, svg.SKY, "oscillations found, with σ")]
    if one.course is not None:
        curves.insert(0, (one.course.at(seconds), svg.GREEN, svg.LIGHT, "spline, with σ"))
    for k, axes in enumerate(panels):
        for (value, spread), colour, shade, label in curves:
            middle, sigma = value[:, k] / ARCSEC, np.sqrt(spread[:, k, k]) / ARCSEC
            axes.fill_between(seconds, middle - sigma, middle + sigma, lw=0, color=shade, alpha=0.6)
            axes.plot(seconds, middle, color=colour, lw=1.0, label=label)
        if one.truth is not None:
            axes.plot(seconds, one.truth(seconds)[:, one.columns[k]] / ARCSEC, color=svg.INK, lw=0.5, label="true")
    panels[0].legend(loc="best")
    return figure


def _warnings(run: JitterRun) -> tuple[str, ...]:
    found = []
    for name, one in run.passes.items():
        if one.found.used.mean() < 1.0 - _MOST_WRONG:
            found.append(f"{1.0 - one.found.used.mean():.0%} of the observations of {name} were left out as wrong")
        if max(one.noise_factors.values()) > _FIT:
            found.append(
                f"what remains in {name} is the noise that the points' covariances say times {_factors(one)}: noise of "
                "a band, or covariances that are too small"
            )
        found += [f"{name}: {text}" for line in one.oscillations for text in _doubts(line)]
    return tuple(found)
