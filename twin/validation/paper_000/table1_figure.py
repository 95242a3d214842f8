"""Resection minus planes over many measurements, with the differences that paper 000 prints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.report.svg import BLUE, INK, LIGHT, ORANGE, VERMILION, look, new_figure, plain_axes, to_svg


def differences_svg(same: NDArray[np.float64], own: NDArray[np.float64], printed: tuple[float, float]) -> str:
    """Scatter of alpha and beta, both (passes, 2), arcsec, and the printed pair."""
    with look("table1-000"):
        figure = new_figure(4.2)
        axes = figure.subplots()
        axes.axhline(0.0, color=LIGHT, lw=0.8, zorder=0)
        axes.axvline(0.0, color=LIGHT, lw=0.8, zorder=0)
        axes.plot(
            *own.T, "o", color=ORANGE, ms=3.5, mew=0, alpha=0.7, label="points of their own, light left in planes"
        )
        axes.plot(*same.T, "s", color=BLUE, ms=3.0, mew=0, label="same points, light corrected in both")
        axes.plot(
            *printed, "D", color=VERMILION, ms=8, mec=INK, mew=0.8, label=f"printed: {printed[0]}″, {printed[1]}″"
        )
        axes.plot(*(-v for v in printed), "D", color="none", ms=8, mec=VERMILION, mew=1.4, label="printed, other sign")
        axes.set_aspect("equal")
        axes.set(xlabel="α: resection − planes, arcsec", ylabel="β: resection − planes, arcsec")
        axes.set(xlim=(-2.0, 2.0), ylim=(-2.0, 2.3))
        axes.legend(loc="center left", bbox_to_anchor=(1.02, 0.5))
        plain_axes(axes)
        return to_svg(figure)
