"""Figures of the distortion test: distortion over the field, and a spot enlarged."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.spots.centroid import mean_frames
from twin.laboratory.distortion_run import DistortionRun, SimulatedDistortion
from twin.run.svg import BLUE, GREY, INK, LIGHT, ORANGE, VERMILION, look, new_figure, plain_axes, to_svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RAW, COMPENSATED = "angles as read", "compensated angles"


def curve_svg(run: DistortionRun) -> str:
    """Distortion over the field, what is left of a smooth curve, and of a simulated bench the error."""
    with look("distortion-curve"):
        known = isinstance(run, SimulatedDistortion)
        figure = new_figure(8.0 if known else 6.0)
        panels = figure.subplots(2 + known, 1, sharex=True, height_ratios=(1.25, 1.0, 1.0)[: 2 + known])
        field = np.degrees(run.compensated.fit.angle)
        if isinstance(run, SimulatedDistortion):
            panels[0].plot(field, 1e6 * run.true_distortion, color=INK, lw=1.0, label="exact chief rays")
            panels[2].set_title("Measured − true, with the total sigma", loc="left")
        series = [(run.raw, RAW, ORANGE, "s", -0.005), (run.compensated, COMPENSATED, BLUE, "o", 0.005)]
        for one, name, colour, marker, shift in series if run.compensation is not None else series[:1]:
            style = {"fmt": marker, "color": colour, "ms": 3.5, "lw": 0.8, "label": name}
            panels[0].errorbar(field + shift, 1e6 * one.distortion, 1e6 * one.sigma, **style)
            panels[1].errorbar(field + shift, 1e6 * one.smooth.residual, 1e6 * one.means.sigma, **style)
            if isinstance(run, SimulatedDistortion):
                panels[2].errorbar(field + shift, 1e6 * run.error(one), 1e6 * one.sigma, **style)
        panels[0].set_title("Distortion D = L − c − f tan W + p tan² W, with its total sigma", loc="left")
        panels[1].set_title("Distance from the smooth curve, with the sigma of the sets", loc="left")
        panels[-1].set_xlabel("field angle W [deg]")
        for axes in panels:
            axes.set_ylabel("µm")
            _dress(axes)
        for axes in panels[1:]:
            axes.axhline(0.0, color=GREY, lw=0.8)
        return to_svg(figure)


def spot_svg(run: SimulatedDistortion) -> str:
    """The spot in the middle of the field, and the row through its centre."""
    with look("distortion-spot"):
        figure = new_figure(3.6)
        picture, profile = figure.subplots(1, 2, width_ratios=(1.0, 1.5))
        point = len(run.record.column) // 2
        image = mean_frames(run.record.frames[point, 0])
        pitch = run.bench.ccd.band.pitch
        column = run.spots.position[point, 0] + run.bench.design_offset[point]
        column = column / pitch + run.bench.middle_column - run.record.column[point, 0]
        row = run.spots.row[point, 0]
        shown = picture.imshow(image, cmap="gray", interpolation="nearest", origin="upper")
        picture.plot(column, row, "+", color=VERMILION, ms=12, mew=1.4)
        angle = np.linspace(0.0, 2.0 * np.pi, 181)
        radius = run.bench.radius
        picture.plot(column + radius * np.cos(angle), row + radius * np.sin(angle), color=BLUE, lw=0.9)
        picture.set(xlabel="column, along the line", ylabel="row, along the track")
        figure.colorbar(shown, ax=picture, label="DN")
        values = image[round(row)]
        profile.step(np.arange(len(values)), values, where="mid", color=BLUE, lw=1.0, label="row through the centre")
        profile.axvline(column, color=VERMILION, lw=0.9, label="energy centroid")
        profile.set(xlabel="column", ylabel="DN")
        _dress(profile, columns=1)
        return to_svg(figure)


def _dress(axes: Axes, columns: int = 3) -> None:
    """A light grid, a legend and room for it; columns: of the legend."""
    low, high = axes.get_ylim()
    # room for the legend above the data
    axes.set_ylim(low, high + 0.18 * (high - low))
    axes.grid(axis="y", color=LIGHT, lw=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc="upper right" if columns == 1 else "upper center", ncols=columns)
    plain_axes(axes)
