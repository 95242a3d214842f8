"""Report of points measured in images: listing, tables and figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke

from scenes.specs.orbit.scene import ImagePointsSpec
from twin.framework.artefact import Artefact, Cell, Data, PngFigure, Table, rounded_down
from twin.framework.data_files import csv_table
from twin.framework.report import Section
from twin.framework.svg import SKY, VERMILION, YELLOW, look, new_figure, to_png
from twin.orbit.images.image_points import CONSENSUS, ImagedGround, LineFrame, MatchedPoints, PatchPoints, status_text
from twin.orbit.images.patch import WRONG, Patch, judged
from twin.orbit.images.simulate_run import COMPARED, MATCHED


def pixel_axes(axes: Axes) -> None:
    """Label the axes of an image in a figure with a few whole numbers of pixels and lines.

    The limits of the axes must be set before.
    """
    axes.set(xlabel="pixel", ylabel="line")
    axes.ticklabel_format(useOffset=False)
    axes.locator_params(axis="x", nbins=4)
    axes.locator_params(axis="y", nbins=6)
    axes.tick_params(axis="y", labelrotation=90)
    for label in axes.get_yticklabels():
        label.set_verticalalignment("center")


HEADS = (
    "sort",
    "point",
    "line_name",
    "longitude_deg",
    "latitude_deg",
    "height_m",
    "x_itrs_m",
    "y_itrs_m",
    "z_itrs_m",
    "predicted_line",
    "predicted_pixel",
    "line",
    "pixel",
    "line_sigma",
    "pixel_sigma",
    "correlation_of_sigmas",
    "template_correlation",
    "accepted",
    "status",
)
"""Column headings of the listing of measured points."""


@dataclass(frozen=True, eq=False)
class PointListing(Data):
    """CSV file of measured points, one row per point and line with the columns of `HEADS`, linked in the report."""

    kind: ClassVar[str] = "csv"

    def content(self) -> bytes:
        """Return the rows as text of the CSV file, with all their digits; missing values are empty."""
        return csv_table([HEADS, *self.data])


def listing(patch: ImagedGround, points: PatchPoints) -> list[list[Any]]:
    """Return the rows of the listing of points, one for each point and line, with the columns of `HEADS`."""
    rows: list[list[Any]] = []
    for sort, group in points.sorts.items():
        degrees = np.degrees(patch.frame.geographic(group.east, group.north)).T
        for name, line in group.lines.items():
            image, expected = line.image, line.predicted + np.array(line.first)
            sigma = np.sqrt(np.diagonal(line.covariance, axis1=1, axis2=2))
            with np.errstate(invalid="ignore", divide="ignore"):
                together = line.covariance[:, 0, 1] / np.prod(sigma, axis=1)
            for k in range(len(group.ground)):
                kind = "check" if group.check[k] else sort
                numbers = (*expected[k], *image[k], *sigma[k], together[k], line.correlation[k])
                shown = [float(v) if np.isfinite(v) else None for v in numbers]
                code = int(line.status[k])
                ground = [*map(float, degrees[k]), float(group.height[k]), *map(float, group.ground[k])]
                rows.append([kind, k, name, *ground, *shown, int(line.accepted[k]), status_text(code)])
    return rows


T = TypeVar("T")
_DPI = 110
"""Resolution of the figures, in dots per inch."""
SORTS = {"control": "orthophoto", "tie": "tie"}
"""Names in reports of the kinds of points, by key."""


def how_measured(spec: ImagePointsSpec, known: str) -> str:
    """Return a description of how points are measured in images.

    Parameters
    ----------
    spec : ImagePointsSpec
        Options of the measurement.
    known : str
        Description of the sensor that predicts the points' positions in each line's image.
    """
    return (
        "Distinct points of the orthophoto, with heights of the elevation model, and distinct points of one line's "
        f"image are transformed to each line's geometry by {known}. Templates of {spec.template} pixels are searched "
        f"{spec.reach} pixels to each side and fitted by least squares. Points are rejected that fail a threshold of "
        "the matching or do not follow the smooth displacement of their neighbours."
    )


def points_section(patch: Patch, points: PatchPoints, spec: ImagePointsSpec) -> Section:
    """Return the report section on the points measured in a patch: numbers, figures and listing."""
    shown = point_artefacts(patch, points, found_table(points), _true(patch, points))
    return Section("Measured points", (how_measured(spec, "the measured sensor"),), shown)


def point_artefacts(patch: ImagedGround, points: PatchPoints, *tables: Table) -> tuple[Artefact, ...]:
    """Return the report's parts on measured points: tables, figures, reasons of rejections, and listing."""
    figures = [
        PngFigure(
            f"points-{sort}",
            f"Displacement from predicted to measured, {SORTS[sort]} points",
            "Arrows: displacements less their median in the title, enlarged by the factor there; crosses: rejected "
            "by the consensus of the neighbours; points: not matched.",
            points_png(patch, group),
        )
        for sort, group in points.sorts.items()
    ]
    caption = "Each point in each line: ground coordinates, image coordinates, sigmas of the fit, status."
    listed = PointListing("points", "Points", caption, listing(patch, points))
    return *tables, *figures, _lost_table(points), listed


