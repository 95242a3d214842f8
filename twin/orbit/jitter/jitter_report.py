"""Report of a search for jitter, with its figures: disparities over time, spectrum, attitude over time."""

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
from twin.framework.report import Report, Section, answer, inputs
from twin.orbit.jitter.jitter_run import JitterRun, Oscillation, PassJitter, transfers

_MOST, _SIGMAS = 4000, 5.0
"""Largest number of points drawn in a figure of disparities, and half range of its vertical axis in robust standard
deviations.
"""
_COURSE, _ROWS = 0.02, 5000
"""Smallest time between rows of the table of attitude over time, in seconds, and largest number of its rows."""
_MOST_WRONG = 0.3
"""Share of rejected observations (gross errors) above which there is a warning."""
_NAMED = 8
"""Largest number of alias frequencies of an oscillation that the report lists."""
_FIT = 1.3
"""Scatter of the residuals, divided by the sigmas of the points, above which there is a warning."""


def jitter_report(run: JitterRun) -> Report:
    """Return the report of a search for jitter: detected oscillations, spectra and attitude over time."""
    sections = []
    for name, jitter in run.passes.items():
        suffix, head = ("", "") if len(run.passes) == 1 else (f"-{name.lower()}", f" of {name}")
        sections += [_spectrum(jitter, suffix, head), _course(jitter, suffix, head)]
    camera, test = run.setup.camera.name, run.setup.test
    facts = (("Camera", camera), *inputs(test, "search"), ("Description", test.description))
    return Report(
        "Jitter of the attitude", *_verdict(run), facts, _summary(run), tuple(sections), warnings=_warnings(run)
    )


def _verdict(run: JitterRun) -> tuple[str, tuple[str, ...]]:
    search = run.setup.test.search
    oscillations = [line for jitter in run.passes.values() for line in jitter.oscillations]
    if not oscillations:
        least = min(
            float(np.median(jitter.result.detectable[~jitter.result.before.blind])) for jitter in run.passes.values()
        )
        return answer(
            f"No oscillation was detected, at a false-alarm rate of {search.false_alarm:g} over all frequencies",
            f"at half of the frequencies, {significant(least / ARCSEC, 2)} arcsec would have been detected",
        )
    best = max(oscillations, key=lambda line: float(np.max(line.amplitude[0])))
    frequency, sigma = (fixed(value, decimals_for(best.frequency[1])) for value in best.frequency)
    sizes = ", ".join(
        f"{axis} {significant(v / ARCSEC, 3)} ± {significant(s / ARCSEC, 1)} arcsec"
        for axis, v, s in zip(search.axes, *best.amplitude, strict=True)
    )
    more = f"{len(oscillations)} oscillations detected" if len(oscillations) > 1 else "One oscillation detected"
    return answer(
        f"{more}, the largest at {frequency} ± {sigma} Hz: {sizes}",
        f"the false-alarm rate is {search.false_alarm:g} over all frequencies of the search",
        "; ".join(text for line in oscillations for text in _doubts(line)),
        "see the spectrum for frequencies that the lines do not observe",
    )


def _doubts(line: Oscillation) -> list[str]:
    """Return reasons, such as aliasing, why an oscillation's true frequency may differ from the detected one."""
    frequency, doubts = f"{line.frequency[0]:.4g} Hz", []
    if not line.in_search:
        doubts.append(f"{frequency} lies beyond the search range, in which it appears as a slower oscillation")
    if line.aliases:
        others = ", ".join(f"{f:.4g}" for f in line.aliases[:_NAMED]) + " ..." * (len(line.aliases) > _NAMED)
        doubts.append(f"{frequency} may also be {others} Hz (aliases): the times of the points do not distinguish them")
    return doubts


def _summary(run: JitterRun) -> Table:
    axes = run.setup.test.search.axes
    heads = ["pass", "frequency [Hz]", "σ [Hz]"]
    heads += [head for axis in axes for head in (f"{axis} [arcsec]", f"σ {axis}", f"{axis} [px]")]
    heads += ["p", *(("true [Hz]", *(f"true {axis}" for axis in axes)) if run.simulated else ())]
    rows: list[tuple[Cell, ...]] = []
    for name, jitter in run.passes.items():
        for line in jitter.oscillations:
            sizes = np.stack([*(v / ARCSEC for v in line.amplitude), line.pixels], axis=-1).ravel()
            cells = (name, *line.frequency, *sizes.tolist(), float(jitter.result.lines.p_value[line.number]))
            truth: tuple[Cell, ...] = (None,) * (1 + len(axes)) if run.simulated else ()
            if line.truth is not None:
                truth = (line.truth[0], *(line.truth[1] / ARCSEC).tolist())
            rows.append((*cells, *truth))
    return Table(
        "oscillations",
        "Detected oscillations",
        "Amplitudes are half of the peak-to-peak value; p is the largest probability that noise alone produces such a "
        "peak at any frequency.",
        heads,
        rows,
        digits=4,
    )


