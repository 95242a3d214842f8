"""What one unit of every motion does to the spots, in one heat map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm

from twin.main_job.render_results import RenderRun
from twin.monitor.crosstalk import CameraCrosstalk
from twin.run.artefact import SAME, shown_unit, significant
from twin.run.svg import DIVERGING, INK, look, new_figure, to_svg

ROW = 0.168
"""Height of a row, inches."""
DECADES = 3
"""Of the colours' logarithmic part, below the largest number."""
MOST_LEVEL = 4
"""Names of columns that have room beside one another."""
STRONG = 0.55
"""Depth of a colour from which the number in it is white."""


def motion_map_svg(run: RenderRun) -> str:
    """Micrometres on the area CCD per unit of motion: a row for each motion, a panel for each camera."""
    pitch = 1e6 * run.experiment.path.pitch
    tables = list(run.crosstalk.items())
    largest = max(float(np.abs(table.spot_shift).max()) for _, table in tables) * pitch
    norm = SymLogNorm(largest * 10.0**-DECADES, linscale=0.4, vmin=-largest, vmax=largest)
    rows = max(len(table.motions) for _, table in tables)
    labels = [_labels(table) for _, table in tables]
    with look("motions"):
        figure = new_figure(1.1 + ROW * rows, {"w_pad": 0.03, "h_pad": 0.03, "wspace": 0.01})
        panels = figure.subplots(1, len(tables), squeeze=False)[0]
        for k, (axes, (name, table)) in enumerate(zip(panels, tables, strict=True)):
            _panel(axes, pitch * table.spot_shift.T, table.coordinates, norm)
            axes.set_yticks(range(len(table.motions)), labels[k])
            # told once where all cameras have the same motions
            axes.tick_params(labelleft=k == 0 or labels[k] != labels[0])
            axes.set_title(f"Camera {name}", fontweight="bold", pad=4)
        return to_svg(figure)


def _labels(table: CameraCrosstalk) -> list[str]:
    return [f"{motion.label}, 1 {shown_unit(motion.unit)}" for motion in table.motions]


def _panel(axes: Axes, values: np.ndarray, names: Sequence[str], norm: SymLogNorm) -> None:
    axes.imshow(values, cmap=DIVERGING, norm=norm, aspect="auto", interpolation="nearest")
    axes.xaxis.set_ticks_position("top")
    # many are told below one another
    turn = 90.0 if len(names) > MOST_LEVEL else 0.0
    axes.set_xticks(range(values.shape[1]), [f"{name} [µm]" for name in names], rotation=turn)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    for (row, column), value in np.ndenumerate(values):
        deep = abs(float(norm(value)) - 0.5) * 2.0
        colour = "white" if deep > STRONG else INK
        text = significant(float(value), 2, floor=SAME)
        axes.text(column, row, text, ha="center", va="center", fontsize=7, color=colour)
