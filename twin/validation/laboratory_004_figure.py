"""Figures of the checks of paper 004."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.laboratory import printed_004
from twin.report.svg import BLUE, GREY, INK, look, new_figure, plain_axes, to_svg


def reduction_svg(errors: NDArray[np.float64], paper: tuple[float, float]) -> str:
    """RMS with compensated over RMS with raw angles, micrometres.

    Args:
        errors: of each test (T, 2), raw and compensated.
        paper: the same of the paper's Table 2.
    """
    with look("reduction-004"):
        figure = new_figure(4.2)
        axes = figure.subplots()
        top = 1.08 * max(float(np.max(errors)), *paper)
        ends = np.array([0.0, top])
        share = 1.0 - printed_004.REDUCTION
        axes.plot(ends, ends, color=GREY, lw=0.8)
        axes.plot(ends, share * ends, color=GREY, lw=0.8, ls="--")
        for slope, text in ((1.0, "no change"), (share, f"{100 * printed_004.REDUCTION:.0f} % lower, as printed")):
            axes.annotate(text, (top, slope * top), (4, 0), textcoords="offset points", va="center", color=GREY)
        axes.plot(*errors.T, "o", color=BLUE, ms=6.0, mec="white", mew=0.6, label="simulated test, error")
        axes.plot([paper[0]], [paper[1]], "s", color=INK, ms=7.0, label="paper 004, Table 2")
        axes.set_xlim(0.0, top)
        axes.set_ylim(0.0, top)
        axes.set_xlabel("RMS, angles as read [µm]")
        axes.set_ylabel("RMS, compensated angles [µm]")
        axes.legend(loc="upper left")
        plain_axes(axes)
        return to_svg(figure)
