"""Figures of the distortion test: the curve with its error, what compensation does point by point, one spot."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from analysis.centroid import mean_frames
from twin.laboratory import printed_004
from twin.laboratory.distortion import DistortionRun
from twin.report.svg import BLUE, GREY, INK, LIGHT, ORANGE, VERMILION, look, new_figure, plain_axes, to_svg

RAW, COMPENSATED = "angles as read", "compensated angles"


def curve_svg(run: DistortionRun) -> str:
    """Distortion over the field, and its error against the truth."""
    with look("distortion-curve"):
        figure = new_figure(6.4)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.25, 1.0))
        field = np.degrees(run.compensated.fit.angle)
        above.plot(field, 1e6 * run.true_distortion, color=INK, lw=1.0, label="exact chief rays")
        for measured, name, colour, marker, shift in (
            (run.raw, RAW, ORANGE, "s", -0.005),
            (run.compensated, COMPENSATED, BLUE, "o", 0.005),
        ):
            style = {"fmt": marker, "color": colour, "ms": 3.5, "lw": 0.8, "label": name}
            above.errorbar(field + shift, 1e6 * measured.distortion, 1e6 * measured.sigma, **style)
            below.errorbar(field + shift, 1e6 * run.error(measured), 1e6 * measured.sigma, **style)
        accuracy = printed_004.DISTORTION_ACCURACY_UM
        below.axhspan(-accuracy, accuracy, color="#eef3f8", lw=0, label=f"±{accuracy} µm (paper 004)")
        below.axhline(0.0, color=GREY, lw=0.8)
        above.set_title("Distortion D = L − c − f tan W + p tan² W", loc="left")
        below.set_title("Measured − true", loc="left")
        below.set_xlabel("field angle W, deg")
        for axes in (above, below):
            axes.set_ylabel("µm")
            _dress(axes)
        return to_svg(figure)


def points_svg(run: DistortionRun) -> str:
    """Each point's error and its departure from a smooth curve, raw and compensated, and Table 2 of the paper."""
    with look("distortion-points"):
        figure = new_figure(6.6)
        both = run.raw, run.compensated
        panels = {
            "Here: error of the distortion against the truth": [1e6 * np.abs(run.error(one)) for one in both],
            "Here: distance from the smooth curve": [1e6 * np.abs(one.smooth.residual) for one in both],
            "Paper 004, Table 2: “RMS of distortion”": [
                np.array(printed_004.DISTORTION_RAW_UM),
                np.array(printed_004.DISTORTION_COMPENSATED_UM),
            ],
        }
        every = figure.subplots(len(panels), 1)
        for axes, (title, (raw, compensated)) in zip(every, panels.items(), strict=True):
            number = np.arange(1, len(raw) + 1)
            axes.bar(number - 0.2, raw, 0.4, color=ORANGE, label=f"{RAW}, rms {_rms(raw):.2f} µm")
            axes.bar(number + 0.2, compensated, 0.4, color=BLUE, label=f"{COMPENSATED}, rms {_rms(compensated):.2f} µm")
            axes.set_title(title, loc="left")
            axes.set_ylabel("µm")
            axes.set_xlim(0.0, len(raw) + 1.0)
            _dress(axes)
        every[-1].set_xlabel("point")
        return to_svg(figure)


def spot_svg(run: DistortionRun) -> str:
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


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _dress(axes: Axes, columns: int = 3) -> None:
    low, high = axes.get_ylim()
    # room for the legend above the data
    axes.set_ylim(low, high + 0.18 * (high - low))
    axes.grid(axis="y", color=LIGHT, lw=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc="upper right" if columns == 1 else "upper center", ncols=columns)
    plain_axes(axes)
