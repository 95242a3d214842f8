"""Report of points measured in a user's images: verdict, facts, counts and warnings."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from twin.framework import svg
from twin.framework.artefact import SvgFigure
from twin.framework.report import Report, Section, answer
from twin.orbit.images.simulate_report import found_table, how_measured, point_artefacts
from twin.orbit.images.simulate_run import MATCHED
from twin.orbit.matching.match_run import IMAGE, Match
from twin.orbit.matching.rational_match import RationalMatch, tie_points
from twin.orbit.matching.surface import Surface

_FAR = 0.5
"""Share of the search range above which a median displacement is reported as too near the limit of the search."""

_OFF = 0.5
"""Median displacement across the epipolar lines, in pixels, from which rows of two images no longer fit each other."""
_DRAWN = 400
"""Largest number of rows or columns of a drawn grid."""


def match_report(run: Match | RationalMatch) -> Report:
    """Return the report of points measured in a user's images: verdict, counts, accuracy and warnings."""
    if isinstance(run, RationalMatch):
        return rational_report(run)
    return Report(
        "Points measured in images",
        *_verdict(run),
        _facts(run),
        found_table(run.points),
        (_measured(run), _images(run)),
        warnings=_warnings(run),
    )


def _verdict(run: Match) -> tuple[str, tuple[str, ...]]:
    """Return the verdict of the measurement, and the sentences that follow it in the report."""
    role = run.measurements.ground.role
    counts = [f"{int(np.sum(role == name))} {name}" for name in ("control", "check", "tie") if np.any(role == name)]
    displacements = [
        (float(np.linalg.norm(line.median_shift)), name)
        for group in run.points.sorts.values()
        for name, line in group.lines.items()
        if group.kind == "map" and line.accepted.any()
    ]
    far = ""
    if displacements:
        displacement, name = max(displacements)
        far = f"the largest displacement from the prediction by camera and platform is {displacement:.1f} px, in {name}"
    shares = [
        (float(line.accepted.mean()), name) for group in run.points.sorts.values() for name, line in group.lines.items()
    ]
    share, name = min(shares)
    return answer(
        f"{', '.join(counts)} points were measured in {len(run.ground.images)} images",
        f"the share of accepted points is lowest in {name}, {share:.0%}: see Why points were not accepted",
        far,
    )


def _facts(run: Match) -> tuple[tuple[str, str], ...]:
    """Return the input quantities listed in the report."""
    maps, spec = run.ground.control, run.setup.test
    plan, height = spec.control_sigma
    return (
        ("Camera", run.setup.camera.name),
        ("Orthophoto", f"{maps.orthophoto.raster.crs.name}, {maps.orthophoto.spacing:.3g} m"),
        ("Elevation model", f"{maps.dem.raster.crs.name}, {maps.dem.spacing:.3g} m"),
        ("Accuracy of the control", f"{plan:g} m in plan, {height:g} m in height"),
        ("Description", spec.description),
    )


def _measured(run: Match) -> Section:
    """Return the report section on the measured points: counts, displacements and figures."""
    text = how_measured(run.setup.test.points, "the laboratory's camera on the measured platform")
    return Section("Measured points", (text,), point_artefacts(run.ground, run.points))


def _images(run: Match) -> Section:
    """Return the report section on the images: size, ground sample distance and position."""
    rows = {name: IMAGE(image) for name, image in run.ground.images.items()}
    caption = "Lines count from the first in the table of times, pixels from the one that looks farthest to the right."
    return Section("Images", (), (IMAGE.table("windows", "Images", caption, rows, label="line", digits=4),))


def _warnings(run: Match) -> tuple[str, ...]:
    """Return warnings on displacements near the search range and on the accuracy of the maps' datum."""
    texts, radius = [], run.setup.test.points.search_radius
    for group in run.points.sorts.values():
        for name, line in group.lines.items():
            if group.kind == "map" and line.accepted.any() and np.max(np.abs(line.median_shift)) > _FAR * radius:
                texts.append(f"points of {name} lie at the search limit; a larger `points.search_radius` may find more")
    if run.accuracy is None or run.accuracy < 0.0:
        texts.append("the accuracy of the datum transformation of the maps to WGS 84 is not stated by its authority")
    elif run.accuracy > 0.1:
        texts.append(f"the datum transformation of the maps to WGS 84 is accurate to {run.accuracy:g} m only")
    return tuple(texts)


