"""Paper 000's Figs. 3 to 5 drawn again, and the places where what it says of them holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from twin.report.svg import BLUE, GREEN, GREY, INK, LIGHT, VERMILION, look, new_figure, plain_axes, to_svg

_STYLES = {"x": (BLUE, "o"), "y": (GREEN, "s"), "z": (VERMILION, "^")}
_GREEK = {"alpha": "α", "beta": "β"}


def sensitivity_svg(
    amount: NDArray[np.float64],
    change: Mapping[tuple[str, str, str], NDArray[np.float64]],
    panels: Sequence[tuple[str, str]],
) -> str:
    """A panel for each (what is moved, angle): a curve for each axis, arcsec over metres."""
    with look(f"sensitivity-000-{panels[0][0]}-{panels[1][0]}"):
        figure = new_figure(3.3)
        for axes, (what, angle) in zip(figure.subplots(1, 2, sharey=True), panels, strict=True):
            axes.axhline(0.0, color=GREY, lw=0.8)
            ends = {}
            for axis, (colour, mark) in _STYLES.items():
                curve = change[what, angle, axis]
                ends[axis] = float(curve[-1])
                axes.plot(amount, curve, color=colour, marker=mark, ms=3.5, lw=1.4)
            low, high = min(0.0, *ends.values()), max(0.0, *ends.values())
            for axis, place in _apart(ends, 0.07 * (high - low)).items():
                axes.annotate(
                    axis, (amount[-1], place), (6, 0), textcoords="offset points", va="center", color=_STYLES[axis][0]
                )
            moved = "station" if what == "station" else f"{what} points"
            axes.set(title=f"{_GREEK[angle]} over the error of the {moved}", xlabel="error, m")
            axes.margins(x=0.06)
            axes.grid(color=LIGHT, lw=0.5)
            plain_axes(axes)
        figure.axes[0].set_ylabel("change of the angle, arcsec")
        return to_svg(figure)


def _apart(ends: Mapping[str, float], least: float) -> dict[str, float]:
    """Places of labels that do not overlap."""
    out: dict[str, float] = {}
    last = -np.inf
    for axis, value in sorted(ends.items(), key=lambda item: item[1]):
        last = max(value, last + least)
        out[axis] = last
    return out


def places_svg(held: Mapping[tuple[float, float], int], total: int, marked: Mapping[str, tuple[float, float]]) -> str:
    """How many sentences hold by (latitude, longitude), degrees."""
    with look("places-000"):
        figure = new_figure(3.6)
        axes = figure.subplots()
        lat, lon = (np.unique([place[k] for place in held]) for k in (0, 1))
        grid = np.array([[held[a, b] for b in lon] for a in lat])
        mesh = axes.pcolormesh(
            lon, lat, grid, cmap="cividis", vmin=grid.min() - 0.5, vmax=total + 0.5, shading="nearest"
        )
        for a in lat:
            for b in lon:
                shade = (held[a, b] - grid.min()) / (total - grid.min())
                axes.text(
                    b, a, str(held[a, b]), ha="center", va="center", fontsize=8, color="white" if shade < 0.55 else INK
                )
        for place in marked.values():
            axes.plot(place[1], place[0], "o", ms=19, mfc="none", mec=VERMILION, mew=1.8)
        axes.set(xlabel="longitude, ° E", ylabel="latitude, ° N")
        figure.colorbar(mesh, ax=axes, label=f"sentences that hold, of {total}")
        plain_axes(axes)
        return to_svg(figure)
