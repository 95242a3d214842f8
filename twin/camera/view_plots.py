"""Wavefront maps, spot diagrams and MTF curves, each into axes of its own."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.patches import Circle

from twin.camera.camera_optics import Mtf, Spot, Wavefront
from twin.run.svg import BLUE, DIVERGING, GREY, INK, LIGHT, VERMILION, plain_axes

LINE, TRACK = BLUE, VERMILION
"""Colours of the direction along the line, and along the track."""

WAVES = DIVERGING
"""Colour map of wavefront errors, white where there is none."""


def field_text(field: tuple[float, float]) -> str:
    """A field for a title."""
    along, across = field
    return f"({along:+.2g}, {across:+.2g})".replace("+0)", "0)").replace("(+0,", "(0,").replace("-", "\N{MINUS SIGN}")


def draw_wavefront(axes: Axes, wavefront: Wavefront, most: float | None = None) -> QuadMesh:
    """A map over the stop; ``most``: waves at both ends of the colours, default the map's own largest."""
    values = wavefront.map
    end = float(np.nanmax(np.abs(values))) if most is None else most
    mesh = axes.pcolormesh(
        wavefront.x, wavefront.y, values, cmap=WAVES, vmin=-end, vmax=end, shading="nearest", rasterized=True
    )
    axes.add_patch(Circle((0.0, 0.0), 1.0, fill=False, lw=0.7, color=GREY))
    axes.set_aspect("equal")
    axes.set_xlim(-1.06, 1.06)
    axes.set_ylim(-1.06, 1.06)
    return mesh


def draw_spot(axes: Axes, spot: Spot, half: float | None = None) -> None:
    """Rays about their centroid in a box, um, with the Airy disk; ``half``: of the box's width, metres."""
    rays = 1e6 * (spot.rays - spot.centroid)
    reach = 1e6 * (max(1.15 * spot.airy, 1.1 * spot.farthest) if half is None else half)
    axes.plot(rays[:, 0], rays[:, 1], ".", ms=2.2, color=BLUE, mew=0.0)
    axes.add_patch(Circle((0.0, 0.0), 1e6 * spot.airy, fill=False, lw=0.8, color=INK))
    axes.axhline(0.0, lw=0.4, color=LIGHT, zorder=0)
    axes.axvline(0.0, lw=0.4, color=LIGHT, zorder=0)
    axes.set_aspect("equal")
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)


def draw_mtf(axes: Axes, mtf: Mtf, label: bool = True) -> None:
    """Both directions over cycles/mm, with the limit of diffraction and Nyquist's frequency."""
    frequency = 1e-3 * mtf.frequency
    for values, limit, colour, name in zip(
        mtf.values, mtf.limit, (LINE, TRACK), ("along the line", "along the track"), strict=True
    ):
        axes.plot(frequency, values, color=colour, lw=1.4, label=name if label else None)
        axes.plot(frequency, limit, color=INK, lw=0.7, ls=(0, (4, 3)), zorder=4)
    if label:
        axes.plot([], [], color=INK, lw=0.7, ls=(0, (4, 3)), label="diffraction limit")
    axes.axvline(1e-3 * mtf.nyquist, color=GREY, lw=0.8, ls=":")
    axes.annotate(
        "Nyquist", (1e-3 * mtf.nyquist, 0.98), (3, 0), textcoords="offset points", va="top", color=GREY, fontsize=7.5
    )
    axes.set_xlim(0.0, float(frequency[-1]))
    axes.set_ylim(0.0, 1.0)
    axes.set_xlabel("cycles/mm")
    plain_axes(axes)