def _spectrum(jitter: PassJitter, suffix: str, head: str) -> Section:
    result, sights, axes = jitter.result, jitter.sights, jitter.setup.test.search.axes
    gaps = "; ".join(f"{a} to {b} {1e3 * gap:.4g} ms" for (a, b), (_, gap, _) in sights.gaps.items())
    blind = ", ".join(f"{a:.3g} to {b:.3g} Hz" for a, b in result.before.intervals())
    text = (
        f"{sights.points} points were seen by two or more of {', '.join(sights.lines)}, over "
        f"{sights.observations.span:.3g} s. {result.used.mean():.1%} of the observations were used; the others were "
        "rejected as wrong matches. The remaining noise is that of the points' covariances times "
        f"{_factors(jitter)}; its highest power has p = {significant(jitter.next_p_value, 2)}. Aliases of "
        f"the detected oscillations were searched up to {result.beyond:.4g} Hz.",
        f"Between the sightings of a point pass: {gaps}. A pair of lines alone is blind at multiples of the inverse. "
        f"No oscillation is sought where all lines together are blind: {blind or 'at no frequency of the search'}.",
    )
    before, after = result.before, result.after
    in_arcsec = np.stack([before.amplitude, after.amplitude, before.sigma, result.detectable], axis=-1) / ARCSEC
    columns = np.concatenate([in_arcsec, before.response[..., None]], axis=-1).reshape(len(before.frequency), -1)
    heads = ["frequency [Hz]"]
    for axis in axes:
        heads += [f"{axis} [arcsec]", f"{axis} remaining", f"σ {axis}", f"{axis} detectable", f"{axis} response"]
    rows = [
        (float(frequency), *(value if np.isfinite(value) else None for value in row), int(blind))
        for frequency, row, blind in zip(before.frequency, columns.tolist(), before.blind, strict=True)
    ]
    listed = csv_table([(*heads, "blind"), *rows]).decode()
    parts: list[Any] = [
        SvgFigure(
            f"disparity{suffix}",
            "Disparities over time",
            "Image position in the second line less that in the first, without parts that are smooth over the strip.",
            svg.drawn("jitter-disparity", _disparity_figure, jitter),
        ),
        SvgFigure(
            f"spectrum{suffix}",
            "Amplitudes by frequency",
            "Fitted at every frequency; an oscillation above the dashed line would be detected.",
            svg.drawn("jitter-spectrum", _spectrum_figure, jitter),
        ),
    ]
    if shown := transfers(jitter):
        directions = [
            word.replace("_", " the " if word == "along_track" else " ") for word in next(iter(shown.values()))
        ]
        parts.append(
            Table(
                f"transfer{suffix}",
                "Effect of the oscillations on the images",
                "Transfer at Nyquist of all detected oscillations, root mean square over their phases, for the "
                "integration time of each line.",
                ("line", *directions),
                [(name, *values.values()) for name, values in shown.items()],
                digits=4,
            )
        )
    full = CsvFile(f"frequencies{suffix}", "Amplitudes by frequency, all numbers", "", listed)
    return Section(f"Spectrum{head}", text, (*parts, full))


def _factors(jitter: PassJitter) -> str:
    return ", ".join(f"{factor:.2g} in {line}" for line, factor in jitter.noise_factors.items())


def _course(jitter: PassJitter, suffix: str, head: str) -> Section:
    first, last = jitter.sights.observations.ends
    seconds = np.arange(first, last, max(_COURSE, (last - first) / _ROWS))
    heads, columns = ["time [s]"], [seconds]
    sources = [("", jitter.result.lines.course(seconds))]
    if jitter.course is not None:
        sources.append((" spline", jitter.course.at(seconds)))
    for word, (value, spread) in sources:
        for k, axis in enumerate(jitter.setup.test.search.axes):
            heads += [f"{axis}{word} [arcsec]", f"σ {axis}{word}"]
            columns += [value[:, k] / ARCSEC, np.sqrt(np.maximum(spread[:, k, k], 0.0)) / ARCSEC]
    rows = csv_table([heads, *np.stack(columns, axis=-1).tolist()]).decode()
    full = CsvFile(f"attitude{suffix}", "Attitude over time, all numbers", "", rows)
    figure = SvgFigure(
        f"course{suffix}",
        "Attitude over time",
        "Fast part of the attitude, without its mean and without the frequencies that the lines cannot observe.",
        svg.drawn("jitter-course", _course_figure, jitter),
    )
    return Section(f"Attitude over time{head}", (), (figure, full))


