"""Figures of a judged camera can be read: no label lies on a curve or on the legend."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from scenes.models.camera_sharpness import BLURRED
from scenes.specs.load import load_camera
from twin.camera import camera_plots as plots
from twin.camera.camera_run import SHARP
from twin.run.svg import look


def over_field(level: float) -> SimpleNamespace:
    """What `error_figure` draws, of a camera with about this error."""
    shares = np.stack(np.meshgrid(np.linspace(-1.0, 1.0, 9), np.linspace(-1.0, 1.0, 5), indexing="ij"), axis=-1)
    errors = level * (1.0 + 0.03 * (shares**2).sum(axis=-1))
    return SimpleNamespace(camera=load_camera("gf7"), field=shares, errors=errors, worst=(errors.max(), (1.0, 1.0)))


@pytest.mark.parametrize("level", [0.5 * SHARP, 0.95 * SHARP, 1.02 * SHARP, 0.9 * BLURRED, 1.01 * BLURRED])
def test_limits_are_named_beside_curves_and_legend(level: float) -> None:
    with look("errors"):
        figure: Figure = plots.error_figure(over_field(level))  # type: ignore[arg-type]
        figure.canvas.draw()
    axes = figure.axes[1]
    names = [text for text in axes.texts if text.get_text().replace("\n", " ") in ("diffraction limited", "blurred")]
    assert names
    legend = axes.get_legend().get_window_extent()
    curves = [axes.transData.transform(line.get_xydata()) for line in axes.lines if len(line.get_xdata()) > 2]
    for text in names:
        box = text.get_window_extent()
        assert not box.overlaps(legend)
        assert not any(box.contains(*point) for curve in curves for point in curve)
        assert box.x1 <= figure.bbox.x1 + 1.0
    for one, other in pairwise(names):
        assert not one.get_window_extent().overlaps(other.get_window_extent())
