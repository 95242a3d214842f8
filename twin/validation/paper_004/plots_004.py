"""Figures of the checks of paper 004."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.run.svg import AFTER, BEFORE, BLUE, GREY, INK, LIGHT, VERMILION, look, new_figure, plain_axes, to_svg


def reduction_svg(errors: NDArray[np.float64], paper: tuple[float, float], reduction: float) -> str:
    """RMS with compensated over RMS with raw angles, micrometres.

    Args:
        errors: of each test (T, 2), raw and compensated.
        paper: the same of the paper's Table 2.
        reduction: that the paper claims.
    """
    with look("reduction-004"):
        figure = new_figure(4.2)
        axes = figure.subplots()
        top = 1.08 * max(float(np.max(errors)), *paper)
        ends = np.array([0.0, top])
        share = 1.0 - reduction
        axes.plot(ends, ends, color=GREY, lw=0.8)
        axes.plot(ends, share * ends, color=GREY, lw=0.8, ls="--")
        for slope, text in ((1.0, "no change"), (share, f"{100 * reduction:.0f} % lower, as printed")):
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


def points_svg(by_eq2: NDArray[np.float64], free: NDArray[np.float64]) -> str:
    """Principal points of T tests.

    Args:
        by_eq2: error of the zero in arcsec, p of (2) and p that the zero explains in mm, (T, 3).
        free: p with a constant term and its sigma, mm, (T, 2).
    """
    with look("principal-point-004"):
        figure = new_figure(3.6)
        left, right = figure.subplots(1, 2)
        zero, found, explained = by_eq2[np.argsort(by_eq2[:, 0])].T
        left.plot(zero, explained, color=GREY, lw=0.9, label="traced camera, zero wrong by so much")
        left.plot(zero, found, "o", color=BLUE, ms=5.0, mec="white", mew=0.5, label="p of (2), rendered spots")
        left.set_xlabel("error of the zero of W [arcsec]")
        left.set_ylabel("p [mm]")
        left.set_title("(2) as printed")
        left.legend(loc="best")
        number = np.arange(1, len(free) + 1)
        right.axhline(0.0, color=INK, lw=0.7)
        right.errorbar(number, free[:, 0], free[:, 1], fmt="o", color=VERMILION, ms=4.0, lw=0.9)
        right.set_xlabel("test")
        right.set_ylabel("p [mm]")
        right.set_title("with a constant term")
        for axes in (left, right):
            plain_axes(axes)
        return to_svg(figure)


def alignment_svg(far: NDArray[np.float64], turns: NDArray[np.float64], far_bound: float, turn_bound: float) -> str:
    """Alignments before and after.

    Args:
        far: largest distance from best focus of each state, mm, (A, S).
        turns: of the line, arcmin, (A, S).
        far_bound: what the paper reached, mm.
        turn_bound: what it reached, arcmin.
    """
    with look("alignments-004"):
        figure = new_figure(3.6)
        for axes, values, bound, label in zip(
            figure.subplots(1, 2),
            (far, turns),
            (far_bound, turn_bound),
            ("farthest CCD from best focus [mm]", "turn of the line [arcmin]"),
            strict=True,
        ):
            number = np.arange(1, len(values) + 1)
            axes.axhspan(1e-4, bound, color=LIGHT, alpha=0.6, lw=0)
            axes.vlines(number, values[:, -1], values[:, 0], color=LIGHT, lw=1.0)
            axes.plot(number, values[:, 0], "o", color=BEFORE, ms=6.0, mec=INK, mew=0.4, label="before")
            axes.plot(number, values[:, -1], "D", color=AFTER, ms=5.0, label="after one round")
            axes.set_yscale("log")
            axes.set_ylim(0.4 * float(np.min(values)), 2.5 * float(np.max(values)))
            axes.set_xlim(0.3, len(values) + 0.7)
            axes.set_xticks(number)
            axes.set_xlabel("alignment")
            axes.set_ylabel(label)
            plain_axes(axes)
        figure.axes[0].legend(loc="best")
        return to_svg(figure)
