"""Figures of targets, their MTF, pupils with their shadows, and surfaces deformed by tables of nodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial import cKDTree

from optics.targets.target_shapes import TARGETS
from optics.thermal.nodal_deformation import NodalDeformation
from twin.framework import svg
from twin.monitor.image_quality import POSITIONS, ImageQuality, PupilOutline
from twin.targets.target_images import DIRECTION_NAMES, DIRECTIONS
from twin.targets.target_measurement import NYQUIST, BarReading, CameraTargets, EdgeReading

COLOURS = {"before": svg.BLUE, "after": svg.VERMILION}
MARKS = {"before": "o", "after": "D"}
BAND = 2.0
"""Half-width of the uncertainty band about zero in the panels of MTF differences, in sigmas."""
_LEAST_SPAN = 4.0
"""Smallest half-height of the panels of MTF differences, in units of 0.001."""
STRIDE = 2
"""Number of spatial frequencies from one marker of the measured MTF to the next."""
_IMAGE_NAMES = {
    "knife_edge_along": "knife edge, along line,\nmiddle 40 px",
    "knife_edge_track": "knife edge, along track,\nmiddle 40 px",
    "bars_along": "bars, along line",
    "bars_track": "bars, along track",
    "star": "star",
    "pinhole": "pinhole, asinh stretch,\nmiddle 24 px",
}
"""Titles of the images, with the direction of their MTF.

Other targets have their own names; uniform fields are not shown.
"""
_CROPS = {"knife_edge_along": 40, "knife_edge_track": 40, "pinhole": 24}
"""Target -> side of the part of its image that is shown, in pixels; images without an entry are shown whole."""
PEAK_TO_LINEAR = 100.0
"""Ratio of the peak to the level up to which the stretch of a pinhole's image is linear."""


def curves_svg(name: str, camera: CameraTargets) -> str:
    """Draw measured and true MTF, a row for each direction and a column for each position in the field."""
    with svg.look(f"mtf-{name}"):
        figure = svg.new_figure(8.4)
        heights = (3.0, 1.2) * len(DIRECTIONS)
        panels = figure.subplots(
            len(heights), len(camera.positions), sharex=True, sharey="row", squeeze=False, height_ratios=heights
        )
        for column, (position, targets) in enumerate(camera.positions.items()):
            for row, direction in enumerate(DIRECTIONS):
                axes, below = panels[2 * row : 2 * row + 2, column]
                nyquist = 1e-3 * NYQUIST / camera.pitch
                for panel in (axes, below):
                    svg.plain_axes(panel)
                    panel.grid(color=svg.LIGHT, lw=0.5)
                    panel.set_axisbelow(True)
                    panel.axvline(nyquist, color=svg.GREY, lw=0.9, ls=(0, (1, 2)), zorder=0)
                below.axhline(0.0, color=svg.GREY, lw=0.8)
                for when, shots in targets.shots.items():
                    _curve(axes, when, shots.edges[direction])
                    _difference(below, when, shots.edges[direction])
                    if direction in shots.bars:
                        _bars(axes, when, shots.bars[direction], camera.pitch)
                axes.set(xlim=(0.0, 2.0 * nyquist), ylim=(0.0, 1.03))
                axes.set_title(f"{position}, {DIRECTION_NAMES[direction]}", loc="left")
                if column == 0:
                    axes.set_ylabel("MTF with the pixel")
                    below.set_ylabel("error [10$^{-3}$]")
                if row == len(DIRECTIONS) - 1:
                    below.set_xlabel("frequency [cycles/mm]")
        for below in panels[1::2, 0]:
            # symmetric about zero, and not scaled to noise alone
            span = max(_LEAST_SPAN, *(abs(limit) for limit in below.get_ylim()))
            below.set_ylim(-span, span)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.align_ylabels()
        unique = dict(zip(labels, handles, strict=True))
        figure.legend(unique.values(), unique.keys(), loc="outside upper center", ncols=len(unique))
        return svg.to_svg(figure)


