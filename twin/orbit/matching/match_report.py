"""Report of points measured in a user's images."""

from __future__ import annotations

import numpy as np

from twin.orbit.images.point_report import PointListing, found_table, listing, lost_table, points_png
from twin.orbit.images.simulate_numbers import median_sigma, median_way
from twin.orbit.matching.match_run import Match
from twin.run.artefact import Cell, PngFigure, Table
from twin.run.report import Report, Section, one_sentence

_FAR = 0.5
"""Of the reach: matches that lie farther from where they were expected leave the search little room."""


def match_report(run: Match) -> Report:
    """Report of a run."""
    return Report(
        "Points measured in images",
        _verdict(run),
        (),
        _facts(run),
        _summary(run),
        (_measured(run), _images(run)),
        warnings=_warnings(run),
    )


def _verdict(run: Match) -> str:
    role = run.measurements.ground.role
    counts = [f"{int(np.sum(role == name))} {name}" for name in ("control", "check", "tie") if np.any(role == name)]
    ways = [
        (float(np.linalg.norm(median_way(line))), name)
        for one in run.points.sorts.values()
        for name, line in one.lines.items()
        if one.kind == "map" and line.accepted.any()
    ]
    far = ""
    if ways:
        way, name = max(ways)
        far = f"camera and platform expected them {way:.1f} px away in {name}, the line in which they are most wrong"
    shares = [
        (float(line.accepted.mean()), name) for one in run.points.sorts.values() for name, line in one.lines.items()
    ]
    share, name = min(shares)
    return one_sentence(
        f"{', '.join(counts)} points were measured in {len(run.ground.images)} images",
        far,
        f"fewest were accepted in {name}, {share:.0%}: see Why points were not accepted",
    )


def _summary(run: Match) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for sort, one in run.points.sorts.items():
        for name, line in one.lines.items():
            if name == one.source or not line.accepted.any():
                continue
            way, sigma = median_way(line), median_sigma(line)
            counts = len(line.status), int(line.accepted.sum())
            rows.append((sort, name, *counts, *map(float, way), *map(float, sigma)))
    return Table(
        "matched",
        "Points",
        "Displacement from where camera and platform expect them, and sigma of the fit: medians of the accepted [px].",
        ("points", "line", "sought", "accepted", "lines", "pixels", "σ lines", "σ pixels"),
        rows,
        (None, None, None, None, 2, 2, 3, 3),
    )


def _facts(run: Match) -> tuple[tuple[str, str], ...]:
    maps, spec = run.ground.control, run.setup.test
    plan, height = spec.control_sigma
    return (
        ("Camera", run.setup.camera.name),
        ("Orthophoto", f"{maps.orthophoto.raster.crs.name}, {maps.orthophoto.spacing:.3g} m"),
        ("Elevation model", f"{maps.dem.raster.crs.name}, {maps.dem.spacing:.3g} m"),
        ("Control is good to", f"{plan:g} m in plan, {height:g} m in height"),
        ("Description", spec.description),
    )


def _measured(run: Match) -> Section:
    spec = run.setup.test.points
    text = (
        "Distinct places of the orthophoto, with heights of the elevation model, and distinct places of one line's "
        f"image are brought into each line's geometry by camera and platform as they are known, templates of "
        f"{spec.template} pixels, sought {spec.reach} pixels to each side, and fitted by least squares. "
        f"Rejected is what fails a "
        "threshold of the matching, and what does not follow the smooth displacement of its neighbours.",
    )
    figures = [
        PngFigure(
            f"points-{sort}",
            f"From expected to found, {sort} points",
            "Arrows as long as they are in the image, after the median displacement in the title was taken off, "
            "enlarged as the title says; crosses: rejected by the neighbours; points: not matched.",
            points_png(run.ground, one),
        )
        for sort, one in run.points.sorts.items()
    ]
    listed = PointListing(
        "points",
        "Points",
        "Every point in every line: ground coordinates, image coordinates, sigmas of the fit, verdict.",
        listing(run.ground, run.points),
    )
    return Section("Measured points", text, (found_table(run.points), *figures, lost_table(run.points), listed))


def _images(run: Match) -> Section:
    rows: list[tuple[Cell, ...]] = []
    for name, image in run.ground.images.items():
        window = image.window
        size = (window.lines, window.pixels)
        rows.append((name, window.first_line, window.first_pixel, *size, *image.sample, float(image.frame.mean())))
    table = Table(
        "windows",
        "Images",
        "Lines count from the first of the table of times, pixels from the one that sees farthest to the right.",
        ("line", "first line", "first pixel", "lines", "pixels", "along line [m]", "along track [m]", "mean"),
        rows,
        (None, None, None, None, None, 3, 3, 1),
    )
    return Section("Images", (), (table,))


def _warnings(run: Match) -> tuple[str, ...]:
    found, reach = [], run.setup.test.points.reach
    for one in run.points.sorts.values():
        for name, line in one.lines.items():
            if one.kind == "map" and line.accepted.any() and np.max(np.abs(median_way(line))) > _FAR * reach:
                found.append(f"points of {name} lie near the end of the reach; a larger `points.reach` may find more")
    if run.accuracy is None or run.accuracy < 0.0:
        found.append("how good the way of the maps' system to WGS 84 is, is not stated by its authority")
    elif run.accuracy > 0.1:
        found.append(f"the way of the maps' system to WGS 84 is good to {run.accuracy:g} m only")
    return tuple(found)