def flat(points: PatchPoints, below: Callable[[MatchedPoints], Mapping[str, T]]) -> dict[str, T]:
    """Return results by kind of point and line in one mapping, with names such as "tie, forward"."""
    groups = ((sort, below(group)) for sort, group in points.sorts.items())
    return {f"{SORTS[sort]}, {name}": line for sort, lines in groups for name, line in lines.items()}


def found_table(points: PatchPoints) -> Table:
    """Return the table of the points that were matched, by kind and line."""
    matches = flat(points, lambda group: group.searched_lines)
    rows = {name: MATCHED(line) for name, line in matches.items() if line.accepted.any()}
    caption = (
        "Displacement from predicted to measured and sigma: medians of the accepted, px along the track and the line."
    )
    displacement = ("displacement_lines_px", "displacement_pixels_px")
    keys = ("found", "matched", "accepted", *displacement, *(f"{key}_sigma" for key in displacement))
    return MATCHED.table("points-found", "Matching", caption, rows, keys, "points, line", digits=4)


def _true(patch: Patch, points: PatchPoints) -> Table:
    """Return the table that compares the measured points with their true image positions."""
    rows = {name: COMPARED(line) for name, line in flat(points, lambda quantity: judged(patch, quantity)).items()}
    caption = (
        f"Wrong: {WRONG}; counted among all measured points, those that passed the matching, and those that passed the "
        "consensus. RMS and mean error, px, and chi-square of the right points."
    )
    keys = [quantity.key for quantity in COMPARED][:-1]
    return COMPARED.table("points-truth", "Comparison with the truth", caption, rows, keys, "points, line", digits=4)


def _lost_table(points: PatchPoints) -> Table:
    """Return the table of the reasons why points were not accepted."""
    rows: list[tuple[Cell, ...]] = []
    for sort, group in points.sorts.items():
        count = {name: line.rejections for name, line in group.searched_lines.items()}
        total: Counter[str] = Counter()
        for reasons in count.values():
            total.update(reasons)
        for text, _ in total.most_common():
            rows.append((SORTS[sort], text, ", ".join(f"{n} {c.get(text, 0)}" for n, c in count.items())))
    return Table("points-lost", "Why points were not accepted", "", ("points", "reason", "number"), rows)


def points_png(patch: ImagedGround, points: MatchedPoints) -> bytes:
    """Return a PNG of every line's frame with its points and their displacements."""
    with look(f"points-{points.kind}"):
        names = list(points.searched_lines)
        figure = new_figure(4.3 if len(names) > 2 else 5.6)
        panels = np.atleast_1d(figure.subplots(1, len(names)))
        for axes, name in zip(panels, names, strict=True):
            _panel(axes, name, patch.images[name], points)
        marks = [
            Line2D([], [], color=YELLOW, marker=r"$\rightarrow$", ls="", ms=9, label="accepted"),
            Line2D([], [], color=VERMILION, marker="x", ls="", label="rejected by consensus"),
            Line2D([], [], color=SKY, marker=".", ls="", label="not matched"),
        ]
        figure.legend(handles=marks, loc="outside lower center", ncols=3, labelcolor="black")
        return to_png(figure, _DPI)


def _panel(axes: Axes, name: str, image: LineFrame, points: MatchedPoints) -> None:
    """Draw one line's frame with its points and their displacements."""
    line = points.lines[name]
    low, high = np.percentile(image.frame, (0.5, 99.5))
    row, column = line.first
    rows, columns = image.frame.shape
    ends = (column - 0.5, column + columns - 0.5, row + rows - 0.5, row - 0.5)
    axes.imshow(image.frame, cmap="gray", vmin=low, vmax=high, extent=ends, interpolation="antialiased", alpha=0.75)
    at, to = line.predicted + np.array(line.first), line.image
    # Adding zero removes a minus before zero.
    middle = np.round(line.median_shift, 1) + 0.0
    rest = to - at - middle
    good, against = line.accepted, line.status == CONSENSUS
    longest = float(np.quantile(np.linalg.norm(rest[good], axis=1), 0.95))
    enlarged = rounded_down(0.06 * min(rows, columns) / max(longest, 1e-3))
    arrow: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0 / enlarged, "width": 0.004}
    effects = [Stroke(linewidth=1.2, foreground="black"), Normal()]
    axes.quiver(to[good, 1], to[good, 0], rest[good, 1], rest[good, 0], color=YELLOW, path_effects=effects, **arrow)
    axes.plot(to[against, 1], to[against, 0], "x", color=VERMILION, ms=6, mew=1.6)
    unmatched = ~good & ~against
    # Points that were not matched are drawn at their expected position.
    axes.plot(at[unmatched, 1] + middle[1], at[unmatched, 0] + middle[0], ".", color=SKY, ms=5, mec="black", mew=0.4)
    axes.set(
        title=f"{name}: median {middle[0]:.1f} lines, {middle[1]:.1f} pixels\nresiduals enlarged {enlarged:g} ×",
        xlim=ends[:2],
        ylim=ends[2:],
    )
    pixel_axes(axes)