def _curve(axes: Axes, when: str, edge: EdgeReading) -> None:
    colour, frequency = COLOURS[when], 1e-3 * edge.frequency
    axes.plot(frequency, edge.true, color=colour, lw=1.3, label=f"true, {when}")
    measured = edge.measured
    if measured is None:
        return
    axes.plot(
        frequency[::STRIDE], measured.mtf[::STRIDE], MARKS[when], color=colour, ms=3.2, mec="white", mew=0.4,
        label=f"measured, {when}",
    )  # fmt: skip


def _difference(axes: Axes, when: str, edge: EdgeReading) -> None:
    """Draw measured minus true MTF over spatial frequency, in units of 0.001."""
    measured = edge.measured
    if measured is None:
        return
    frequency, error, sigma = 1e-3 * edge.frequency, 1e3 * (measured.mtf - edge.true), 1e3 * measured.sigma
    axes.fill_between(frequency, -BAND * sigma, BAND * sigma, color=COLOURS[when], alpha=0.18, lw=0.0)
    axes.plot(frequency, error, color=COLOURS[when], lw=1.1)


def _bars(axes: Axes, when: str, bars: BarReading, pitch: float) -> None:
    if bars.measured is not None:
        # bars of both states have the same frequency
        axes.plot(
            1e-3 * NYQUIST / pitch, bars.measured.mtf, "s", color="none", mec=COLOURS[when], mew=1.3, ms=6.5,
            label=f"bars, {when}",
        )  # fmt: skip


def _norm(target: str, image: np.ndarray) -> Normalize:
    low, high = float(image.min()), max(float(image.max()), float(image.min()) + 1.0)
    if target == "pinhole":
        return AsinhNorm(linear_width=(high - low) / PEAK_TO_LINEAR, vmin=low, vmax=high)
    return Normalize(low, high)


def images_svg(name: str, camera: CameraTargets) -> str:
    """Draw mean images: a row for each target, columns for the positions in the field, each before and after."""
    columns = [(position, when) for position in camera.positions for when in COLOURS]
    names = [name for name in next(iter(camera.positions.values())).before.frames if name in {*_IMAGE_NAMES, *TARGETS}]
    with svg.look(f"targets-{name}"):
        figure = svg.new_figure(
            0.45 + 1.68 * len(names), {"w_pad": 0.02, "h_pad": 0.02, "wspace": 0.01, "hspace": 0.01}
        )
        grid = figure.subplots(len(names), len(columns), squeeze=False)
        for column, (position, when) in enumerate(columns):
            shots = camera.positions[position].shots[when]
            for row, target in enumerate(names):
                axes = grid[row, column]
                mean = np.asarray(shots.frames[target].mean(axis=0))
                skip = (len(mean) - _CROPS.get(target, len(mean))) // 2
                shown = mean[skip : len(mean) - skip, skip : len(mean) - skip]
                axes.imshow(shown, cmap="gray", interpolation="none", norm=_norm(target, shown))
                axes.set_xticks([])
                axes.set_yticks([])
                if row == 0:
                    axes.set_title(f"{position}, {when}")
                if column == 0:
                    axes.set_ylabel(_IMAGE_NAMES.get(target, target.replace("_", " ")))
        return svg.to_svg(figure)


_RIM = np.exp(2j * np.pi * np.arange(181) / 180)


