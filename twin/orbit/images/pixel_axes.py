"""Axes of a figure that count the pixels of a line camera's image."""

from __future__ import annotations

from matplotlib.axes import Axes


def pixel_axes(axes: Axes) -> None:
    """Name the axes of a shown image, and label them sparsely with whole numbers of pixels and lines.

    Limits must be set before.
    """
    axes.set(xlabel="pixel", ylabel="line")
    axes.ticklabel_format(useOffset=False)
    axes.locator_params(axis="x", nbins=4)
    axes.locator_params(axis="y", nbins=6)
    axes.tick_params(axis="y", labelrotation=90)
    for label in axes.get_yticklabels():
        label.set_verticalalignment("center")
