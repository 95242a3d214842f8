"""The pupils of the cameras with the shadows of what stands in their beams."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from twin.image_quality import PLACES, ImageQuality, PupilOutline
from twin.report.svg import INK, ORANGE, SKY, look, new_figure, plain_axes, to_svg

_RIM = np.exp(2j * np.pi * np.arange(181) / 180)


def pupils_svg(quality: ImageQuality) -> str:
    """A row for each camera, a column for each place on its line: nominal shadows filled, perturbed ones outlined."""
    where = {place: quality.fields.index(field) for place, field in PLACES.items()}
    with look("pupils"):
        figure = new_figure(0.6 + 2.9 * len(quality.cameras))
        panels = figure.subplots(len(quality.cameras), len(where), squeeze=False, sharex=True, sharey=True)
        for row, (name, camera) in zip(panels, quality.cameras.items(), strict=True):
            for axes, (place, k) in zip(row, where.items(), strict=True):
                lost = camera.light_lost[0, k], camera.light_lost[-1, k]
                text = " \N{RIGHTWARDS ARROW} ".join("?" if np.isnan(v) else f"{100.0 * v:.2f} %" for v in lost)
                axes.set_title(f"{name}, {place}: {text}")
                states = [pupils[k] for pupils in (camera.pupils[0], camera.pupils[-1]) if len(pupils) > k]
                _draw(axes, states)
            row[0].set_ylabel("along the track, X\N{PRIME}")
        for axes in panels[-1]:
            axes.set_xlabel("along the line, Y\N{PRIME}")
        return to_svg(figure)


def _draw(axes: Axes, states: list[PupilOutline]) -> None:
    axes.set_aspect("equal")
    plain_axes(axes)
    for k, pupil in enumerate(states):
        rim = np.stack([_RIM.real, _RIM.imag], axis=-1) @ pupil.axes.T
        if k == 0:
            axes.add_patch(Polygon(rim, fc=SKY, alpha=0.25, lw=0))
            axes.plot(*rim.T, color=INK, lw=0.9)
        for piece in pupil.pieces:
            nominal = Polygon(piece, fc=INK, alpha=0.75, lw=0)
            axes.add_patch(nominal if k == 0 else Polygon(piece, fill=False, ec=ORANGE, lw=1.1))
    axes.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15))
