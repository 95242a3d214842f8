"""Figure of what an on-board monitor buys: errors in height against the size of the drift, and by scheme."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from analysis.units import ARCSEC
from twin.orbit.calibration.monitor import Monitoring, PooledErrors
from twin.orbit.calibration.procedure import CalibrationRun
from twin.report.svg import BLUE, GREY, INK, LIGHT, VERMILION, look, new_figure, plain_axes, to_svg


def drift_drawn(run: CalibrationRun, found: Monitoring) -> str:
    """The figure as SVG."""
    with look("calibration-monitor-heights"):
        return to_svg(_figure(run, found))


def expected_height(run: CalibrationRun, found: Monitoring, factor: np.ndarray) -> np.ndarray:
    """Height RMS (n,) for drifts of these sizes without a monitor that many campaigns would have, metres.

    All fields adjusted at once, each with one drift; the outer lines' d_alpha and the mean of it taken out.
    """
    spec = run.campaign.spec
    square = sum(one.angles[0] ** 2 for name, one in spec.drift.items() if name != "nadir")
    metres = found.metres * np.sqrt(square * (1.0 - 1.0 / len(spec.fields))) / ARCSEC
    return np.asarray(np.hypot(found.at(0.0).without.together.height, factor * metres))


def _figure(run: CalibrationRun, found: Monitoring) -> Figure:
    figure = new_figure(4.3)
    left, right = figure.subplots(1, 2)
    angle = found.angle / ARCSEC or 1.0
    size = np.array([s.factor for s in found.sizes])
    fine = np.linspace(0.0, size[-1], 101)
    left.plot(fine * angle, expected_height(run, found, fine), "--", color=GREY, lw=1.0, label="mean of many campaigns")
    cases = {"without monitor": (VERMILION, "o"), "with monitor": (BLUE, "s")}
    told = [s.told for s in found.sizes if s.told is not None]
    for (label, (colour, marker)), rows in zip(cases.items(), ([s.without for s in found.sizes], told), strict=True):
        if rows:
            height = [row.together.height for row in rows]
            left.plot(size * angle, height, f"{marker}-", color=colour, lw=1.4, ms=5, label=label)
    unit = "σ of d_α of an outer line, arcsec" if found.angle else "size of the drift against the file's"
    left.set(title="All fields adjusted at once", xlabel=unit, ylabel="height RMS at check points, m")
    names = list(found.sizes[0].without.schemes)
    here = found.at(1.0)
    bars: list[tuple[str, str, list[PooledErrors]]] = [
        ("no drift", GREY, list(found.at(0.0).without.schemes.values())),
        ("without monitor", VERMILION, list(here.without.schemes.values())),
    ]
    if here.told is not None:
        bars.append(("with monitor", BLUE, list(here.told.schemes.values())))
    place, width = np.arange(len(names)), 0.8 / len(bars)
    for k, (label, colour, values) in enumerate(bars):
        at = place + (k - 0.5 * (len(bars) - 1)) * width
        right.bar(at, [v.height for v in values], 0.92 * width, color=colour, label=label)
    title = "Without ground control, the file's drift"
    right.set(title=title, xticks=place, xlabel="scheme", ylabel="height RMS at check points, m")
    right.set_xticklabels([*names[:-1], f"{names[-1]}\neach its own"])
    for axes in (left, right):
        axes.set_ylim(0.0, None)
        axes.grid(color=LIGHT, lw=0.5)
        axes.set_axisbelow(True)
        plain_axes(axes)
        axes.tick_params(colors=INK)
    handles, labels = left.get_legend_handles_labels()
    more, other = right.get_legend_handles_labels()
    figure.legend([*handles, more[0]], [*labels, other[0]], loc="outside lower center", ncols=4)
    return figure
