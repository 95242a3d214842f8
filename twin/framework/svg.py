"""Figures as inline SVG in one style, without pyplot and without global state."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import cache
from io import BytesIO, StringIO
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:  # modules that only need the colours do not import Matplotlib
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

# Palette of Okabe and Ito, which can be distinguished with any colour vision.
BLUE, ORANGE, GREEN, VERMILION, SKY, PURPLE, YELLOW = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#56B4E9",
    "#CC79A7",
    "#F0E442",
)
BROWN = "#7a4a12"
INK, GREY, LIGHT, SHADE = "#1b1f24", "#6b7280", "#d9dde3", "#eef3f8"
BEFORE, AFTER = SKY, VERMILION
"""Colours, in figures of spots, of the centroids measured before and after the change of the instrument."""
GRAY, DIVERGING = "gray", "RdBu_r"
"""Names of Matplotlib's colour maps for images, and for values with a sign (white at zero)."""

_STYLE: dict[str, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.5,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.7,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.frameon": False,
    "svg.fonttype": "path",
    "path.simplify": True,
}
WIDTH = 10.6
"""Width of the page's column at 100 dots per inch, in inches."""


def new_figure(height: float, pads: dict[str, Any] | None = None) -> Figure:
    """Return an empty figure as wide as a page's column, with a layout without overlap.

    Parameters
    ----------
    height : float
        Height of the figure, in inches.
    pads : dict | None
        Arguments of ``ConstrainedLayoutEngine``; None for the usual space between panels.
    """
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    return _arranged()(figsize=(WIDTH, height), layout=ConstrainedLayoutEngine(**(pads or {"h_pad": 0.08})))


@cache
def _arranged() -> type[Figure]:
    """Return the class of figures that are drawn only once when they are saved.

    To save a figure, Matplotlib draws it twice, the first time without output and only for the layout, which takes a
    quarter of the time.
    """
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    class Arranged(Figure):
        def draw(self, renderer: Any) -> None:
            engine = self.get_layout_engine()
            if isinstance(engine, ConstrainedLayoutEngine) and self.canvas.is_saving():
                engine.execute(self)  # Matplotlib then removes the engine and draws again
            else:
                super().draw(renderer)

    return Arranged


def look(name: str) -> AbstractContextManager[None]:
    """Return a context manager that sets the figures' style; ``name`` makes an SVG's identifiers unique."""
    import matplotlib

    style: Any = {**_STYLE, "svg.hashsalt": name}
    return matplotlib.rc_context(style)


def to_svg(figure: Figure) -> str:
    """Return a figure as an <svg> element for an HTML page."""
    import matplotlib

    text = StringIO()
    # without a salt Matplotlib uses random identifiers
    with matplotlib.rc_context({"svg.hashsalt": matplotlib.rcParams["svg.hashsalt"] or "figure"}):
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    opening, rest = svg.split(">", 1)
    opening = re.sub(r'\s(width|height|version|xmlns)="[^"]*"', "", opening)
    return f'{opening} role="img">{rest}'


def drawn(name: str, draw: Callable[..., Figure], *arguments: Any) -> str:
    """Draw a figure and return its <svg> element.

    Parameters
    ----------
    name : str
        Name of the figure, which makes its identifiers unique.
    draw : callable
        Function that makes the figure.
    arguments : Any
        Arguments of ``draw``.
    """
    with look(name):
        return to_svg(draw(*arguments))


def to_png(figure: Figure, dpi: int) -> bytes:
    """Return a figure as a PNG file.

    Parameters
    ----------
    figure : Figure
        Figure to save.
    dpi : int
        Dots per inch.
    """
    out = BytesIO()
    figure.savefig(out, format="png", dpi=dpi)
    return out.getvalue()


def plain_axes(axes: Axes) -> None:
    """Hide the top and right axis lines."""
    axes.spines[["top", "right"]].set_visible(False)


def panels(heights: Sequence[float], wide: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with rows of panels; each row is as high as its highest panel.

    Parameters
    ----------
    heights : sequence of float
        Heights of the panels in their order, in inches.
    wide : int
        Number of panels per row; unused positions stay empty.
    """
    rows = [max(heights[k : k + wide]) for k in range(0, len(heights), wide)]
    figure = new_figure(sum(rows))
    grid = figure.subplots(len(rows), wide, squeeze=False, height_ratios=rows).ravel()
    for axes in grid[len(heights) :]:
        axes.set_axis_off()
    return figure, list(grid[: len(heights)])


def interval_bars(
    axes: Axes, x: np.ndarray, y: np.ndarray, ends: Any, which: Literal["x", "y"] = "y", **how: Any
) -> None:
    """Draw error bars from the ends of intervals, which may be asymmetric about the values.

    Parameters
    ----------
    axes : Axes
        Axes to draw on.
    x : (N,) ndarray
        Positions along x.
    y : (N,) ndarray
        Positions along y.
    ends : (N, 2) array_like
        Lower and upper ends of the intervals, in the units of the axis.
    which : {'x', 'y'}
        Axis along which the bars lie.
    how : Any
        Further arguments of ``errorbar``; without ``fmt``, only the bars are drawn.
    """
    lengths = np.abs(np.asarray(ends, np.float64).T - (x if which == "x" else y))
    bare: dict[str, Any] = {} if "fmt" in how else {"fmt": "none", "ecolor": INK, "elinewidth": 1.0}
    axes.errorbar(x, y, **{f"{which}err": lengths, **bare, **how})


def gridded(axes: Axes, which: Literal["both", "x", "y"] = "both") -> None:
    """Draw light grid lines behind the data and hide the top and right axis lines.

    Parameters
    ----------
    axes : Axes
        Axes to draw on.
    which : {'both', 'x', 'y'}
        Axis of the grid lines.
    """
    axes.grid(axis=which, color=LIGHT, lw=0.5)
    axes.set_axisbelow(True)
    plain_axes(axes)


def shared_legend(
    figure: Figure, axes: Axes, position: str = "upper center", columns: int | None = None, **how: Any
) -> None:
    """Add a legend beside all panels with the entries of one of them.

    Parameters
    ----------
    figure : Figure
        Figure with all panels.
    axes : Axes
        Panel whose lines are listed.
    position : str
        Position beside the panels, in Matplotlib's words.
    columns : int | None
        Number of columns; None for one row.
    how : Any
        Further arguments of ``legend``.
    """
    handles, labels = axes.get_legend_handles_labels()
    outside: Any = f"outside {position}"
    figure.legend(handles, labels, loc=outside, ncols=columns or max(len(labels), 1), **how)


def signed_map(axes: Axes, values: np.ndarray, most: float | None = None, **how: Any) -> AxesImage:
    """Draw an image of (rows, columns) signed numbers, white at zero.

    Parameters
    ----------
    axes : Axes
        Axes to draw on.
    values : (rows, columns) ndarray
        Numbers; NaN is omitted.
    most : float | None
        Absolute value of the deepest colours; None for the largest absolute value.
    how : Any
        Further arguments of ``imshow``.
    """
    most = (float(np.nanmax(np.abs(values))) or 1.0) if most is None else most
    return axes.imshow(values, cmap=DIVERGING, vmin=-most, vmax=most, **how)