def _panels(jitter: PassJitter, least: float, each: float, label: str) -> tuple[Figure, list[Axes]]:
    """Return a figure with one panel for each axis of the body, stacked vertically."""
    names = jitter.setup.test.search.axes
    figure = svg.new_figure(least + each * len(names))
    panels = list(np.atleast_1d(figure.subplots(len(names), 1, sharex=True)))
    for axes, name in zip(panels, names, strict=True):
        axes.set_ylabel(f"{name} [arcsec]")
        svg.gridded(axes)
    panels[-1].set_xlabel(label)
    return figure, panels


def _disparity_figure(jitter: PassJitter) -> Figure:
    """Draw the disparities over time of the pair of neighbouring lines with the longest gap."""
    pair, (seconds, moved) = max(jitter.sights.pairs.items(), key=lambda item: abs(jitter.sights.gaps[item[0]][1]))
    figure = svg.new_figure(4.0)
    panels = figure.subplots(2, 1, sharex=True)
    step = max(len(seconds) // _MOST, 1)
    for axes, column, words in zip(panels, moved.T, ("along the line", "along the track"), strict=True):
        axes.plot(seconds[::step], column[::step], ".", color=svg.BLUE, ms=2.5)
        middle = np.median(column)
        extent = _SIGMAS * robust_sigma(column - middle)
        axes.set(ylim=(middle - extent, middle + extent), ylabel=f"{words} [px]")
        svg.gridded(axes)
    panels[1].set_xlabel(f"time of the sight by {pair[0]}, before {pair[1]} [s]")
    return figure


def _spectrum_figure(jitter: PassJitter) -> Figure:
    """Draw the amplitude spectrum of the attitude before and after the detected oscillations are removed."""
    result = jitter.result
    figure, panels = _panels(jitter, 2.0, 2.0, "frequency [Hz]; shaded: blind")
    for k, axes in enumerate(panels):
        for which, colour, label in ((result.before, svg.SKY, "observed"), (result.after, svg.BLUE, "remaining")):
            shown = np.where(which.blind, np.nan, which.amplitude[:, k] / ARCSEC)
            axes.semilogy(which.frequency, shown, color=colour, lw=0.9, label=label)
        least = np.where(np.isfinite(result.detectable[:, k]), result.detectable[:, k] / ARCSEC, np.nan)
        axes.semilogy(result.before.frequency, least, color=svg.VERMILION, lw=1.0, ls="--", label="detectable")
        for first, last in result.before.intervals():
            axes.axvspan(first, last, color=svg.LIGHT, lw=0)
        for value in result.lines.frequency:
            axes.axvline(value, color=svg.INK, lw=0.6, ls=":")
    panels[0].legend(loc="best")
    return figure


def _course_figure(jitter: PassJitter) -> Figure:
    """Draw the attitude over time from the oscillations and from the spline."""
    seconds = np.linspace(*jitter.sights.observations.ends, 1200)
    figure, panels = _panels(jitter, 1.5, 1.7, "time [s]")
    curves = [(jitter.result.lines.course(seconds), svg.BLUE, svg.SKY, "detected oscillations, with σ")]
    if jitter.course is not None:
        curves.insert(0, (jitter.course.at(seconds), svg.GREEN, svg.LIGHT, "spline, with σ"))
    for k, axes in enumerate(panels):
        for (value, spread), colour, shade, label in curves:
            middle, sigma = value[:, k] / ARCSEC, np.sqrt(spread[:, k, k]) / ARCSEC
            axes.fill_between(seconds, middle - sigma, middle + sigma, lw=0, color=shade, alpha=0.6)
            axes.plot(seconds, middle, color=colour, lw=1.0, label=label)
        if jitter.truth is not None:
            axes.plot(
                seconds, jitter.truth(seconds)[:, jitter.columns[k]] / ARCSEC, color=svg.INK, lw=0.5, label="true"
            )
    panels[0].legend(loc="best")
    return figure


def _warnings(run: JitterRun) -> tuple[str, ...]:
    warnings = []
    for name, jitter in run.passes.items():
        if jitter.result.used.mean() < 1.0 - _MOST_WRONG:
            share = 1.0 - jitter.result.used.mean()
            warnings.append(f"{share:.0%} of the observations of {name} were rejected as wrong matches")
        if max(jitter.noise_factors.values()) > _FIT:
            warnings.append(
                f"the remaining noise in {name} is that of the points' covariances times {_factors(jitter)}: "
                "jitter in a band, or covariances that are too small"
            )
        warnings += [f"{name}: {text}" for line in jitter.oscillations for text in _doubts(line)]
    return tuple(warnings)
