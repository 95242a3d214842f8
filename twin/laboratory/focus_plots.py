"""Figures of the focal-plane alignment: curves through focus, defocus, MTF curves, edges."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.arrays import UM_PER_M as UM
from analysis.focal_plane.through_focus import QUARTIC, FocusVertex
from analysis.mtf.slanted_edge import measure_edge
from twin.framework import svg
from twin.laboratory.focus_run import FocusRun, FocusState, SimulatedFocus, SimulatedState
from twin.targets.target_images import ALONG, DIRECTION_NAMES, DIRECTIONS, TRACK

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FIELD_COLOURS = (svg.BLUE, svg.GREEN, svg.ORANGE, svg.VERMILION, svg.PURPLE)
EDGE_COLOURS = {ALONG: svg.BLUE, TRACK: svg.VERMILION}
PER_MM = 1e-3
_COLUMNS, _MOST_BANDS = 5, 10


def _shown(run: FocusRun) -> list[tuple[int, FocusState, str]]:
    """Number, standing and title of the first and the last standing."""
    states = run.states
    return (
        [(0, states[0], "before"), (len(states) - 1, states[-1], "after")] if len(states) > 1 else [(0, states[0], "")]
    )


def through_focus_svg(run: FocusRun) -> str:
    """Curves through focus of every band, both directions, before the first and after the last shims."""
    bands, shown = list(dict.fromkeys(run.bands))[:_MOST_BANDS], _shown(run)
    with svg.look("through-focus"):
        columns, each = min(len(bands), _COLUMNS), -(-len(bands) // _COLUMNS)
        figure = svg.new_figure(3.0 * each * len(shown) + 0.3)
        grid = figure.subplots(each * len(shown), columns, squeeze=False, sharey=True)
        for (_, state, when), panels in zip(shown, np.split(grid, len(shown)), strict=True):
            for axes, band in zip(panels.ravel(), bands, strict=False):
                _curves(axes, run, state, band)
                axes.set_title(", ".join(part for part in (band, when) if part) or "all places")
            for axes in panels.ravel()[len(bands) :]:
                axes.set_visible(False)
            panels[0, 0].set_ylabel("MTF (○ filled: along the line,\nopen: along the track)")
        for axes in grid[-1]:
            axes.set_xlabel("move of the image [µm]")
        return svg.to_svg(figure)


def _curves(axes: Axes, run: FocusRun, state: FocusState, band: str) -> None:
    own = [scan for scan, name in zip(state.scans, run.bands, strict=True) if name == band]
    for number, scan in enumerate(own):
        colour = FIELD_COLOURS[number % len(FIELD_COLOURS)]
        for edge, vertex in scan.vertex.items():
            good = np.isfinite(scan.sigma[edge])
            at, value, sigma = (each[edge][good] for each in (scan.shift, scan.mtf, scan.sigma))
            fill = colour if edge == ALONG else "white"
            axes.errorbar(UM * at, value, sigma, fmt="o", ms=2.6, lw=0.7, color=colour, mfc=fill)
            place = np.linspace(np.min(at), np.max(at), 101)
            axes.plot(UM * place, _form(vertex, place), color=colour, lw=0.8)
    axes.axvline(0.0, color=svg.INK, lw=0.8)
    axes.set_ylim(bottom=0.0)
    svg.plain_axes(axes)


def _form(vertex: FocusVertex, place: np.ndarray) -> np.ndarray:
    """The fitted curve, where it is above a third of its peak."""
    u = -0.5 * vertex.curvature / vertex.peak * (place - vertex.position) ** 2
    value = vertex.peak * (1.0 - u + QUARTIC * u**2)
    return np.where((value > vertex.peak / 3.0) & (u < 0.5 / QUARTIC), value, np.nan)


def defocus_svg(run: FocusRun) -> str:
    """Defocus of every place before the first and after the last shims, with the fitted plane; of a simulated bench the
    truth.
    """
    shown = _shown(run)
    with svg.look("defocus"):
        figure = svg.new_figure(3.4)
        panels = figure.subplots(1, len(shown), squeeze=False)[0]
        for axes, (number, state, when) in zip(panels, shown, strict=True):
            _defocus(axes, run, number, state)
            axes.set(title=when, xlabel="along the line Y′ [mm]")
        panels[0].set_ylabel("CCD downstream of focus [µm]")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=max(len(labels), 1))
        return svg.to_svg(figure)


def _defocus(axes: Axes, run: FocusRun, number: int, state: FocusState) -> None:
    for k, band in enumerate(dict.fromkeys(run.bands)):
        own = np.array(run.bands) == band
        colour, places = FIELD_COLOURS[k % len(FIELD_COLOURS)], run.places[own]
        along, sigma = 1e3 * places[:, 1], UM * state.defocus_sigma[own]
        style: dict[str, Any] = {"fmt": "o", "ms": 3.5, "lw": 1.0, "color": colour, "label": band or "all places"}
        axes.errorbar(along, UM * state.defocus[own], sigma, **style)
        if isinstance(state, SimulatedState):
            axes.plot(along, UM * state.true_defocus[own], "_", ms=11, color=colour, alpha=0.8)
        if number < len(run.shimmings):
            for x in np.unique(places[:, 0]):
                line = np.array([[x, y] for y in (np.min(places[:, 1]), np.max(places[:, 1]))])
                plane = run.shimmings[number].plane.plane(line)[0]
                axes.plot(1e3 * line[:, 1], -UM * plane, color=colour, lw=0.8, alpha=0.7)
    if isinstance(state, SimulatedState):
        axes.plot([], [], "_", ms=11, color=svg.GREY, label="truth")
    axes.axhline(0.0, color=svg.INK, lw=0.7)
    svg.plain_axes(axes)


def _middle(run: SimulatedFocus, band: str) -> int:
    """Number of the band's site that is nearest to the middle of the field."""
    sites = run.bench.sites
    return min((i for i, s in enumerate(sites) if s.band == band), key=lambda i: abs(sites[i].field))


