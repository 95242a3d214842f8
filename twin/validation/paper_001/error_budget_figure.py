"""Printed and simulated lines of an error budget in one picture."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.ticker import FuncFormatter

from twin.report.svg import BLUE, INK, look, new_figure, plain_axes, to_svg


def budget_svg(lines: Mapping[str, tuple[float, float, float]]) -> str:
    """A row per line: text -> (printed, simulated, sigma), arcsec."""
    with look("error-budget"):
        figure = new_figure(1.0 + 0.32 * len(lines))
        axes = figure.subplots()
        for row, (printed, simulated, sigma) in enumerate(lines.values()):
            axes.plot([printed], [row], "|", color=INK, ms=16.0, mew=2.0, label="printed" if row == 0 else None)
            low = max(simulated - 3.0 * sigma, 0.5 * simulated)
            axes.plot([low, simulated + 3.0 * sigma], [row, row], color=BLUE, lw=2.0)
            axes.plot([simulated], [row], "o", color=BLUE, ms=6.0, label="simulated" if row == 0 else None)
        axes.set_xscale("log")
        axes.set_xlim(1e-3, 0.3)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_yticks(range(len(lines)), list(lines))
        axes.set_ylim(len(lines) - 0.5, -0.6)
        axes.set_xlabel("error of one spot, 3σ [arcsec]")
        axes.tick_params(axis="y", length=0)
        figure.legend(loc="outside upper right", ncols=2, frameon=False)
        plain_axes(axes)
        return to_svg(figure)
