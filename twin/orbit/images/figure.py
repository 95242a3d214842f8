"""Figures of a simulated pass: the images side by side, the control, the transfer functions."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from twin.orbit.ground.orthophoto import Raster
from twin.orbit.images.flight import Simulation
from twin.orbit.images.patch import LineImage
from twin.orbit.images.pixel_axes import pixel_axes
from twin.report.svg import (
    BLUE,
    GREEN,
    INK,
    LIGHT,
    ORANGE,
    SKY,
    VERMILION,
    look,
    new_figure,
    plain_axes,
    to_png,
    to_svg,
)

_DPI = 110
_PARTS = {"lens": BLUE, "pixel": GREEN, "diffusion": ORANGE, "step": SKY, "stages": VERMILION}


def images_png(run: Simulation) -> bytes:
    """The lines' images side by side, each stretched between its 0.5% and 99.5% grey values."""
    with look("simulate-images"):
        images = run.patch.images
        columns = min(len(images), 3)
        rows = -(-len(images) // columns)
        figure = new_figure(0.35 + 3.5 * rows)
        panels = np.atleast_1d(figure.subplots(rows, columns)).ravel()
        for axes, (name, image) in zip(panels, images.items(), strict=False):
            _show_image(axes, name, image)
        for axes in panels[len(images) :]:
            axes.set_visible(False)
        return to_png(figure, _DPI)


def control_png(run: Simulation) -> bytes:
    """Orthophoto and elevation model."""
    with look("simulate-control"):
        figure = new_figure(4.6)
        photo, heights = figure.subplots(1, 2)
        control = run.patch.control
        _show_raster(photo, control.orthophoto, "gray")
        shown = _show_raster(heights, control.dem, "gist_earth")
        photo.set(title="Orthophoto", ylabel="north, km")
        heights.set(title="Elevation model, m above the ellipsoid")
        figure.colorbar(shown, ax=heights, fraction=0.045, pad=0.02)
        return to_png(figure, _DPI)


def transfer_svg(run: Simulation) -> str:
    """MTF along the line and along the track, all lines and the parts of the first that looks obliquely."""
    with look("simulate-transfer"):
        return to_svg(_transfer_figure(run))


def _modulus(values: np.ndarray) -> np.ndarray:
    """Of complex values; real ones keep their sign."""
    return np.abs(values) if np.iscomplexobj(values) else values


def _transfer_figure(run: Simulation) -> Figure:
    figure = new_figure(3.4)
    panels = figure.subplots(1, 2, sharey=True)
    frequency = np.linspace(0.0, 0.5, 101)
    name, image = min(run.patch.images.items(), key=lambda item: item[1].motion.advance)
    optics = run.lines[name].optics
    zero = np.zeros_like(frequency)
    for axes, direction, place in zip(panels, ("line", "track"), ((frequency, zero), (zero, frequency)), strict=True):
        for part, values in optics.factors(*place, image.motion).items():
            if np.ptp(values) > 1e-6:
                axes.plot(frequency, _modulus(values), color=_PARTS[part], lw=1.0, label=_NAMES[part])
        axes.plot(frequency, _modulus(optics.transfer(*place, image.motion)), color=INK, lw=1.8, label="all")
        step = "pixel" if direction == "line" else "line"
        axes.set(title=f"Along the {direction}, {name}", xlabel=f"cycles per {step}", ylim=(0.0, 1.03), xlim=(0.0, 0.5))
        axes.legend(loc="lower left")
        axes.grid(color=LIGHT, lw=0.5)
        plain_axes(axes)
    panels[0].set_ylabel("modulation transfer")
    return figure


_NAMES = {
    "lens": "lens",
    "pixel": "pixel",
    "diffusion": "charge diffusion",
    "step": "motion during a line",
    "stages": "drift over the stages",
}


def _show_image(axes: Axes, name: str, image: LineImage) -> None:
    low, high = np.percentile(image.frame, (0.5, 99.5))
    window = image.window
    first, left = window.first_line - 0.5, window.first_pixel - 0.5
    ends = (left, left + window.pixels, first + window.lines, first)
    axes.imshow(image.frame, cmap="gray", vmin=low, vmax=high, extent=ends, interpolation="antialiased")
    axes.set(title=name)
    pixel_axes(axes)


def _show_raster(axes: Axes, raster: Raster, colours: str) -> AxesImage:
    low, high = np.percentile(raster.values, (0.5, 99.5))
    rows, columns = raster.values.shape
    half = 0.5 * raster.spacing
    ends = (
        raster.west - half,
        raster.west + columns * raster.spacing - half,
        raster.north - rows * raster.spacing + half,
        raster.north + half,
    )
    extent = 1e-3 * ends[0], 1e-3 * ends[1], 1e-3 * ends[2], 1e-3 * ends[3]
    shown = axes.imshow(raster.values, cmap=colours, vmin=low, vmax=high, extent=extent, interpolation="antialiased")
    axes.set(xlabel="east, km")
    return shown
