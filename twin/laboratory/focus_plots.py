"""Figures of the focal-plane alignment: curves through focus, defocus before and after, MTF curves, edges."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.mtf.slanted_edge import measure_edge
from analysis.units import UM_PER_M as UM
from twin.laboratory.focus_alignment import Alignment, State
from twin.run.svg import BLUE, GREEN, GREY, INK, ORANGE, PURPLE, VERMILION, look, new_figure, plain_axes, to_svg
from twin.targets.target_images import ALONG, DIRECTION_NAMES, DIRECTIONS, TRACK

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FIELD_COLOURS = (BLUE, GREEN, ORANGE, VERMILION, PURPLE)
EDGE_COLOURS = {ALONG: BLUE, TRACK: VERMILION}
PER_MM = 1e-3


def through_focus_svg(alignment: Alignment) -> str:
    """Curves through focus of every band, before the first and after the last shims."""
    with look("through-focus"):
        return to_svg(_through_focus(alignment))


def defocus_svg(alignment: Alignment) -> str:
    """Measured and true defocus of every site before and after."""
    with look("defocus"):
        return to_svg(_defocus(alignment))


def mtf_svg(alignment: Alignment) -> str:
    """MTF curves in the middle of the field after the alignment, measured and true."""
    with look("mtf-curves"):
        return to_svg(_mtf(alignment))


def edges_svg(alignment: Alignment) -> str:
    """One recorded edge of the first and the last band."""
    with look("edges"):
        return to_svg(_edges(alignment))


def _through_focus(alignment: Alignment) -> Figure:
    bench = alignment.bench
    bands = list(bench.ccds)
    figure = new_figure(5.6)
    grid = figure.subplots(2, len(bands), squeeze=False)
    fields = list(dict.fromkeys(site.field for site in bench.sites))
    for row, (state, title) in enumerate(((alignment.states[0], "before"), (alignment.states[-1], "after"))):
        for column, band in enumerate(bands):
            axes = grid[row, column]
            for site, scan in zip(bench.sites, state.scans, strict=True):
                if site.band != band:
                    continue
                colour = FIELD_COLOURS[fields.index(site.field) % len(FIELD_COLOURS)]
                mean = np.mean([scan.mtf[e] for e in DIRECTIONS], axis=0)
                error = np.sqrt(sum(scan.sigma[e] ** 2 for e in DIRECTIONS)) / len(DIRECTIONS)
                good = np.isfinite(error)
                shift = np.mean([scan.shift[e] for e in DIRECTIONS], axis=0)
                label = f"field {site.field:g}".replace("-", "−") if row == 0 and column == 0 else None
                axes.errorbar(
                    UM * shift[good], mean[good], error[good], fmt="o-", ms=2.4, lw=0.9, color=colour, label=label
                )
                axes.axvline(UM * scan.defocus, color=colour, lw=0.6, ls=":")
            axes.axvline(0.0, color=INK, lw=0.8)
            axes.set_title(f"{band}, {title}")
            axes.set_ylim(bottom=0.0)
            if row == 1:
                axes.set_xlabel("move of the image [µm]")
            if column == 0:
                axes.set_ylabel("MTF at Nyquist, mean\nof both directions")
            plain_axes(axes)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(fields))
    return figure


def _defocus(alignment: Alignment) -> Figure:
    bench = alignment.bench
    figure = new_figure(3.4)
    panels = figure.subplots(1, 2)
    for axes, state, title in zip(
        panels, (alignment.states[0], alignment.states[-1]), ("before", "after"), strict=True
    ):
        _defocus_panel(axes, alignment, state)
        axes.set_title(f"{title}: CCDs against best focus")
        axes.set(xlabel="along the line Y′ [mm]", ylabel="CCD downstream of focus [µm]")
        plain_axes(axes)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(bench.ccds) + 1)
    return figure


def _defocus_panel(axes: Axes, alignment: Alignment, state: State) -> None:
    bench = alignment.bench
    for k, band in enumerate(bench.ccds):
        which = [i for i, site in enumerate(bench.sites) if site.band == band]
        along = 1e3 * np.array([bench.sites[i].place[1] for i in which])
        colour = FIELD_COLOURS[k % len(FIELD_COLOURS)]
        sigma = UM * state.defocus_sigma[which]
        axes.errorbar(along, UM * state.defocus[which], sigma, fmt="o", ms=3.5, lw=1.0, color=colour, label=band)
        axes.plot(along, UM * state.true_defocus[which], "_", ms=11, color=colour, alpha=0.8)
    axes.plot([], [], "_", ms=11, color=GREY, label="truth")
    axes.axhline(0.0, color=INK, lw=0.7)


def _mtf(alignment: Alignment) -> Figure:
    bench, state = alignment.bench, alignment.states[-1]
    figure = new_figure(3.0)
    panels = figure.subplots(1, len(bench.ccds), sharey=True, squeeze=False)[0]
    for axes, band in zip(panels, bench.ccds, strict=True):
        number = min((i for i, s in enumerate(bench.sites) if s.band == band), key=lambda i: abs(bench.sites[i].field))
        site, ccd = bench.sites[number], bench.ccds[band]
        defocus = float(site.crossing(state.standing.pose, state.standing.heights[band])[2])
        for edge in DIRECTIONS:
            frames = state.focus[number].frames[edge]
            measured = measure_edge(frames.mean(axis=0), noise=ccd.noise, frames=len(frames))
            frequency = measured.frequency / ccd.band.pitch
            true = np.abs(site.imagers[edge].transfer(defocus, frequency))
            colour = EDGE_COLOURS[edge]
            axes.fill_between(
                PER_MM * frequency,
                measured.mtf - 2.0 * measured.sigma,
                measured.mtf + 2.0 * measured.sigma,
                color=colour,
                alpha=0.25,
                lw=0,
            )
            axes.plot(PER_MM * frequency, measured.mtf, color=colour, lw=1.2, label=DIRECTION_NAMES[edge])
            axes.plot(PER_MM * frequency, true, color=INK, lw=0.8, ls="--", label="truth" if edge == TRACK else None)
        axes.axvline(PER_MM * ccd.band.nyquist, color=GREY, lw=0.8, ls=":")
        axes.set(title=band, xlabel="cycles/mm", xlim=(0.0, PER_MM / ccd.band.pitch), ylim=(0.0, 1.02))
        plain_axes(axes)
    panels[0].set_ylabel("MTF")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3)
    return figure


def _edges(alignment: Alignment) -> Figure:
    bench, state = alignment.bench, alignment.states[-1]
    bands = list(bench.ccds)[:: max(len(bench.ccds) - 1, 1)]
    figure = new_figure(2.9)
    panels = figure.subplots(1, 2 * len(bands), squeeze=False)[0]
    for k, band in enumerate(bands):
        number = min((i for i, s in enumerate(bench.sites) if s.band == band), key=lambda i: abs(bench.sites[i].field))
        for axes, edge in zip(panels[2 * k : 2 * k + 2], DIRECTIONS, strict=True):
            axes.imshow(state.focus[number].frames[edge][0], cmap="gray", interpolation="none")
            axes.set_title(f"{band}, measures\n{DIRECTION_NAMES[edge]}")
            axes.set(xlabel="pixel along the line", ylabel="line" if edge == ALONG and k == 0 else "")
    return figure
