"""The open combination of a calibration, and how slowly the stepwise solution comes to its end."""

from __future__ import annotations

import numpy as np

from analysis.units import ARCSEC
from twin.report.svg import BLUE, GREY, VERMILION, look, new_figure, plain_axes, to_svg
from twin.validation.paper_003.exact import Rank, Walk

_FOCAL = 0.65
"""Metres; angles are drawn as image motion."""


def open_svg(rank: Rank, walk: Walk) -> str:
    """Bars of the open combination, and sigmas over rounds."""
    with look("paper-003-open"):
        figure = new_figure(3.4)
        left, right = figure.subplots(1, 2)
        one = rank.open[0]
        names = [n if n.split()[-1] in "fxy" else n.split()[-1] for n in one.names]
        angle = [n.split()[-1] not in "fxy" for n in one.names]
        size = [float(c) * (_FOCAL if a else 1.0) * 1e3 for c, a in zip(one.change, angle, strict=True)]
        place = np.arange(len(names))
        left.barh(place, size, color=[VERMILION if a else BLUE for a in angle], height=0.6)
        labels = [f"{c / ARCSEC:+.0f}″" if a else f"{c * 1e3:+.2f} mm" for c, a in zip(one.change, angle, strict=True)]
        for k, label in enumerate(labels):
            left.text(0.5 * size[k], k, label, ha="center", va="center", color="white", fontsize=9.0)
        left.set_yticks(place, names)
        left.set_ylim(len(names) - 0.5, -0.5)
        left.axvline(0.0, color=GREY, lw=0.8)
        left.set_xlabel("image motion of each alone [mm]")
        left.set_title(f"Together: {rank.moved:.4f} px instead of {rank.alone:.0f} px, x of 0.1 mm")
        rounds, away = list(walk.after), list(walk.after.values())
        right.loglog(rounds, away, "o-", color=BLUE, ms=5)
        right.axhline(0.1, color=GREY, lw=0.9, ls="--")
        right.text(rounds[0], 0.105, "a tenth of a sigma", color=GREY, va="bottom")
        right.set_xticks((1, 10, 100, 1000), ("1", "10", "100", "1000"))
        right.set_yticks((0.01, 0.1, 1, 10), ("0.01", "0.1", "1", "10"))
        right.minorticks_off()
        right.set_xlabel("rounds of biases, then interior")
        right.set_ylabel("farthest unknown [sigmas]")
        right.set_title("Stepwise against simultaneous solution")
        for axes in (left, right):
            plain_axes(axes)
        return to_svg(figure)