def rational_report(run: RationalMatch) -> Report:
    """Return the report of tie points between images: verdict, counts and displacements across the epipolar lines."""
    pairs = {
        f"{source} in {name}": line
        for source, points in run.points.items()
        for name, line in points.searched_lines.items()
    }
    rows = {name: MATCHED(line) for name, line in pairs.items() if line.accepted.any()}
    for row in rows.values():
        row["consensus_scatter_px"] = row["consensus_scatter_px"] or "\N{EM DASH}"
    displacement = ("displacement_lines_px", "displacement_pixels_px")
    keys = ("measured", "matched", "accepted", *displacement, "consensus_scatter_px")
    caption = (
        "Displacement: median of the accepted from the prediction at the height of each point, in lines and samples;"
        " it is that of the polynomials across the epipolar lines. Scatter: beyond the covariances; a dash where these"
        " explain it."
    )
    table = MATCHED.table("points-found", "Matching", caption, rows, keys, "points", digits=4)
    heads = sorted(pairs, key=lambda name: float(pairs[name].accepted.mean()))
    verdict, more = answer(
        f"{tie_points(run)} tie points were measured in {len(run.points)} images",
        f"the share of accepted points is lowest for {heads[0]}, {pairs[heads[0]].accepted.mean():.0%}",
    )
    low, high = run.setup.test.heights
    facts = (("Heights", f"{low:g} to {high:g} m"), ("Description", run.setup.test.description))
    lost = [
        f"{name}: " + ", ".join(f"{number} {reason}" for reason, number in line.rejections.items())
        for name, line in pairs.items()
    ]
    sections = (Section("Why points were not accepted", tuple(lost), ()), *_surface_section(run.surface))
    off = max((float(np.abs(line.median_shift).max()) for line in pairs.values() if line.accepted.any()), default=0.0)
    warnings: tuple[str, ...] = ()
    if run.surface is not None and off > _OFF:
        warnings = (
            f"the polynomials of two images differ by up to {off:.2g} px across the epipolar lines, which costs the"
            " surface heights and accuracy: correct them by `twin.orbit adjust` first",
        )
    return Report("Tie points", verdict, more, facts, table, sections, warnings=warnings)


def _surface_section(grid: Surface | None) -> tuple[Section, ...]:
    """Return the section with the map of the heights and their accuracy, if there is a surface."""
    if grid is None:
        return ()
    text = (
        f"{grid.share:.0%} of {grid.height.size} cells of {grid.spacing:g} m ({grid.crs}) have a height above the"
        f" ellipsoid; its sigma is {np.nanmedian(grid.sigma):.2g} m in the median."
    )
    scatter = grid.scatter
    if scatter is not None:
        text += f" Heights of two pairs differ {scatter:.2g} times as much as `surface.sigma` predicts."
    drawing = svg.drawn("match-surface", _surface_figure, grid)
    caption = "Height above the ellipsoid; white cells have none."
    return (Section("Surface", (text,), (SvgFigure("surface", "", caption, drawing),)),)


def _surface_figure(grid: Surface) -> Figure:
    """Draw the heights of a grid on a map."""
    figure = svg.new_figure(5.0)
    axes = figure.subplots()
    step = max(1, int(np.ceil(max(grid.height.shape) / _DRAWN)))
    rows, columns = (1e-3 * grid.spacing * n for n in grid.height.shape)
    shown = grid.height[::step, ::step]
    low, high = np.nanpercentile(shown, [1.0, 99.0])
    drawn = axes.imshow(shown, extent=(0.0, columns, 0.0, rows), cmap="viridis", vmin=low, vmax=high)
    axes.set(xlabel="east [km]", ylabel="north [km]")
    figure.colorbar(drawn, ax=axes, shrink=0.8, label="height [m]")
    return figure