def pupils_svg(quality: ImageQuality) -> str:
    """Draw pupils with the shadows in them: a row per camera, a column per field position.

    Shadows of the nominal state are filled, those of the perturbed state outlined.
    """
    where = {position: quality.fields.index(field) for position, field in POSITIONS.items()}
    with svg.look("pupils"):
        figure = svg.new_figure(0.6 + 2.9 * len(quality.cameras))
        panels = figure.subplots(len(quality.cameras), len(where), squeeze=False, sharex=True, sharey=True)
        for row, (name, camera) in zip(panels, quality.cameras.items(), strict=True):
            for axes, (position, k) in zip(row, where.items(), strict=True):
                lost = camera.light_lost[0, k], camera.light_lost[-1, k]
                text = " \N{RIGHTWARDS ARROW} ".join("?" if np.isnan(v) else f"{100.0 * v:.2f} %" for v in lost)
                axes.set_title(f"{name}, {position}: {text}")
                states = [pupils[k] for pupils in (camera.pupils[0], camera.pupils[-1]) if len(pupils) > k]
                _draw(axes, states)
            row[0].set_ylabel("along the track, X\N{PRIME}")
        for axes in panels[-1]:
            axes.set_xlabel("along the line, Y\N{PRIME}")
        return svg.to_svg(figure)


def _draw(axes: Axes, states: list[PupilOutline]) -> None:
    axes.set_aspect("equal")
    svg.plain_axes(axes)
    for k, pupil in enumerate(states):
        rim = np.stack([_RIM.real, _RIM.imag], axis=-1) @ pupil.axes.T
        if k == 0:
            axes.add_patch(Polygon(rim, fc=svg.SKY, alpha=0.25, lw=0))
            axes.plot(*rim.T, color=svg.INK, lw=0.9)
        for piece in pupil.pieces:
            nominal = Polygon(piece, fc=svg.INK, alpha=0.75, lw=0)
            axes.add_patch(nominal if k == 0 else Polygon(piece, fill=False, ec=svg.ORANGE, lw=1.1))
    axes.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15))


_PIXELS = 220
"""Number of pixels of a map of a deformed surface along its longer side."""


def deformation_svg(faces: Mapping[str, NodalDeformation]) -> str:
    """Draw maps of the change of sag at the nodes of a table, three for each body.

    They show the change itself, what remains after the Zernike terms are subtracted, and what remains after the
    interpolating grid is subtracted as well.
    """
    with svg.look("deformation"):
        figure = svg.new_figure(3.3 * len(faces))
        rows = figure.subplots(len(faces), 3, squeeze=False)
        for axes, (path, face) in zip(rows, faces.items(), strict=True):
            _deformation(figure, axes, path, face)
        return svg.to_svg(figure)


def _deformation(figure: Figure, axes: Any, path: str, face: NodalDeformation) -> None:
    """Draw the maps of one body's deformation; each node of its table colours its cell of the aperture."""
    inside = face.weight > 0.0
    points = face.points[inside]
    low, high = points.min(axis=0), points.max(axis=0)
    step = float(np.max(high - low)) / _PIXELS
    x, y = (np.arange(a, b + step, step) for a, b in zip(low, high, strict=True))
    distance, nearest = cKDTree(points).query(np.stack(np.meshgrid(x, y), axis=-1))
    ends = tuple(1e3 * float(v) for v in (low[0], high[0], low[1], high[1]))
    for panel, title, values in (
        (axes[0], f"{path}: change of sag", face.change),
        (axes[1], f"after Z{max(face.figure)}", face.residual),
        (axes[2], "after the grid", face.lost),
    ):
        shown = np.where(distance <= 2.0 * face.spacing, 1e9 * values[inside][nearest], np.nan)
        most = max(float(np.nanmax(np.abs(shown))), 1e-6)
        picture = svg.signed_map(panel, shown, most, extent=ends, origin="lower", interpolation="nearest")
        panel.set_title(
            f"{title}\n{1e9 * face.rms(values):.3g} nm rms, {1e9 * face.range(values):.3g} nm PV", fontsize=8.5
        )
        panel.set_xlabel("x, mm")
        panel.tick_params(labelsize=7)
        bar = figure.colorbar(picture, ax=panel, shrink=0.8, pad=0.02)
        bar.ax.tick_params(labelsize=7)
    axes[0].set_ylabel("y, mm")