def mtf_svg(run: SimulatedFocus) -> str:
    """MTF curves in the middle of the field after the alignment, measured and true."""
    with svg.look("mtf-curves"):
        bench, state = run.bench, run.states[-1]
        figure = svg.new_figure(3.0)
        panels = figure.subplots(1, len(bench.ccds), sharey=True, squeeze=False)[0]
        for axes, band in zip(panels, bench.ccds, strict=True):
            number = _middle(run, band)
            site, ccd = bench.sites[number], bench.ccds[band]
            defocus = state.true_place(number)
            for edge in DIRECTIONS:
                frames = state.focus[number].frames[edge]
                measured = measure_edge(frames.mean(axis=0), noise=ccd.noise, frames=len(frames), even=True)
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
                axes.plot(
                    PER_MM * frequency, true, color=svg.INK, lw=0.8, ls="--", label="truth" if edge == TRACK else None
                )
            axes.axvline(PER_MM * ccd.band.nyquist, color=svg.GREY, lw=0.8, ls=":")
            axes.set(title=band, xlabel="cycles/mm", xlim=(0.0, PER_MM / ccd.band.pitch), ylim=(0.0, 1.02))
            svg.plain_axes(axes)
        panels[0].set_ylabel("MTF")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3)
        return svg.to_svg(figure)


def edges_svg(run: SimulatedFocus) -> str:
    """Recorded edges of the first and the last band."""
    with svg.look("edges"):
        bench, state = run.bench, run.states[-1]
        bands = list(bench.ccds)[:: max(len(bench.ccds) - 1, 1)]
        figure = svg.new_figure(2.9)
        panels = figure.subplots(1, 2 * len(bands), squeeze=False)[0]
        for k, band in enumerate(bands):
            number = _middle(run, band)
            for axes, edge in zip(panels[2 * k : 2 * k + 2], DIRECTIONS, strict=True):
                axes.imshow(state.focus[number].frames[edge][0], cmap="gray", interpolation="none")
                axes.set_title(f"{band}, measures\n{DIRECTION_NAMES[edge]}")
                axes.set(xlabel="pixel along the line", ylabel="line" if edge == ALONG and k == 0 else "")
        return svg.to_svg(figure)
