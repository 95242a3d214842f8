"""Figures as inline SVG: one look for all, no pyplot, no global state left behind."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from io import BytesIO, StringIO
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:  # who only names colours does not wait for what draws
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

# Okabe and Ito's palette: told apart with any colour vision.
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
"""Centroid marks."""
GRAY, DIVERGING = "gray", "RdBu_r"
"""Colour maps of images and of what has a sign."""

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
"""Inches: the width of the page's column at 100 dots per inch."""


def new_figure(height: float, pads: dict[str, Any] | None = None) -> Figure:
    """An empty figure as wide as a page's column, arranged without overlap.

    Parameters
    ----------
    height : float
        Of the figure, inches.
    pads : dict[str, Any] | None
        Arguments of ``ConstrainedLayoutEngine``; None for the usual room between panels.
    """
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    return _arranged()(figsize=(WIDTH, height), layout=ConstrainedLayoutEngine(**(pads or {"h_pad": 0.08})))


@cache
def _arranged() -> type[Figure]:
    """Figures that are saved in one drawing and an arrangement.

    To save a figure Matplotlib draws it twice, the first time onto nothing, and needs of that only that its parts are
    arranged: a quarter of the time. To arrange and to draw an axis it asks ten times for the same ticks.
    """
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    class Arranged(Figure):
        def draw(self, renderer: Any) -> None:
            engine = self.get_layout_engine()
            with _ticks_kept(self):
                if isinstance(engine, ConstrainedLayoutEngine) and self.canvas.is_saving():
                    engine.execute(self)  # Matplotlib then takes the engine away and comes again
                else:
                    super().draw(renderer)

    return Arranged


@contextmanager
def _ticks_kept(figure: Figure) -> Iterator[None]:
    """While the figure is arranged or drawn, ticks and the places of their labels are worked out once for each size and
    view of their axes.
    """
    every: list[Any] = [axis for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)]
    for axis in every:
        axis._update_ticks, axis._get_ticklabel_bboxes = _kept_of(axis)
    try:
        yield
    finally:
        for axis in every:
            del axis._update_ticks, axis._get_ticklabel_bboxes


def _kept_of(axis: Any) -> tuple[Callable[[], Any], Callable[[Any, Any], Any]]:
    """The two functions of an axis, which remember what they found last."""
    update, boxes = axis._update_ticks, axis._get_ticklabel_bboxes
    known: dict[str, Any] = {}

    def same() -> bool:
        now = axis.axes.bbox.bounds, tuple(axis.get_view_interval()), axis.axes.figure.dpi
        if known.get("at") == now:
            return True
        known.clear()
        known["at"] = now
        return False

    def ticks() -> Any:
        if not same() or "ticks" not in known:
            known["ticks"] = update()
        return known["ticks"]

    def ticklabel_bboxes(shown: Any, renderer: Any) -> Any:
        if shown is not known.get("ticks"):
            return boxes(shown, renderer)
        if known.get("by") is not renderer:
            known["by"], known["boxes"] = renderer, boxes(shown, renderer)
        return known["boxes"]

    return ticks, ticklabel_bboxes


def look(name: str) -> AbstractContextManager[None]:
    """Context in which figures are drawn; ``name`` makes an SVG's identifiers its own, and the same in every run."""
    import matplotlib

    style: Any = {**_STYLE, "svg.hashsalt": name}
    return matplotlib.rc_context(style)


def to_svg(figure: Figure) -> str:
    """The figure as an <svg> element that can stand in an HTML page."""
    import matplotlib

    text = StringIO()
    # without a salt Matplotlib draws lots for the identifiers
    with matplotlib.rc_context({"svg.hashsalt": matplotlib.rcParams["svg.hashsalt"] or "figure"}):
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    opening, rest = svg.split(">", 1)
    opening = re.sub(r'\s(width|height|version|xmlns)="[^"]*"', "", opening)
    return f'{opening} role="img">{rest}'


def drawn(name: str, draw: Callable[..., Figure], *given: Any) -> str:
    """The <svg> element of a figure.

    Parameters
    ----------
    name : str
        Of the figure, which makes its identifiers its own.
    draw : Callable[..., Figure]
        Makes the figure.
    given : Any
        Arguments of ``draw``.
    """
    with look(name):
        return to_svg(draw(*given))


def to_png(figure: Figure, dpi: int) -> bytes:
    """The figure as PNG.

    Parameters
    ----------
    figure : Figure
        What is drawn.
    dpi : int
        Dots per inch.
    """
    out = BytesIO()
    figure.savefig(out, format="png", dpi=dpi)
    return out.getvalue()


def plain_axes(axes: Axes) -> None:
    """Only the left and the bottom axis line."""
    axes.spines[["top", "right"]].set_visible(False)


def panels(heights: Sequence[float], wide: int) -> tuple[Figure, list[Axes]]:
    """A figure of panels in rows, each row as high as its highest panel.

    Parameters
    ----------
    heights : Sequence[float]
        Of the panels in their order, inches.
    wide : int
        Number of panels beside each other; places that are left over stay empty.
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
    """Error bars from the ends of intervals, which need not lie evenly about the values.

    Parameters
    ----------
    axes : Axes
        where.
    x : np.ndarray
        Places of the values along x, (N,).
    y : np.ndarray
        And along y, (N,).
    ends : Any
        Lower and upper ends of the intervals, (N, 2), in the units of the axis.
    which : Literal['x', 'y']
        The axis along which the bars lie.
    how : Any
        More for ``errorbar``; without ``fmt`` only the bars are drawn, in ink.
    """
    reach = np.abs(np.asarray(ends, np.float64).T - (x if which == "x" else y))
    bare: dict[str, Any] = {} if "fmt" in how else {"fmt": "none", "ecolor": INK, "elinewidth": 1.0}
    axes.errorbar(x, y, **{f"{which}err": reach, **bare, **how})


def gridded(axes: Axes, which: Literal["both", "x", "y"] = "both") -> None:
    """Light lines behind what is drawn, and only the left and the bottom axis line.

    Parameters
    ----------
    axes : Axes
        where.
    which : Literal['both', 'x', 'y']
        Along which axis the lines are counted.
    """
    axes.grid(axis=which, color=LIGHT, lw=0.5)
    axes.set_axisbelow(True)
    plain_axes(axes)


def shared_legend(
    figure: Figure, axes: Axes, place: str = "upper center", columns: int | None = None, **how: Any
) -> None:
    """A legend beside all panels, of what one of them shows.

    Parameters
    ----------
    figure : Figure
        With all panels.
    axes : Axes
        The panel whose lines are named.
    place : str
        Beside the panels, as Matplotlib names it.
    columns : int | None
        Of the legend; None for one row.
    how : Any
        More for ``legend``.
    """
    handles, labels = axes.get_legend_handles_labels()
    outside: Any = f"outside {place}"
    figure.legend(handles, labels, loc=outside, ncols=columns or max(len(labels), 1), **how)


def signed_map(axes: Axes, values: np.ndarray, most: float | None = None, **how: Any) -> AxesImage:
    """An image of (rows, columns) numbers with a sign, white at zero.

    Parameters
    ----------
    axes : Axes
        where.
    values : np.ndarray
        The numbers; NaN is left out.
    most : float | None
        Size of the deepest colours; None for the largest number's.
    how : Any
        More for ``imshow``.
    """
    most = (float(np.nanmax(np.abs(values))) or 1.0) if most is None else most
    return axes.imshow(values, cmap=DIVERGING, vmin=-most, vmax=most, **how)
