"""Report of points measured in a user's images."""

from __future__ import annotations

import numpy as np

from twin.framework.artefact import Cell, Table
from twin.framework.report import Report, Section, answer
from twin.orbit.images.point_report import point_artefacts
from twin.orbit.matching.match_run import Match

_FAR = 0.5
"""Share of the reach: matches that lie farther from where they were expected leave the search little room."""


def match_report(run: Match) -> Report:
    """Report of a run."""
    return Report(
        "Points measured in images",
        *_verdict(run),
        _facts(run),
        _summary(run),
        (_measured(run), _images(run)),
        warnings=_warnings(run),
    )


def _verdict(run: Match) -> tuple[str, tuple[str, ...]]:
    role = run.measurements.ground.role
    counts = [f"{int(np.sum(role == name))} {name}" for name in ("control", "check", "tie") if np.any(role == name)]
    ways = [
        (float(np.linalg.norm(line.moved)), name)
        for one in run.points.sorts.values()
        for name, line in one.lines.items()
        if one.kind == "map" and line.accepted.any()
    ]
    far = ""
    if ways:
        way, name = max(ways)
        far = f"the largest difference from camera and platform is {way:.1f} px, in {name}"
    shares = [
        (float(line.accepted.mean()), name) for one in run.points.sorts.values() for name, line in one.lines.items()
    ]
    share, name = min(shares)
    return answer(
        f"{', '.join(counts)} points were measured in {len(run.ground.images)} images",
        f"the share of accepted points is lowest in {name}, {share:.0%}: see Why points were not accepted",
        far,
    )


def _summary(run: Match) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for sort, one in run.points.sorts.items():
        for name, line in one.sought_in.items():
            if line.accepted.any():
                counts = len(line.status), int(line.accepted.sum())
                rows.append((sort, name, *counts, *line.moved.tolist(), *line.usual_sigma.tolist()))
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
    names = {sort: sort for sort in run.points.sorts}
    shown = point_artefacts(run.ground, run.points, names, ("expected", "", " of the fit"))
    return Section("Measured points", text, shown)


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
            if one.kind == "map" and line.accepted.any() and np.max(np.abs(line.moved)) > _FAR * reach:
                found.append(f"points of {name} lie near the end of the reach; a larger `points.reach` may find more")
    if run.accuracy is None or run.accuracy < 0.0:
        found.append("how good the way of the maps' system to WGS 84 is, is not stated by its authority")
    elif run.accuracy > 0.1:
        found.append(f"the way of the maps' system to WGS 84 is good to {run.accuracy:g} m only")
    return tuple(found)
